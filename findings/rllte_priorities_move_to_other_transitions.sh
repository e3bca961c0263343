#!/usr/bin/env bash
# RLLTE: once the prioritized replay is full, each new transition moves all priorities by one.
#
# Who meets it: somebody who trains with its PrioritizedReplayStorage for longer than the storage
# is large. Before that all is right.
#
# The guess: a priority belongs to a transition. A full storage replaces its oldest transition and
# that one's priority. The others keep theirs, and the new one has the largest, so it is soon seen.
#
# The behaviour: the transitions lie in a deque, which moves them all by one when it is full. The
# priorities lie in an array that does not move, and the new one is written where a ring would have
# it. So after one more transition the priority of transition 5 is that of 6, and the new
# transition has the old priority of the last one. An error that is reported fits its transition
# until the next one comes, and then moves on again.
#
# Seen on 2026-11-29 with Python 3.11.7, rllte-core 1.0.1, torch 2.5.1, gymnasium 0.29.1, numpy 1.26.4.
# Eight places, transitions 0 to 7; the priority of 5 is set to 1, of the others to 0.000001:
#   full, drawn: 5
#   after one more, 8, drawn: 1 6, right: 5 8
#   after two more, 8 and 9, drawn: 2 3 7, right: 5 8 9
set -euo pipefail

work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install -qq --no-compile --disable-pip-version-check \
    rllte-core==1.0.1 torch==2.5.1 torchvision==0.20.1 gymnasium==0.29.1 numpy==1.26.4

cat > "$work/show.py" <<'PY'
import platform
from importlib.metadata import version

import numpy as np
import torch
from gymnasium.spaces import Box, Discrete
from rllte.xploit.storage import PrioritizedReplayStorage

SIZE = 8
np.random.seed(0)
storage = PrioritizedReplayStorage(
    Box(-100, 100, (1,)), Discrete(2), storage_size=SIZE, batch_size=4000, alpha=1.0
)


def add(number):
    """A transition whose reward is its number."""
    state = torch.tensor([[float(number)]])
    zero = torch.zeros(1)
    storage.add(state, torch.zeros(1, 1), torch.tensor([float(number)]), zero, zero, {}, state + 1)


def drawn():
    """The transitions that are more than a tenth of a large batch."""
    numbers, counts = np.unique(storage.sample().rewards.numpy().astype(int), return_counts=True)
    return [int(number) for number, count in zip(numbers, counts) if count > 400]


names = ("rllte-core", "torch", "gymnasium", "numpy")
print("Python", platform.python_version(), *(f"{name} {version(name)}" for name in names))
for number in range(SIZE):
    add(number)
storage.update({"indices": np.arange(SIZE), "priorities": np.full(SIZE, 1e-6)})
storage.update({"indices": [5], "priorities": [1.0]})
full = drawn()
print("full, drawn:", *full)
add(8)
one_more = drawn()
print("after one more, 8, drawn:", *one_more, end=", right: 5 8\n")
add(9)
two_more = drawn()
print("after two more, 8 and 9, drawn:", *two_more, end=", right: 5 8 9\n")

assert full == [5]
assert one_more == [1, 6], "changed: the priorities stay with their transitions now"
assert two_more == [2, 3, 7], "changed: the priorities stay with their transitions now"
PY
"$work/venv/bin/python" -W ignore "$work/show.py"
