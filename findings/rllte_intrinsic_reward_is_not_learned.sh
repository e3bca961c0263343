#!/usr/bin/env bash
# RLLTE: agent.set(reward=...) computes intrinsic rewards, but no agent learns from them.
#
# Who meets it: somebody who gives one of its agents an exploration bonus (ICM, RND, RE3 ...), the
# purpose of the library's rllte.xplore.reward, and compares it with the agent alone.
#
# The guess: the bonus is added to the rewards before the returns are computed (PPO) or before the
# transition is stored (SAC). With pretraining=True the bonus is all that is learned.
#
# The behaviour: PPO adds the bonus to the stored rewards after it has computed the returns, and
# never reads the rewards again. SAC adds it to an array of which the storage already has a copy.
# The weights after training are those without a bonus, to the last bit. With pretraining=True the
# task's reward is 0, so the agent learns from nothing: a bonus and its negative give the same.
#
# Seen on 2026-11-29 with Python 3.11.7, rllte-core 1.0.1, torch 2.5.1, gymnasium 0.29.1, numpy 1.26.4,
# Pendulum-v1. The bonus is 1000 times the first number of the next observation:
#   PPO: the bonus was computed 32 times, largest difference of a weight 0
#   PPO: the task itself pays the bonus, largest difference of a weight 0.12
#   SAC: the bonus was computed 600 times, largest difference of a weight 0
#   SAC: the task itself pays the bonus, largest difference of a weight 0.072
#   PPO, pretraining=True: bonus and negative bonus, largest difference of a weight 0
set -euo pipefail

work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install -qq --no-compile --disable-pip-version-check \
    rllte-core==1.0.1 torch==2.5.1 torchvision==0.20.1 gymnasium==0.29.1 numpy==1.26.4

cat > "$work/show.py" <<'PY'
import platform
from importlib.metadata import version
from itertools import count

import gymnasium
import torch
from rllte.agent import PPO, SAC
from rllte.common.prototype import BaseReward
from rllte.env import make_rllte_env

SMALL = {"batch_size": 32, "hidden_dim": 16}
SETTINGS = {
    PPO: (2048, {"num_steps": 64, **SMALL}),
    SAC: (600, {"num_init_steps": 200, **SMALL}),
}
runs = count()


class Bonus(BaseReward):
    """factor times the first number of the next observation. It draws no random numbers."""

    def __init__(self, envs, factor):
        super().__init__(envs, rwd_norm_type="none", obs_norm_type="none")
        self.factor = factor
        self.calls = 0

    def compute(self, samples, sync=True):
        super().compute(samples, sync)
        self.calls += 1
        return self.factor * samples["next_observations"][..., 0]

    def update(self, samples):
        pass


class PaidByTask(gymnasium.Wrapper):
    def step(self, action):
        observation, reward, terminated, truncated, info = self.env.step(action)
        return observation, reward + 1000.0 * float(observation[0]), terminated, truncated, info


def weights(agent_class, bonus=None, paid_by_task=False, pretraining=False):
    """Train on Pendulum. Return all weights, and how often the bonus was computed."""

    def make(**_):
        env = gymnasium.make("Pendulum-v1")
        return PaidByTask(env) if paid_by_task else env

    steps, options = SETTINGS[agent_class]
    env = make_rllte_env(make, num_envs=1, seed=1, asynchronous=False)
    tag = f"run{next(runs)}"
    agent = agent_class(env=env, device="cpu", seed=1, tag=tag, pretraining=pretraining, **options)
    env.action_space.seed(1)
    reward = Bonus(env, bonus or 0.0)
    if bonus is not None:
        agent.set(reward=reward)
    agent.train(num_train_steps=steps, log_interval=10**9, save_interval=10**9)
    return torch.cat([p.detach().flatten() for p in agent.policy.parameters()]), reward.calls


def difference(a, b):
    return float((a - b).abs().max())


torch.set_num_threads(1)
names = ("rllte-core", "torch", "gymnasium", "numpy")
lines = [" ".join(["Python", platform.python_version(), *(f"{name} {version(name)}" for name in names)])]
for agent_class in (PPO, SAC):
    name = agent_class.__name__
    plain, _ = weights(agent_class)
    again, _ = weights(agent_class)
    with_bonus, calls = weights(agent_class, bonus=1000.0)
    paid, _ = weights(agent_class, paid_by_task=True)
    by_bonus, by_task = difference(plain, with_bonus), difference(plain, paid)
    lines.append(f"{name}: the bonus was computed {calls} times, largest difference of a weight {by_bonus:.2g}")
    lines.append(f"{name}: the task itself pays the bonus, largest difference of a weight {by_task:.2g}")
    assert difference(plain, again) == 0
    assert calls > 0 and by_task > 0.01
    assert by_bonus == 0, f"changed: {name} learns from the bonus now"
plus, _ = weights(PPO, bonus=1000.0, pretraining=True)
minus, _ = weights(PPO, bonus=-1000.0, pretraining=True)
opposite = difference(plus, minus)
lines.append(f"PPO, pretraining=True: bonus and negative bonus, largest difference of a weight {opposite:.2g}")
assert opposite == 0, "changed: pretraining learns from the bonus now"
print("\n".join(lines))
PY
cd "$work"  # RLLTE writes its logs where it runs
"$work/venv/bin/python" -W ignore "$work/show.py" 2> "$work/log" | grep -v "INFO\|DEBUG" || { tail -5 "$work/log"; exit 1; }
