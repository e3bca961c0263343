#!/usr/bin/env bash
# d3rlpy: InitialStateValueEstimationEvaluator also takes the states at steps 1024, 2048, ...
#
# Who meets it: somebody who chooses the best of several offline policies by this number, on
# episodes longer than 1 024 steps: Atari, process control, trading.
#
# The guess: the mean of Q at the first state of each episode, one number an episode. So says the
# formula in its documentation.
#
# The behaviour: each episode is cut into windows of 1 024 steps. The first state of each window counts
# as an initial one. So a long episode counts several times, with states from its middle, whose
# values may be quite different. Up to 1 024 steps it is right.
#
# Seen on 2026-11-29 with Python 3.11.7, d3rlpy 2.8.1, torch 2.13.0, numpy 2.4.6, gymnasium 1.0.0.
# The observation is the number of the step. Asked are, for one episode:
#   of 1000 steps: step 0
#   of 3000 steps: steps 0 1024 2048
#   an algorithm whose Q is the step: 0 for 1000 steps, 1024 for 3000; Q of the first state is 0
set -euo pipefail

work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install -qq --no-compile --disable-pip-version-check \
    d3rlpy==2.8.1 torch==2.13.0 numpy==2.4.6 gymnasium==1.0.0

cat > "$work/show.py" <<'PY'
import logging
import platform
from importlib.metadata import version

import numpy as np
import structlog
from d3rlpy.dataset import Episode, create_infinite_replay_buffer
from d3rlpy.metrics import InitialStateValueEstimationEvaluator

structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.ERROR))


class StepIsValue:
    """Q(s, a) is the observation. Notes which observations it is asked about."""

    def __init__(self):
        self.asked = []

    def predict(self, observations):
        self.asked += observations[:, 0].astype(int).tolist()
        return np.zeros(len(observations), int)

    def predict_value(self, observations, actions):
        return observations[:, 0]


def evaluate(steps):
    observations = np.arange(steps, dtype=np.float32)[:, None]
    one = Episode(observations, np.zeros((steps, 1), int), np.ones((steps, 1), np.float32), True)
    algorithm = StepIsValue()
    value = InitialStateValueEstimationEvaluator()(algorithm, create_infinite_replay_buffer([one]))
    return algorithm.asked, value


names = ("d3rlpy", "torch", "numpy", "gymnasium")
print("Python", platform.python_version(), *(f"{name} {version(name)}" for name in names))
short, short_value = evaluate(1000)
long, long_value = evaluate(3000)
print("of 1000 steps: step", *short)
print("of 3000 steps: steps", *long)
print(f"an algorithm whose Q is the step: {short_value:g} for 1000 steps, {long_value:g} for 3000;", end=" ")
print("Q of the first state is 0")

assert short == [0] and short_value == 0
assert long == [0, 1024, 2048] and long_value == 1024, "changed: only the first state counts now"
PY
"$work/venv/bin/python" -W ignore "$work/show.py"
