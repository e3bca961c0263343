#!/usr/bin/env bash
# cpprb: with N-step rewards, the last transitions of an episode that a time limit cuts have
# next observations that nobody has seen, and one transition before a real end is not "done".
#
# Who meets it: somebody who takes cpprb's ReplayBuffer with Nstep for DQN or SAC, and calls
# on_episode_end() after each episode, as its documentation asks, also after a time limit.
#
# The guess: on_episode_end() stores the last transitions with shorter sums of rewards, and with
# the episode's last observation as their next one. A transition whose steps reach the end of
# the task has done = 1: nothing may be added to its rewards.
#
# The behaviour, for 3 steps: the rewards are as guessed. But the last two transitions have the
# next observation 1.0 in every place, whatever the task. After a time limit done is 0, so the
# learner takes the value of that made-up state. Where the task itself ends, done is 1 in the last
# two alone. The third last, whose three steps reach the end, too, has done = 0, so a value is
# added after the end.
#
# Seen on 2026-11-29 with Python 3.11.7, cpprb 11.0.0, numpy 2.4.6, observations 100 to 106, then
# 200 to 206; the second episode ends with done = 1:
#   cut by a time limit: obs [100 101 102 103 104 105]
#                   next_obs [103 104 105 106   1   1]
#                       done [0 0 0 0 0 0]
#   ended by the task:   obs [200 201 202 203 204 205]
#                   next_obs [203 204 205 206   1   1]
#                       done [0 0 0 0 1 1]
set -euo pipefail

work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install -qq --no-compile --disable-pip-version-check cpprb==11.0.0 numpy==2.4.6

cat > "$work/show.py" <<'PY'
import platform
from importlib.metadata import version

import numpy as np
from cpprb import ReplayBuffer


def episode(label, first, terminated):
    """Store six steps whose observations count up from `first`. Show what the buffer has of them."""
    columns = {"obs": {}, "rew": {}, "next_obs": {}, "done": {}}
    three_steps = {"size": 3, "gamma": 0.5, "rew": "rew", "next": "next_obs"}
    buffer = ReplayBuffer(100, columns, Nstep=three_steps)
    for step in range(6):
        observation = first + step
        buffer.add(obs=observation, rew=1.0, next_obs=observation + 1, done=terminated and step == 5)
    buffer.on_episode_end()
    stored = {name: rows.ravel() for name, rows in buffer.get_all_transitions().items()}
    assert stored["rew"].tolist() == [1.75, 1.75, 1.75, 1.75, 1.5, 1.0]
    assert stored["obs"].tolist() == [first + step for step in range(6)]
    print(f"{label:20} obs {stored['obs'].astype(int)}")
    print(f"{'next_obs':>24} {stored['next_obs'].astype(int)}")
    print(f"{'done':>24} {stored['done'].astype(int)}")
    return stored["next_obs"].tolist(), stored["done"].tolist()


print("Python", platform.python_version(), "cpprb", version("cpprb"), "numpy", np.__version__)
cut = episode("cut by a time limit:", 100, terminated=False)
ended = episode("ended by the task:", 200, terminated=True)

# Right would be: next observations 103, 104, 105, 106, 106, 106, and done in the last three.
assert cut == ([103, 104, 105, 106, 1, 1], [0] * 6), "changed: the next observations of a cut episode"
assert ended == ([203, 204, 205, 206, 1, 1], [0, 0, 0, 0, 1, 1]), "changed: done of the third last"
PY
"$work/venv/bin/python" "$work/show.py"
