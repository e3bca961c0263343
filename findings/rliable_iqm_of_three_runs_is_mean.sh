#!/usr/bin/env bash
# rliable: the interquartile mean of three runs is their plain mean. One failed run moves it.
#
# Who meets it: somebody who has one task and three seeds, which is usual in coursework, and takes
# the interquartile mean because it is known to be robust to an outlier.
#
# The guess: aggregate_iqm is the mean of the middle half, as its documentation says. Of 31, 33
# and 2 it is 31, if one run is dropped at each end. If a quarter of three runs, 0.75 of a run, is
# dropped at each end, it is (0.25 x 2 + 31 + 0.25 x 33) / 1.5 = 26.5.
#
# The behaviour: it is SciPy's trim_mean, which drops a whole number of runs at each end, rounded
# down. Of three runs it drops int(0.75) = 0. So it is the mean, 22. Of seven runs it drops one at
# each end and keeps five, 71 % of them. It is the middle half only where runs x tasks is a
# multiple of four. Adding a fourth run changes it from 22 to 32.
#
# Seen on 2026-11-29 with Python 3.11.7, rliable 1.2.0, arch 7.2.0, scipy 1.17.1, numpy 2.4.6:
#   3 runs [2, 31, 33]: IQM 22.00, mean 22.00, median 31.0, weighted middle half 26.50
#   4 runs [2, 31, 33, 33]: IQM 32.00, mean 24.75, median 32.0, weighted middle half 32.00
#   5 runs [2, 31, 33, 33, 33]: IQM 32.33, mean 26.40, median 33.0, weighted middle half 32.40
#   7 runs [2, 31, 33, 33, 33, 33, 33]: IQM 32.60, mean 28.29, median 33.0, weighted middle half 32.86
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
from rliable import metrics


def middle_half(scores):
    """The mean of the middle half of the sorted scores. A score that is cut in two counts in part."""
    scores = np.sort(scores)
    count = len(scores)
    left = np.arange(count)
    weights = np.clip(np.minimum(left + 1, 0.75 * count) - np.maximum(left, 0.25 * count), 0, 1)
    return (weights * scores).sum() / weights.sum()


print("Python", platform.python_version(), "rliable", version("rliable"), "arch", version("arch"), end=" ")
print("scipy", version("scipy"), "numpy", np.__version__)
iqm = {}
for count in (3, 4, 5, 7):
    runs = [2, 31] + [33] * (count - 2)
    scores = np.array(runs, float)
    iqm[count] = metrics.aggregate_iqm(scores[:, None])  # (runs, tasks)
    print(f"{count} runs {runs}: IQM {iqm[count]:.2f}, mean {scores.mean():.2f},", end=" ")
    print(f"median {np.median(scores)}, weighted middle half {middle_half(scores):.2f}")

assert iqm[3] == 22, "changed: the IQM of three runs is not their mean any more"
assert iqm[4] == 32
assert np.isclose(iqm[7], np.mean([31, 33, 33, 33, 33])), "changed: of seven runs it does not keep five"
PY
"$work/venv/bin/python" -W ignore "$work/show.py"
