#!/usr/bin/env bash
# VMAS: all environments of a process share one random stream. Seeding one of them seeds all.
#
# Who meets it: somebody who trains in one VMAS environment and evaluates in a second one, always
# with the same seed, so that every evaluation has the same episodes.
#
# The guess: reset(seed=123) of the evaluation environment sets the evaluation environment. The
# training environment has a seed and a stream of its own, and goes on with new episodes.
#
# The behaviour: the stream is an attribute of the class, not of the environment. After each
# evaluation the training environment therefore begins where seed 123 left the stream: every
# iteration trains from the same start states, for the whole run. And an environment that was
# made with seed 0 starts elsewhere when a second one is made between. Call train.seed(...) with
# a new number after each evaluation, or evaluate in another process.
#
# Seen on 2026-11-29 with Python 3.11.7, vmas 1.5.2, torch 2.13.0, numpy 2.4.6, task "balance",
# 3 copies, x of the first robot at the start of four iterations:
#   no evaluation:    [-0.79, -0.65, -0.17] [-0.62, 0.13, -0.77] [-0.28, -0.95, -0.82] [0.02, -0.74, -0.27]
#   with evaluations: [-0.79, -0.65, -0.17] [-0.53, -0.19, 0.04] [-0.53, -0.19, 0.04] [-0.53, -0.19, 0.04]
#   seed 0, first reset, alone: [-0.79, -0.65, -0.17]
#   seed 0, first reset, after another was made with seed 1: [0.14, -0.2, -0.61]
set -euo pipefail

work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install -qq --no-compile --disable-pip-version-check \
    vmas==1.5.2 torch==2.13.0 numpy==2.4.6

cat > "$work/show.py" <<'PY'
import platform
from importlib.metadata import version

import vmas


def start(env, seed=None):
    """Begin new episodes. Return x of the first robot in each copy."""
    observations = env.reset(seed=seed)
    return [round(float(x), 2) for x in observations[0][:, 0]]


def make(seed):
    return vmas.make_env("balance", num_envs=3, seed=seed)


def train_starts(evaluations, iterations=4):
    evaluation = make(123)
    training = make(0)
    starts = []
    for _ in range(iterations):
        starts.append(start(training))
        if evaluations:
            start(evaluation, seed=123)
    return starts


print("Python", platform.python_version(), *(f"{name} {version(name)}" for name in ("vmas", "torch", "numpy")))
without = train_starts(evaluations=False)
between = train_starts(evaluations=True)
print("no evaluation:   ", *without)
print("with evaluations:", *between)

training = make(0)
alone = start(training)
training = make(0)
make(1)
after_another = start(training)
print("seed 0, first reset, alone:", alone)
print("seed 0, first reset, after another was made with seed 1:", after_another)

assert len({tuple(x) for x in without}) == 4, "changed: four iterations no longer have four starts"
assert without[0] == between[0]
assert between[1] == between[2] == between[3], "changed: an evaluation leaves the training's stream alone now"
assert alone == without[0] and alone != after_another, "changed: a second environment leaves the first alone now"
PY
"$work/venv/bin/python" -W ignore "$work/show.py"
