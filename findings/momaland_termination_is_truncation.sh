#!/usr/bin/env bash
# MOMAland: four tasks return terminations and truncations in each other's place.
#
# Who meets it: somebody who learns values on them: item gathering, beach, route choice or gem
# mining. Only the flag "terminated" may cut the bootstrap.
#
# The guess: step() returns observations, rewards, terminations, truncations, infos, as in
# PettingZoo and in its own docstring. A time limit is a truncation. Route choice has episodes of
# one step, and its documentation says that they terminate.
#
# The behaviour: the two dicts are swapped. A time limit cuts the bootstrap. An end of the task
# does not: in route choice a learner adds gamma times the value of a state that never comes, and
# its values run towards r / (1 - gamma) instead of r. Whoever joins both flags by "or" sees
# nothing.
#
# Seen on 2026-11-30 with Python 3.11.7, momaland 0.2.0, pettingzoo 1.25.0, gymnasium 1.1.1, numpy 2.2.6:
#   item gathering, time limit of 5 steps:  step 5, terminated True, truncated False
#   item gathering, all items are gathered: step 47, terminated False, truncated True
#   route choice, one step:                 step 1, terminated False, truncated True
#   beach, its 3 steps:                     step 3, terminated False, truncated True
#   gem mining, one step:                   step 1, terminated False, truncated True
#   route choice, rewards between -0.67 and -0.40, values with gamma 0.9:
#     bootstrap where not terminated: -4.85 -4.96 -4.96
#     the two flags exchanged:        -0.49 -0.58 -0.57
set -euo pipefail

work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install -qq --no-compile --disable-pip-version-check \
    pettingzoo==1.25.0 gymnasium==1.1.1 numpy==2.2.6 \
    networkx==3.3 sympy==1.14.0 pygame==2.6.1 pillow==12.0.0
# numpy 2.2: gem mining raises an error with 2.4.
# --no-deps: momaland also asks for simulators that these tasks do not use.
"$work/venv/bin/pip" install -qq --no-compile --no-deps --disable-pip-version-check momaland==0.2.0

cat > "$work/show.py" <<'PY'
import platform
from importlib.metadata import version

import numpy as np
from momaland.envs.beach import mobeach_v0
from momaland.envs.gem_mining import mogem_mining_v0
from momaland.envs.item_gathering import moitem_gathering_v0
from momaland.envs.route_choice import moroute_choice_v0

GAMMA = 0.9
generator = np.random.default_rng(0)


def random_action(env, agent):
    return int(generator.integers(env.action_space(agent).n))


def stand_still(env, agent):
    return 0


def end_of_episode(env, choose):
    """Play one episode. Return its length, and both flags of its last step."""
    env.reset(seed=0)
    steps = 0
    while True:
        actions = {agent: choose(env, agent) for agent in env.agents}
        _, _, terminations, truncations, _ = env.step(actions)
        steps += 1
        terminated = all(terminations.values())
        truncated = all(truncations.values())
        if terminated or truncated:
            return steps, terminated, truncated


def learn(exchanged, episodes=3000):
    """Q values of the first driver: one state, one step an episode."""
    env = moroute_choice_v0.parallel_env(num_agents=5)
    env.reset(seed=0)
    drivers = list(env.agents)
    first = drivers[0]
    q = np.zeros(env.action_space(first).n)
    rewards = []
    for _ in range(episodes):
        env.reset()
        actions = {driver: random_action(env, driver) for driver in drivers}
        _, reward, terminations, truncations, _ = env.step(actions)
        flags = truncations if exchanged else terminations
        r = float(reward[first].sum())
        target = r + GAMMA * (1 - flags[first]) * q.max()
        q[actions[first]] += 0.05 * (target - q[actions[first]])
        rewards.append(r)
    return q, rewards


names = ("momaland", "pettingzoo", "gymnasium", "numpy")
print("Python", platform.python_version(), *(f"{name} {version(name)}" for name in names))
limit = end_of_episode(moitem_gathering_v0.parallel_env(num_timesteps=5), stand_still)
gathered = end_of_episode(moitem_gathering_v0.parallel_env(num_timesteps=10_000), random_action)
route = end_of_episode(moroute_choice_v0.parallel_env(), random_action)
beach = end_of_episode(mobeach_v0.parallel_env(num_timesteps=3), random_action)
mining = end_of_episode(mogem_mining_v0.parallel_env(), random_action)
print("item gathering, time limit of 5 steps:  step {}, terminated {}, truncated {}".format(*limit))
print("item gathering, all items are gathered: step {}, terminated {}, truncated {}".format(*gathered))
print("route choice, one step:                 step {}, terminated {}, truncated {}".format(*route))
print("beach, its 3 steps:                     step {}, terminated {}, truncated {}".format(*beach))
print("gem mining, one step:                   step {}, terminated {}, truncated {}".format(*mining))
given, rewards = learn(exchanged=False)
right, _ = learn(exchanged=True)
low, high = min(rewards), max(rewards)
print(f"route choice, rewards between {low:.2f} and {high:.2f}, values with gamma 0.9:")
print("  bootstrap where not terminated:", *(f"{x:.2f}" for x in given))
print("  the two flags exchanged:       ", *(f"{x:.2f}" for x in right))

assert limit == (5, True, False), "changed: a time limit is a truncation now"
assert gathered[0] < 10_000 and gathered[1:] == (False, True), "changed: the end is a termination now"
assert route == mining == (1, False, True), "changed: the end is a termination now"
assert beach == (3, False, True), "changed: the end is a termination now"
assert given.max() < low < right.min() <= right.max() < high
PY
SDL_VIDEODRIVER=dummy "$work/venv/bin/python" -W ignore "$work/show.py"
