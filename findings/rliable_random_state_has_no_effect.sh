#!/usr/bin/env bash
# rliable: `random_state` does not fix its confidence intervals. numpy's global seed does.
#
# Who meets it: somebody who reports the interquartile mean of some runs with rliable, the usual
# library for this in reinforcement learning, and wants the same interval on the next day.
#
# The guess: random_state=RandomState(1) gives the same interval each time. The docstrings say so
# of the bootstrap classes and of get_interval_estimates.
#
# The behaviour: the object is handed to the base class in arch. But rliable's own update_indices
# draws from np.random, numpy's global stream. So equal states give different intervals, and the
# state that was handed in is never drawn from. np.random.seed(1) before the call gives equal
# intervals. The call also moves the global stream of the program that makes it. For comparison,
# arch's own IIDBootstrap repeats its interval with the same argument.
#
# Seen on 2026-11-29 with Python 3.11.7, rliable 1.2.0, arch 7.2.0, numpy 2.4.6, pandas 2.3.3, 5
# runs of 3 tasks (pandas 3 ends the import of arch 7.2.0 with a TypeError):
#   random_state=RandomState(1):  [0.5005 0.7065] and [0.5022 0.7059]   (others each time)
#   the state was drawn from: False
#   np.random.seed(1) before:     [0.5089 0.7036] and [0.5089 0.7036]
#   arch's IIDBootstrap, RandomState(1): [0.543 0.7  ] and [0.543 0.7  ]
set -euo pipefail

work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install -qq --no-compile --disable-pip-version-check \
    rliable==1.2.0 arch==7.2.0 numpy==2.4.6 pandas==2.3.3 scipy==1.17.1

cat > "$work/show.py" <<'PY'
import platform
from importlib.metadata import version

import numpy as np
from arch.bootstrap import IIDBootstrap
from rliable import library, metrics

SCORES = np.random.RandomState(0).rand(5, 3)  # 5 runs, 3 tasks


def iqm(scores):
    return np.array([metrics.aggregate_iqm(scores)])


def interval(state=None):
    _, intervals = library.get_interval_estimates({"agent": SCORES}, iqm, reps=1000, random_state=state)
    return intervals["agent"].ravel()


def archs_own(state):
    return IIDBootstrap(SCORES, random_state=state).conf_int(iqm, reps=1000, method="percentile").ravel()


def show(first, second):
    return f"{first.round(4)} and {second.round(4)}"


print("Python", platform.python_version(), "rliable", version("rliable"), "arch", version("arch"), end=" ")
print("numpy", np.__version__, "pandas", version("pandas"))

state = np.random.RandomState(1)
with_state = interval(state), interval(np.random.RandomState(1))
used = state.random_sample() != np.random.RandomState(1).random_sample()
print("random_state=RandomState(1): ", show(*with_state))
print("the state was drawn from:", used)

np.random.seed(1)
first = interval()
np.random.seed(1)
second = interval()
print("np.random.seed(1) before:    ", show(first, second))

own = archs_own(np.random.RandomState(1)), archs_own(np.random.RandomState(1))
print("arch's IIDBootstrap, RandomState(1):", show(*own))

assert np.array_equal(*own)
assert np.array_equal(first, second), "changed: the global seed does not fix the interval any more"
assert not np.array_equal(*with_state), "changed: random_state fixes the interval now"
assert not used, "changed: the state is used now"
PY
"$work/venv/bin/python" -W ignore "$work/show.py"
