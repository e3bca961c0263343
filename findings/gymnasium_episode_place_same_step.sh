#!/usr/bin/env bash
# gymnasium: with SAME_STEP autoreset, the two RecordEpisodeStatistics wrappers put the
# episode's return in different places of infos.
#
# Who meets it: somebody who logs episode returns from a vector environment, and moves the
# wrapper from each environment to the whole vector (or back), or changes the autoreset mode.
# The training runs, but the log shows no episodes.
#
# The guess: both wrappers have the same name and purpose, so they report in the same place.
# In the NEXT_STEP mode they do: infos["episode"].
#
# The behaviour: in the SAME_STEP mode, the wrapper of a single environment reports in
# infos["final_info"]["episode"], and the wrapper of the vector in infos["episode"]. The mask
# "_r" that belongs to "r" exists only for the first one, in both modes.
#
# Seen on 2026-11-28 with Python 3.11.7, gymnasium 1.4.0, numpy 2.4.6:
#   NEXT_STEP, wrapper on each env:  infos["episode"], keys ['_l', '_r', '_t', 'l', 'r', 't']
#   NEXT_STEP, wrapper on vector:    infos["episode"], keys ['l', 'r', 't']
#   SAME_STEP, wrapper on each env:  infos["final_info"]["episode"], keys ['_l', '_r', '_t', 'l', 'r', 't']
#   SAME_STEP, wrapper on vector:    infos["episode"], keys ['l', 'r', 't']
set -euo pipefail

work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install -qq --no-compile --disable-pip-version-check gymnasium==1.4.0 numpy==2.4.6

cat > "$work/show.py" <<'PY'
import platform

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import RecordEpisodeStatistics as ForOne
from gymnasium.wrappers.vector import RecordEpisodeStatistics as ForVector


def cartpole():
    return gym.make("CartPole-v1", max_episode_steps=3)


def vector(mode, place):
    if place == "each env":
        return SyncVectorEnv([lambda: ForOne(cartpole())] * 2, autoreset_mode=mode)
    return ForVector(SyncVectorEnv([cartpole] * 2, autoreset_mode=mode))


print("Python", platform.python_version(), "gymnasium", gym.__version__, "numpy", np.__version__)
seen = {}
for mode in (AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP):
    for place in ("each env", "vector"):
        envs = vector(mode, place)
        envs.reset(seed=0)
        for _ in range(3):
            *_, infos = envs.step(np.array([0, 1]))
        holders = {'infos["episode"]': infos, 'infos["final_info"]["episode"]': infos.get("final_info", {})}
        found = {name: sorted(info["episode"]) for name, info in holders.items() if "episode" in info}
        (where, keys), = found.items()  # exactly one place
        seen[mode.name, place] = where, "_r" in keys
        print(f"{mode.name}, wrapper on {place + ':':10} {where}, keys {keys}")

top, inner = holders
assert seen["NEXT_STEP", "each env"] == (top, True) and seen["NEXT_STEP", "vector"] == (top, False)
assert seen["SAME_STEP", "each env"] == (inner, True), "changed: the single wrapper"
assert seen["SAME_STEP", "vector"] == (top, False), "changed: the vector wrapper"
PY
"$work/venv/bin/python" "$work/show.py"
