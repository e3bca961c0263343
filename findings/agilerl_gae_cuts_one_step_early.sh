#!/usr/bin/env bash
# AgileRL: PPO's rollout buffer ends each episode one step early when it computes advantages.
#
# Who meets it: everybody who trains AgileRL's PPO with GAE, its default. It hurts most where the
# reward comes with the last step: a goal, a win, a crash.
#
# The guess: `done` of a row says that this row's step ended the episode. With lambda 1, gamma 1
# and values 0, the return of each step is the sum of the rewards from it to its episode's end.
#
# The behaviour: collect_rollouts stores the flag of the step just taken. The GAE loop masks row t
# with the flag of row t + 1, which is right only where a flag tells that an observation begins an
# episode. So the last reward of an episode reaches no earlier step, and the last step itself
# takes over what the next episode's first step earns. The same function without GAE is right.
#
# Seen on 2026-11-29 with Python 3.11.7, agilerl 2.58.0 (it needs peft, but does not say so), torch
# 2.13.0, gymnasium 1.0.0, numpy 2.4.6:
#   collect_rollouts stored rewards 0 0 1 and dones 0 0 1
#   two episodes of three steps, rewards 0 0 1 and 7 0 10:
#   use_gae=True:   0 0 8 7 0 10
#   use_gae=False:  1 1 1 17 10 10
#   right:          1 1 1 17 10 10
set -euo pipefail

work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install -qq --no-compile --disable-pip-version-check \
    agilerl==2.58.0 peft==0.21.0 torch==2.13.0 gymnasium==1.0.0 numpy==2.4.6

cat > "$work/show.py" <<'PY'
import platform
from importlib.metadata import version

import gymnasium
import numpy as np
import torch
from agilerl.algorithms import PPO
from agilerl.components.rollout_buffer import RolloutBuffer
from agilerl.rollouts import collect_rollouts
from gymnasium.spaces import Box, Discrete

REWARDS = (0, 0, 1, 7, 0, 10)
DONES = (0, 0, 1, 0, 0, 1)
RIGHT = [1, 1, 1, 17, 10, 10]


class ThreeSteps(gymnasium.Env):
    """Three steps. The last one pays 1."""

    observation_space = Box(-1, 1, (1,), np.float32)
    action_space = Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.steps += 1
        last = self.steps == 3
        return np.zeros(1, np.float32), float(last), last, False, {}


def returns(use_gae):
    buffer = RolloutBuffer(
        capacity=6,
        num_envs=1,
        observation_space=ThreeSteps.observation_space,
        action_space=ThreeSteps.action_space,
        use_gae=use_gae,
        gae_lambda=1.0,
        gamma=1.0,
    )
    for reward, done in zip(REWARDS, DONES):
        buffer.add(
            obs=np.zeros((1, 1)),
            action=np.zeros(1),
            reward=np.array([reward]),
            done=np.array([done]),
            value=np.zeros(1),
            log_prob=np.zeros(1),
            next_obs=np.zeros((1, 1)),
        )
    buffer.compute_returns_and_advantages(last_value=np.zeros(1), last_done=np.array([1]))
    return [round(float(x), 3) for x in buffer.buffer["returns"].flatten()]


def short(numbers):
    return " ".join(f"{x:g}" for x in numbers)


names = ("agilerl", "torch", "gymnasium", "numpy")
print("Python", platform.python_version(), *(f"{name} {version(name)}" for name in names))
torch.manual_seed(0)
env = gymnasium.vector.SyncVectorEnv([ThreeSteps])
agent = PPO(env.single_observation_space, env.single_action_space, num_envs=1, learn_step=8, batch_size=4)
collect_rollouts(agent, env)
stored = agent.rollout_buffer.buffer
rewards = stored["rewards"].flatten()[:3].tolist()
dones = stored["dones"].flatten()[:3].float().tolist()
print("collect_rollouts stored rewards", short(rewards), "and dones", short(dones))
with_gae = returns(True)
without = returns(False)
print("two episodes of three steps, rewards 0 0 1 and 7 0 10:")
print("use_gae=True:  ", short(with_gae))
print("use_gae=False: ", short(without))
print("right:         ", short(RIGHT))

assert rewards == dones == [0, 0, 1], "changed: other flags are stored"
assert without == RIGHT
assert with_gae == [0, 0, 8, 7, 0, 10], "changed: GAE uses the flag of the step itself now"
PY
"$work/venv/bin/python" -W ignore "$work/show.py"
