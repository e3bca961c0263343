#!/usr/bin/env bash
# highway-env: env.reset() replaces the action space by a new one, so its seed is lost.
#
# Who meets it: somebody who trains DQN on highway-env, and seeds the run as most programs do:
# env.action_space.seed(seed) once after making it, then env.reset(seed=seed). The random actions
# of the warm-up and of epsilon-greedy exploration come from env.action_space.sample().
#
# The guess: the action space of a task stays the same object, and its stream goes on over the
# episodes. The same two seeds give the same random actions, and so the same first episode.
#
# The behaviour: each reset() builds a new action space, which nobody has seeded. The first sample
# after reset() is different in every run, although the task itself is seeded well: with a fixed
# list of actions, two runs agree in every number. A seed given before the first reset() has no
# effect, and one given after it lasts for one episode. A reference to the old action space,
# taken before reset(), keeps its stream: use that one, or a generator of your own.
#
# Seen on 2026-11-29 with Python 3.11.7, highway-env 1.12.1, gymnasium 1.4.0, numpy 2.4.6:
#   CartPole-v1: same action space after reset: True, two runs with the same seeds:
#     same first observation: True, same after one fixed action: True
#     same 40 random actions: True
#   highway-fast-v0: same action space after reset: False, two runs with the same seeds:
#     same first observation: True, same after one fixed action: True
#     same 40 random actions: False
#     same 40 random actions from the action space before reset: True
set -euo pipefail

work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install -qq --no-compile --disable-pip-version-check \
    highway-env==1.12.1 gymnasium==1.4.0 numpy==2.4.6

cat > "$work/show.py" <<'PY'
import platform
from importlib.metadata import version

import gymnasium
import highway_env
import numpy as np

gymnasium.register_envs(highway_env)


def seeded(task):
    """Make and seed a task as most programs do. Return it with the action spaces before and after."""
    env = gymnasium.make(task)
    before = env.action_space
    env.action_space.seed(5)
    observation, _ = env.reset(seed=5)
    return env, before, env.action_space, observation


def show(task):
    runs = [seeded(task) for _ in range(2)]
    same_object = runs[0][1] is runs[0][2]
    same_start = np.array_equal(runs[0][3], runs[1][3])
    current = [[int(env.action_space.sample()) for _ in range(40)] for env, *_ in runs]
    same_actions = current[0] == current[1]
    ends = [env.step(1)[0] for env, *_ in runs]
    print(f"{task}: same action space after reset: {same_object}, two runs with the same seeds:")
    same_step = np.array_equal(*ends)
    print(f"  same first observation: {same_start}, same after one fixed action: {same_step}")
    print(f"  same 40 random actions: {same_actions}")
    assert same_start and same_step
    if not same_object:
        old = [[int(space.sample()) for _ in range(40)] for _, space, *_ in runs]
        print(f"  same 40 random actions from the action space before reset: {old[0] == old[1]}")
        assert old[0] == old[1]
    return same_object, same_actions


print("Python", platform.python_version(), "highway-env", version("highway-env"), end=" ")
print("gymnasium", gymnasium.__version__, "numpy", np.__version__)
assert show("CartPole-v1") == (True, True)
assert show("highway-fast-v0") == (False, False), "changed: the action space keeps its seed now"
PY
"$work/venv/bin/python" -W ignore "$work/show.py"
