#!/usr/bin/env bash
# Tianshou: the moving average of losses takes NaN, though its documentation says that it does not.
#
# Who meets it: somebody whose loss is NaN once, and who looks at the smoothed losses of Tianshou's
# trainer. It keeps one MovAvg for each loss.
#
# The guess: NaN is left out, as infinity is. The docstring of the class promises both.
#
# The behaviour: a value is left out when it is in a list that has np.nan. NaN equals nothing, so
# Python finds it there only if it is that very object. A tensor, an array, a numpy number and
# float("nan") are other objects. Each goes in, and the mean is NaN for the next 100 values.
# Infinity is left out in each form.
#
# Seen on 2026-11-29 with Python 3.11.7, tianshou 2.0.1, torch 2.13.0, numpy 2.4.6; the mean after
# 1, 2 and the value:
#   np.nan:         1.5    np.inf:         1.5
#   float("nan"):   nan    float("inf"):   1.5
#   a numpy number: nan    a numpy number: 1.5
#   an array:       nan    an array:       1.5
#   a tensor:       nan    a tensor:       1.5
set -euo pipefail

work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install -qq --no-compile --disable-pip-version-check \
    tianshou==2.0.1 torch==2.13.0 numpy==2.4.6

cat > "$work/show.py" <<'PY'
import math
import platform
from importlib.metadata import version

import numpy as np
import torch
from tianshou.utils import MovAvg

FORMS = {
    "np.{}": lambda name: getattr(np, name),
    'float("{}")': float,
    "a numpy number": np.float32,
    "an array": lambda name: np.array([float(name)]),
    "a tensor": lambda name: torch.tensor(float(name)),
}


def mean_with(value):
    average = MovAvg()
    average.add([1.0, 2.0])
    return average.add(value)


print("Python", platform.python_version(), "tianshou", version("tianshou"), end=" ")
print("torch", torch.__version__, "numpy", np.__version__)
means = {}
for form, make in FORMS.items():
    for name in ("nan", "inf"):
        means[form, name] = mean_with(make(name))
        print(f"{form.format(name) + ':':<16}{means[form, name]:<7}", end="" if name == "nan" else "\n")

assert all(means[form, "inf"] == 1.5 for form in FORMS)
assert means["np.{}", "nan"] == 1.5
others = list(FORMS)[1:]
assert all(math.isnan(means[form, "nan"]) for form in others), "changed: other NaNs are left out now, too"
PY
"$work/venv/bin/python" -W ignore "$work/show.py"
