#!/usr/bin/env bash
# SBX: each load() sets the agent up again. DQN's target_update_interval shrinks, PPO forgets its rate.
#
# Who meets it: somebody who saves an agent and trains it on later, DQN with several environments,
# or PPO whose learning rate follows target_kl.
#
# The guess: after save and load the agent goes on with what it had.
#
# The behaviour: load() calls the set-up once more, on values that are already set up. DQN divides
# target_update_interval by the number of environments to count its own steps. Each load divides it
# again, until the target network is a plain copy. PPO adapts its learning rate and loads it with
# the optimizer. But it also makes a new controller, which begins at the first learning rate and
# writes over it in the next update. (Stable-Baselines3 once had the fault of DQN, and mended it.)
#
# Seen on 2026-11-30 with Python 3.11.7, sbx-rl 0.28.0, stable-baselines3 2.9.2, jax 0.10.2,
# gymnasium 1.4.0, four environments:
#   DQN, target_update_interval=400: 100, after each of three loads 25 6 1
#   PPO, learning_rate=0.01, target_kl=0.001: adapted to 0.00017
#     the controller after load: 0.01, the optimizer: 0.00017
#     one epoch later: 0.00088 without save and load, 0.0044 with them
set -euo pipefail

work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install -qq --no-compile --disable-pip-version-check \
    sbx-rl==0.28.0 stable-baselines3==2.9.2 jax==0.10.2 jaxlib==0.10.2 torch==2.13.0 gymnasium==1.4.0

cat > "$work/show.py" <<'PY'
import platform
import sys
from importlib.metadata import version

from sbx import DQN, PPO
from stable_baselines3.common.env_util import make_vec_env

folder = sys.argv[1]


def optimizer_rate(agent):
    return float(agent.policy.actor_state.opt_state[1].hyperparams["learning_rate"])


names = ("sbx-rl", "stable-baselines3", "jax", "gymnasium")
print("Python", platform.python_version(), *(f"{name} {version(name)}" for name in names))

env = make_vec_env("CartPole-v1", n_envs=4, seed=0)
agent = DQN("MlpPolicy", env, target_update_interval=400, seed=0)
intervals = [agent.target_update_interval]
for _ in range(3):
    agent.save(f"{folder}/dqn")
    agent = DQN.load(f"{folder}/dqn", env=env)
    intervals.append(agent.target_update_interval)
print(f"DQN, target_update_interval=400: {intervals[0]}, after each of three loads", *intervals[1:])

env = make_vec_env("Pendulum-v1", n_envs=4, seed=0)
settings = {"n_steps": 256, "batch_size": 256, "n_epochs": 4, "learning_rate": 0.01, "target_kl": 0.001}
agent = PPO("MlpPolicy", env, seed=0, **settings)
agent.learn(10 * 1024)
adapted = optimizer_rate(agent)
same = agent.adaptive_lr.current_adaptive_lr
agent.save(f"{folder}/ppo")
loaded = PPO.load(f"{folder}/ppo", env=env)
controller = loaded.adaptive_lr.current_adaptive_lr
optimizer = optimizer_rate(loaded)
print(f"PPO, learning_rate=0.01, target_kl=0.001: adapted to {adapted:.2g}")
print(f"  the controller after load: {controller:.2g}, the optimizer: {optimizer:.2g}")
for each in (agent, loaded):
    each.n_epochs = 1
    each.learn(1024, reset_num_timesteps=False)
went_on, resumed = optimizer_rate(agent), optimizer_rate(loaded)
print(f"  one epoch later: {went_on:.2g} without save and load, {resumed:.2g} with them")

assert intervals == [100, 25, 6, 1], "changed: load() leaves the interval as it is now"
assert abs(same / adapted - 1) < 1e-4 and adapted < 0.005
assert abs(optimizer / adapted - 1) < 1e-4
assert controller == 0.01, "changed: load() brings the controller's rate back now"
assert resumed > 3 * went_on, "changed: the next update keeps the loaded rate now"
PY
JAX_PLATFORMS=cpu "$work/venv/bin/python" -W ignore "$work/show.py" "$work"
