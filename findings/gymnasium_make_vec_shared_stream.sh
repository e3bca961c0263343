#!/usr/bin/env bash
# gymnasium.make_vec("CartPole-v1"): the environments share one random stream, so what one
# environment does changes where the next episode of another one starts.
#
# Who meets it: somebody who moves from SyncVectorEnv to make_vec and keeps the seed.
#
# The guess: environment i gets seed + i, as in SyncVectorEnv, and needs no neighbour.
#
# The behaviour: without a vectorization_mode, make_vec picks the special CartPoleVectorEnv.
# It has one generator for all. Environment 0 of two starts in another place, and its second
# start depends on what environment 1 did. vectorization_mode="sync" behaves as guessed.
#
# Seen on 2026-11-28 with Python 3.11.7, gymnasium 1.4.0, numpy 2.4.6:
#   single environment, seed 0:   [0.0137, -0.023, -0.0459, -0.0483]
#   default: CartPoleVectorEnv
#     first start of env 0:       [0.0137, -0.0459, 0.0313, 0.0107]
#     second start, neighbour A:  [0.0357, -0.0466, 0.023, -0.0324]
#     second start, neighbour B:  [0.0044, 0.0435, 0.0316, -0.0497]
#   sync: SyncVectorEnv
#     first start of env 0:       [0.0137, -0.023, -0.0459, -0.0483]
#     second start, neighbour A:  [0.0313, 0.0413, 0.0107, 0.0229]
#     second start, neighbour B:  [0.0313, 0.0413, 0.0107, 0.0229]
set -euo pipefail

work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install -qq --no-compile --disable-pip-version-check gymnasium==1.4.0 numpy==2.4.6

cat > "$work/show.py" <<'PY'
import platform

import gymnasium as gym
import numpy as np


def starts_of_env_0(mode, neighbour_action):
    """First and second start state of environment 0, which always pushes right."""
    envs = gym.make_vec("CartPole-v1", num_envs=2, vectorization_mode=mode)
    first, _ = envs.reset(seed=0)
    obs, ended, t = first, False, 0
    while not ended:
        obs, _, terminated, _, _ = envs.step(np.array([1, neighbour_action(t)]))
        ended, t = terminated[0], t + 1
    second = envs.step(np.array([1, neighbour_action(t)]))[0]  # this step resets environment 0
    return type(envs.unwrapped).__name__, short(first[0]), short(second[0])


def short(obs):
    return obs.astype(float).round(4).tolist()


print("Python", platform.python_version(), "gymnasium", gym.__version__, "numpy", np.__version__)
single = short(gym.make("CartPole-v1").reset(seed=0)[0])
print("single environment, seed 0:  ", single)
seen = {}
for label, mode in (("default", None), ("sync", "sync")):
    name, first, second_a = starts_of_env_0(mode, lambda t: 0)  # A falls at about the same time
    _, _, second_b = starts_of_env_0(mode, lambda t: t % 2)  # B stays up for longer
    seen[label] = first, second_a, second_b
    print(f"{label}: {name}")
    print("  first start of env 0:      ", first)
    print("  second start, neighbour A: ", second_a)
    print("  second start, neighbour B: ", second_b)

assert seen["sync"][0] == single and seen["sync"][1] == seen["sync"][2]
assert seen["default"][0] != single, "changed: environment 0 starts like a single one"
assert seen["default"][1] != seen["default"][2], "changed: the neighbour does not matter now"
PY
"$work/venv/bin/python" "$work/show.py"
