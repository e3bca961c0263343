#!/usr/bin/env bash
# pybullet: resetSimulation() puts gravity and the solver back to their defaults, but keeps
# the time step.
#
# Who meets it: somebody who uses one pybullet connection for several environments or tests.
# One calls setTimeStep(0.01). The next one relies on the default of 1/240 s.
#
# The guess: resetSimulation gives a fresh world, with all settings as after connect().
#
# The behaviour: gravity goes back to 0 and the solver to 50 iterations, as guessed. The time
# step stays at 0.01. A ball that falls for 240 steps then falls 2.4 s instead of 1 s. A new
# connection does have the default.
#
# Seen on 2026-11-28 with Python 3.11.7, pybullet 3.2.7, numpy 2.4.6:
#   fresh connection:      time step 0.004167, gravity 0.0, solver iterations 50, ball falls 4.66 m
#   changed settings:      time step 0.010000, gravity -5.0, solver iterations 7
#   after resetSimulation: time step 0.010000, gravity 0.0, solver iterations 50, ball falls 21.42 m
#   new connection:        time step 0.004167, gravity 0.0, solver iterations 50, ball falls 4.66 m
set -euo pipefail

work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install -qq --no-compile --disable-pip-version-check pybullet==3.2.7 numpy==2.4.6

cat > "$work/show.py" <<'PY'
import platform
from importlib.metadata import version

import pybullet as p


def settings(label):
    now = p.getPhysicsEngineParameters()
    step, gravity = now["fixedTimeStep"], now["gravityAccelerationZ"]
    text = f"{label:22} time step {step:.6f}, gravity {gravity}, solver iterations {now['numSolverIterations']}"
    return text, (round(step, 6), gravity, now["numSolverIterations"])


def world(label):
    """Note the settings, then let a ball fall for 240 steps."""
    text, values = settings(label)
    p.setGravity(0, 0, -10)
    shape = p.createCollisionShape(p.GEOM_SPHERE, radius=0.1)
    ball = p.createMultiBody(1.0, shape, basePosition=[0, 0, 100])
    for _ in range(240):
        p.stepSimulation()
    fall = 100 - p.getBasePositionAndOrientation(ball)[0][2]
    print(f"{text}, ball falls {fall:.2f} m")
    return values, round(fall, 1)


print("Python", platform.python_version(), "pybullet", version("pybullet"), "numpy", version("numpy"))
p.connect(p.DIRECT)
fresh = world("fresh connection:")
p.setTimeStep(0.01)
p.setGravity(0, 0, -5)
p.setPhysicsEngineParameter(numSolverIterations=7)
text, changed = settings("changed settings:")
print(text)
p.resetSimulation()
after = world("after resetSimulation:")
p.disconnect()
p.connect(p.DIRECT)
again = world("new connection:")

assert changed == (0.01, -5.0, 7) and again == fresh == ((0.004167, 0.0, 50), 4.7)
assert after == ((0.01, 0.0, 50), 21.4), "changed: resetSimulation resets the time step too"
PY
"$work/venv/bin/python" "$work/show.py"
