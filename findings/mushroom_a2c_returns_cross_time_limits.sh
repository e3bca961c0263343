#!/usr/bin/env bash
# MushroomRL: A2C adds the next episode's rewards to the returns of an episode that the time limit ended.
#
# Who meets it: somebody who trains its A2C on a task with a horizon and no absorbing states, such
# as Pendulum, with more than one episode in a fit, or with a number of steps for each fit that
# does not divide the horizon.
#
# The guess: returns end at the end of an episode. Where a time limit cut it, the value of the last
# state stands for the rest. The library's own compute_gae, for PPO, does so.
#
# The behaviour: the returns end only at absorbing states. Behind a time limit they go on with the
# rewards of the next episode, which begins somewhere else. One episode in each fit hides it.
#
# Seen on 2026-11-29 with Python 3.11.7, mushroom-rl 1.10.2, torch 2.5.1, numpy 1.24.4.
# Episode 1 pays 0 in each of its 5 steps, episode 2 pays 100. All values are 0, gamma is 0.99:
#   the critic's targets, both in one fit: 466 471 476 480 485 | 490 394 297 199 100
#   the critic's targets, one in each fit: 0 0 0 0 0 | 490 394 297 199 100
set -euo pipefail

work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
# The library itself asks for torch 2.5.1 and numpy 1.24.4.
"$work/venv/bin/pip" install -qq --no-compile --disable-pip-version-check mushroom-rl==1.10.2

cat > "$work/show.py" <<'PY'
import platform
from importlib.metadata import version

import numpy as np
import torch
from mushroom_rl.algorithms.actor_critic import A2C
from mushroom_rl.core import Core, Environment, MDPInfo
from mushroom_rl.policy import GaussianTorchPolicy
from mushroom_rl.utils.spaces import Box

HORIZON = 5


class Task(Environment):
    """No absorbing state. The first episode pays 0 for each step, the others 100."""

    def __init__(self):
        self.episode = 0
        super().__init__(MDPInfo(Box(-1, 9, (1,)), Box(-1, 1, (1,)), gamma=0.99, horizon=HORIZON))

    def reset(self, state=None):
        self.episode += 1
        self.steps = 0
        return np.zeros(1)

    def step(self, action):
        self.steps += 1
        reward = 0.0 if self.episode == 1 else 100.0
        return np.array([float(self.steps)]), reward, False, {}


class Zero(torch.nn.Module):
    """A linear layer that begins at 0."""

    def __init__(self, input_shape, output_shape, **_):
        super().__init__()
        self.linear = torch.nn.Linear(input_shape[-1], output_shape[0])
        torch.nn.init.zeros_(self.linear.weight)
        torch.nn.init.zeros_(self.linear.bias)

    def forward(self, x, **_):
        return self.linear(x.float())


def critic_targets(episodes_per_fit):
    torch.manual_seed(0)
    np.random.seed(0)
    task = Task()
    still = {"class": torch.optim.SGD, "params": {"lr": 0.0}}  # all values stay 0
    critic = {
        "network": Zero,
        "optimizer": still,
        "loss": torch.nn.functional.mse_loss,
        "input_shape": (1,),
        "output_shape": (1,),
    }
    policy = GaussianTorchPolicy(Zero, (1,), (1,), std_0=1.0)
    agent = A2C(task.info, policy, still, critic, ent_coeff=0.0)
    targets = []
    fit = agent._V.fit

    def listen(states, values, **options):
        targets.extend(float(x) for x in values.ravel())
        return fit(states, values, **options)

    agent._V.fit = listen
    Core(agent, task).learn(n_episodes=2, n_episodes_per_fit=episodes_per_fit, quiet=True)
    return targets


def show(text, targets):
    first = " ".join(f"{x:.0f}" for x in targets[:HORIZON])
    second = " ".join(f"{x:.0f}" for x in targets[HORIZON:])
    print(f"the critic's targets, {text}: {first} | {second}")


names = ("mushroom-rl", "torch", "numpy")
print("Python", platform.python_version(), *(f"{name} {version(name)}" for name in names))
together = critic_targets(2)
alone = critic_targets(1)
show("both in one fit", together)
show("one in each fit", alone)

assert alone[:HORIZON] == [0] * HORIZON
assert np.allclose(together[HORIZON:], alone[HORIZON:])
crossing = [0.99**k * together[HORIZON] for k in range(HORIZON, 0, -1)]
assert np.allclose(together[:HORIZON], crossing), "changed: the returns end at a time limit now"
PY
"$work/venv/bin/python" -W ignore "$work/show.py"
