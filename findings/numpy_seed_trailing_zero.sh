#!/usr/bin/env bash
# numpy: the seeds 5, [5], [5, 0] and [5, 0, 0] all start the same random stream.
#
# Who meets it: an RL programmer who seeds the agent with default_rng(seed) and the
# environments with default_rng([seed, env]) or default_rng([seed, env, episode]).
# Environment 0 then draws exactly the numbers of the agent: exploration and start
# states move together. All other environments are fine, so it is hard to see.
#
# The guess: a list of numbers is a key. Keys of different length are different keys.
#
# The behaviour: a short seed is filled up with zeros, so zeros at the end do not count
# (up to four 32-bit words). A large number is cut into 32-bit words first, so 2**32 and
# [0, 1] are the same seed too. spawn_key=(0,) is kept apart and gives another stream.
#
# Seen on 2026-11-28 with Python 3.11.7 and numpy 2.4.6:
#   5               [670, 805, 22]
#   [5]             [670, 805, 22]
#   [5, 0]          [670, 805, 22]
#   [5, 0, 0]       [670, 805, 22]
#   [5, 1]          [132, 774, 778]
#   spawn_key=(0,)  [220, 403, 968]
#   2**32           [522, 889, 992]
#   [0, 1]          [522, 889, 992]
set -euo pipefail

work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install -qq --no-compile --disable-pip-version-check numpy==2.4.6

cat > "$work/show.py" <<'PY'
import platform

import numpy as np


def draw(name, seed):
    numbers = np.random.default_rng(seed).integers(0, 1000, 3).tolist()
    print(f"{name:15} {numbers}")
    return numbers


print("Python", platform.python_version(), "numpy", np.__version__)
agent = draw("5", 5)
one = draw("[5]", [5])
env_0 = draw("[5, 0]", [5, 0])
env_0_episode_0 = draw("[5, 0, 0]", [5, 0, 0])
env_1 = draw("[5, 1]", [5, 1])
child = draw("spawn_key=(0,)", np.random.SeedSequence(5, spawn_key=(0,)))
large = draw("2**32", 2**32)
words = draw("[0, 1]", [0, 1])

assert agent == one == env_0 == env_0_episode_0, "changed: zeros at the end count now"
assert agent != env_1 and agent != child
assert large == words, "changed: a large seed is no longer a list of 32-bit words"
PY
"$work/venv/bin/python" "$work/show.py"
