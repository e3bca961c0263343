#!/usr/bin/env bash
# RSL-RL: a weight of the curiosity reward that should fall from 1 to 0.1 rises from 0.02 to 0.1.
#
# Who meets it: somebody who trains a robot with PPO and its random network distillation (RND), and
# gives the bonus a schedule, so that it fades out.
#
# The guess: weight 1 with final_value 0.1 falls from 1 to 0.1. If the library converts rewards to
# the length of a control step, it converts both ends.
#
# The behaviour: only the weight at the start is multiplied by the environment's step_dt, 0.02 s for
# a controller of 50 Hz. The value at the end is used as it is given. So the bonus is largest at
# the end of the training, where it should be smallest. An end below weight * step_dt, such as 0,
# hides it. Multiply final_value by step_dt yourself.
#
# Seen on 2026-11-30 with Python 3.11.7, rsl-rl-lib 5.5.1, torch 2.13.0, tensordict 0.15.3. The weight
# after every 50 of 250 steps, for a schedule over 200 steps from 1 to 0.1:
#   step_dt 1:    0.775 0.55 0.325 0.1 0.1
#   step_dt 0.02: 0.04 0.06 0.08 0.1 0.1
set -euo pipefail

work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install -qq --no-compile --disable-pip-version-check \
    rsl-rl-lib==5.5.1 torch==2.13.0 tensordict==0.15.3

cat > "$work/show.py" <<'PY'
import contextlib
import os
import platform
from importlib.metadata import version

import torch
from rsl_rl.env import VecEnv
from rsl_rl.runners import OnPolicyRunner
from tensordict import TensorDict

ROBOTS = 4


class Robots(VecEnv):
    """Random observations, no reward, episodes of 20 steps."""

    num_envs = ROBOTS
    num_actions = 1
    max_episode_length = 20
    device = "cpu"
    cfg = {}

    def __init__(self, step_dt):
        self.step_dt = step_dt  # seconds of a control step
        self.episode_length_buf = torch.zeros(ROBOTS, dtype=torch.long)

    @property
    def unwrapped(self):
        return self

    def get_observations(self):
        return TensorDict({"policy": torch.randn(ROBOTS, 3)}, batch_size=[ROBOTS])

    def step(self, actions):
        self.episode_length_buf += 1
        done = self.episode_length_buf >= self.max_episode_length
        self.episode_length_buf[done] = 0
        return self.get_observations(), torch.zeros(ROBOTS), done, {"time_outs": done}


def weights(step_dt):
    """The weight of the curiosity reward after every 50 steps."""
    network = {"class_name": "MLPModel", "hidden_dims": [16], "activation": "elu"}
    schedule = {"mode": "linear", "initial_step": 0, "final_step": 200, "final_value": 0.1}
    curiosity = {
        "num_outputs": 4,
        "predictor_hidden_dims": [16],
        "target_hidden_dims": [16],
        "weight": 1.0,
        "weight_schedule": schedule,
    }
    config = {
        "num_steps_per_env": 10,
        "save_interval": 1000,
        "obs_groups": {"actor": ["policy"], "critic": ["policy"], "rnd_state": ["policy"]},
        "actor": {**network, "distribution_cfg": {"class_name": "GaussianDistribution"}},
        "critic": network,
        "algorithm": {"class_name": "PPO", "rnd_cfg": curiosity},
    }
    runner = OnPolicyRunner(Robots(step_dt), config)
    found = []
    for _ in range(5):
        runner.learn(5)  # iterations of 10 steps
        found.append(round(runner.alg.rnd.weight, 4))
    return found


names = ("rsl-rl-lib", "torch", "tensordict")
with open(os.devnull, "w") as nowhere, contextlib.redirect_stdout(nowhere):
    second = weights(1.0)
    fiftieth = weights(0.02)
print("Python", platform.python_version(), *(f"{name} {version(name)}" for name in names))
print("step_dt 1:   ", *second)
print("step_dt 0.02:", *fiftieth)

assert second == sorted(second, reverse=True) and second[-1] == 0.1
assert fiftieth == sorted(fiftieth) and fiftieth[-1] == 0.1, "changed: both ends are converted now"
PY
"$work/venv/bin/python" -W ignore "$work/show.py"
