#!/usr/bin/env bash
# TorchRL: MultiStep sums the rewards of n steps up to the end of an episode, but does not mark
# these transitions as terminated. Values are added to them after the end.
#
# Who meets it: somebody who trains DQN or SAC on returns of several steps, with MultiStep for a
# collector or MultiStepTransform for a replay buffer, and a value estimator of TorchRL.
#
# The guess: a transition whose n steps reach the end of the task has terminated = True, since
# its next observation is the terminal one. So its target is the sum of its rewards alone.
#
# The behaviour: rewards and next observations are moved, "done" and "terminated" stay those of
# the first of the n steps. Only the last transition has terminated = True. The n - 1 before it
# get the discounted value of the terminal observation on top. The column "nonterminal" does not
# tell them apart either.
#
# Seen on 2026-11-29 with Python 3.11.7, torch 2.13.0, torchrl 0.14.1, tensordict 0.14.3; three
# steps, each with a reward of 1, gamma 0.5, every value 1000, the sixth step ends the task:
#   observation       [100.0, 101.0, 102.0, 103.0, 104.0, 105.0]
#   next observation  [103.0, 104.0, 105.0, 106.0, 106.0, 106.0]
#   rewards           [1.75, 1.75, 1.75, 1.75, 1.5, 1.0]
#   terminated        [False, False, False, False, False, True]
#   TD(0) target      [126.75, 126.75, 126.75, 126.75, 251.5, 1.0]
set -euo pipefail

work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install -qq --no-compile --disable-pip-version-check \
    torch==2.13.0 torchrl==0.14.1 tensordict==0.14.3 numpy==2.4.6

cat > "$work/show.py" <<'PY'
import platform
from importlib.metadata import version

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.data.postprocs import MultiStep
from torchrl.objectives.value import TD0Estimator

STEPS = 6
GAMMA = 0.5


class Always1000(torch.nn.Module):
    def forward(self, observation):
        return torch.full_like(observation, 1000.0)


print("Python", platform.python_version(), *(f"{name} {version(name)}" for name in ("torch", "torchrl", "tensordict")))
shape = (1, STEPS, 1)
end = torch.zeros(shape, dtype=torch.bool)
end[0, -1] = True
observations = 100.0 + torch.arange(STEPS).reshape(shape)
after = {
    "observation": observations + 1,
    "reward": torch.ones(shape),
    "done": end,
    "terminated": end.clone(),
    "truncated": torch.zeros_like(end),
}
episode = TensorDict({"observation": observations, "next": after}, shape[:2])
joined = MultiStep(gamma=GAMMA, n_steps=3)(episode)
value = TensorDictModule(Always1000(), ["observation"], ["state_value"])
TD0Estimator(gamma=GAMMA, value_network=value)(joined)


def show(label, *key):
    values = joined[key].flatten().tolist()
    print(f"{label:17} {values}")
    return values


show("observation", "observation")
seen = show("next observation", "next", "observation")
rewards = show("rewards", "next", "reward")
terminated = show("terminated", "next", "terminated")
targets = show("TD(0) target", "value_target")

assert seen == [103, 104, 105, 106, 106, 106]
assert rewards == [1.75, 1.75, 1.75, 1.75, 1.5, 1]
# Right would be: terminated in the last three, and the targets 1.75, 1.5 and 1 there.
assert terminated == [False] * 5 + [True], "changed: terminated moves with the next observation"
assert targets == [126.75, 126.75, 126.75, 126.75, 251.5, 1], "changed: no value after the end"
PY
"$work/venv/bin/python" -W ignore "$work/show.py"
