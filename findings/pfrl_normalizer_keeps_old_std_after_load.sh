#!/usr/bin/env bash
# PFRL: an observation normalizer that has been used keeps its old scale after load_state_dict.
#
# Who meets it: somebody who trains PPO or TRPO with EmpiricalNormalization, and after training
# loads the best snapshot into the same agent, to evaluate or to film it.
#
# The guess: mean and variance are buffers, so load_state_dict brings both back. The loaded agent
# is the saved one.
#
# The behaviour: the mean comes back, the scale does not. The module caches 1 / std in a plain
# attribute, and only new data clear it. So the loaded mean is subtracted, and the result is
# divided by the std of the latest data. `std` shows the loaded value, so a look does not tell. The
# same holds for agent.load. A new agent that loads the same files is right, until its next load.
#
# Seen on 2026-11-29 with Python 3.11.7, pfrl 0.4.0, torch 2.13.0, numpy 1.26.4; data N(5, 2²), then
# N(0, 50²); the input is 9:
#   when saved:              1.9148   std 2.06
#   loaded, a new object:    1.9148   std 2.06
#   loaded, the same object: 0.1146   std 2.06
#   PPO's action when saved: 1.9148, after agent.load: 0.1146, of a new agent: 1.9148
# (stderr also has gym's own note that it is unmaintained; pfrl needs packaging, and does not say so)
set -euo pipefail

work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install -qq --no-compile --disable-pip-version-check \
    pfrl==0.4.0 gym==0.26.2 torch==2.13.0 numpy==1.26.4 packaging==26.0

cat > "$work/show.py" <<'PY'
import platform
import sys
from importlib.metadata import version

import numpy as np
import torch
from pfrl.agents import PPO
from pfrl.nn import EmpiricalNormalization
from torch import nn


class Mean(nn.Module):
    """A policy whose mean action is the normalized observation, and a value of 0."""

    def __init__(self):
        super().__init__()
        self.gain = nn.Parameter(torch.ones(1))

    def forward(self, observation):
        density = torch.distributions.Normal(self.gain * observation, torch.ones_like(observation))
        return torch.distributions.Independent(density, 1), torch.zeros(len(observation), 1)


def make_agent():
    model = Mean()
    optimizer = torch.optim.Adam(model.parameters())
    return PPO(model, optimizer, obs_normalizer=EmpiricalNormalization(1), act_deterministically=True)


def action(agent):
    with agent.eval_mode():
        return float(agent.act(np.array([9.0], np.float32))[0])


def normalized(normalizer):
    return float(normalizer(torch.tensor([[9.0]]), update=False))


torch.manual_seed(0)
early = 5 + 2 * torch.randn(1000, 1)
late = 50 * torch.randn(1000, 1)

print("Python", platform.python_version(), "pfrl", version("pfrl"), "torch", version("torch"), end=" ")
print("numpy", np.__version__)
normalizer = EmpiricalNormalization(1)
normalizer(early)
saved = {name: value.clone() for name, value in normalizer.state_dict().items()}
then = normalized(normalizer)
print(f"when saved:              {then:.4f}   std {float(normalizer.std):.2f}")
normalizer(late)
new = EmpiricalNormalization(1)
for name, module in (("a new object:   ", new), ("the same object:", normalizer)):
    module.load_state_dict(saved)
    print(f"loaded, {name} {normalized(module):.4f}   std {float(module.std):.2f}")

agent = make_agent()
agent.obs_normalizer(early)
before = action(agent)
agent.save(sys.argv[1])
agent.obs_normalizer(late)
agent.load(sys.argv[1])
after = action(agent)
other = make_agent()
other.load(sys.argv[1])
print(f"PPO's action when saved: {before:.4f}, after agent.load: {after:.4f}, of a new agent: {action(other):.4f}")

assert normalized(new) == then and action(other) == before
assert normalizer.std == new.std
assert normalized(normalizer) < then / 5, "changed: the scale comes back now"
assert after < before / 5, "changed: agent.load brings the scale back now"
PY
"$work/venv/bin/python" -W ignore "$work/show.py" "$work/agent"
