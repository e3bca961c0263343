#!/usr/bin/env bash
# SuperSuit with Stable-Baselines3: a time limit of a PettingZoo task counts as an end of the task.
#
# Who meets it: somebody who trains on a PettingZoo task with Stable-Baselines3, by the usual way,
# pettingzoo_env_to_vec_env_v1 and concat_vec_envs_v1(..., base_class="stable_baselines3").
#
# The guess: Stable-Baselines3 handles time limits by itself. Its buffer stores done = 0 there, so
# the value of the last observation still counts. It does so for gymnasium tasks.
#
# The behaviour: Stable-Baselines3 learns of a time limit from info["TimeLimit.truncated"] alone.
# SuperSuit hands the last observation on, as info["terminal_observation"], but not this flag. So
# each time limit is stored as done = 1: the learner believes that no reward can follow.
#
# Seen on 2026-11-29 with Python 3.11.7, supersuit 3.11.0, pettingzoo 1.27.0, stable-baselines3
# 2.9.2, gymnasium 1.4.0, torch 2.13.0; the same task of three steps, which only a limit ends:
#   by gymnasium: info ['TimeLimit.truncated', 'episode', 'terminal_observation'], largest done 0.0
#   by SuperSuit: info ['terminal_observation'], largest done 1.0
set -euo pipefail

work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install -qq --no-compile --disable-pip-version-check supersuit==3.11.0 pettingzoo==1.27.0 \
    stable-baselines3==2.9.2 gymnasium==1.4.0 torch==2.13.0 numpy==2.4.6

cat > "$work/show.py" <<'PY'
import platform
from importlib.metadata import version

import gymnasium as gym
import numpy as np
import supersuit
from pettingzoo import ParallelEnv
from stable_baselines3 import DQN

LIMIT = 3
OBSERVATIONS = gym.spaces.Box(0, 10, (1,))
ACTIONS = gym.spaces.Discrete(2)


class Counting(gym.Env):
    """Observes how many steps were taken. It never ends by itself."""

    observation_space = OBSERVATIONS
    action_space = ACTIONS

    def reset(self, seed=None, options=None):
        self.steps = 0
        return np.float32([self.steps]), {}

    def step(self, action):
        self.steps += 1
        return np.float32([self.steps]), 1.0, False, False, {}


class CountingForOne(ParallelEnv):
    """The same for PettingZoo, with one agent and its own limit."""

    metadata = {"name": "counting"}
    render_mode = None
    possible_agents = ["one"]

    def observation_space(self, agent):
        return OBSERVATIONS

    def action_space(self, agent):
        return ACTIONS

    def reset(self, seed=None, options=None):
        self.agents = ["one"]
        self.steps = 0
        return {"one": np.float32([0])}, {"one": {}}

    def step(self, actions):
        self.steps += 1
        limit = self.steps == LIMIT
        self.agents = [] if limit else ["one"]
        return {"one": np.float32([self.steps])}, {"one": 1.0}, {"one": False}, {"one": limit}, {"one": {}}


def train(label, env):
    """Collect 30 random steps as DQN does. Show the info at the limit and what `done` a batch has."""
    model = DQN("MlpPolicy", env, learning_starts=1000, buffer_size=30, device="cpu").learn(30)
    env = model.get_env()
    env.reset()
    for _ in range(LIMIT):
        *_, infos = env.step(np.array([0]))
    info = sorted(infos[0])
    done = float(model.replay_buffer.sample(500).dones.max())
    print(f"{label} info {info}, largest done {done}")
    return info, done


names = ("supersuit", "pettingzoo", "stable-baselines3", "gymnasium", "torch")
print("Python", platform.python_version(), *(f"{name} {version(name)}" for name in names))
own = train("by gymnasium:", gym.wrappers.TimeLimit(Counting(), LIMIT))
vector = supersuit.pettingzoo_env_to_vec_env_v1(CountingForOne())
theirs = train("by SuperSuit:", supersuit.concat_vec_envs_v1(vector, 1, base_class="stable_baselines3"))

assert "TimeLimit.truncated" in own[0] and own[1] == 0
assert theirs == (["terminal_observation"], 1), "changed: SuperSuit tells of time limits"
PY
"$work/venv/bin/python" -W ignore "$work/show.py"
