#!/usr/bin/env bash
# pybullet: changeDynamics(mass=...) throws away the inertia of the URDF, even if the mass stays
# the same.
#
# Who meets it: somebody who randomizes the masses of a robot, so that a policy also works on
# the real one, and who loads the robot with URDF_USE_INERTIA_FROM_FILE, since the file has
# measured moments of inertia.
#
# The guess: the mass changes, and the inertia stays, or grows with the mass. The call has an
# argument of its own for the inertia, localInertiaDiagonal.
#
# The behaviour: the inertia becomes that of the collision shape, filled evenly. Setting a mass
# to the value that it has turns (0.5, 0.6, 0.7) kg m^2 into (0.013, 0.013, 0.013), of a cube of
# 0.2 m. The same push then turns the body 37 times faster. Giving localInertiaDiagonal in the
# same call keeps the inertia.
#
# Seen on 2026-11-29 with Python 3.11.7, pybullet 3.2.7, numpy 2.4.6:
#   as loaded:             mass 2.0, inertia (0.5, 0.6, 0.7), a push turns it by 0.200 rad/s
#   friction set:          mass 2.0, inertia (0.5, 0.6, 0.7), a push turns it by 0.200 rad/s
#   mass set to the same:  mass 2.0, inertia (0.0133, 0.0133, 0.0133), a push turns it by 7.500 rad/s
#   mass and inertia set:  mass 2.0, inertia (0.5, 0.6, 0.7), a push turns it by 0.200 rad/s
set -euo pipefail

work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install -qq --no-compile --disable-pip-version-check pybullet==3.2.7 numpy==2.4.6

cat > "$work/cube.urdf" <<'XML'
<robot name="cube">
  <link name="base">
    <inertial>
      <mass value="2"/>
      <inertia ixx="0.5" iyy="0.6" izz="0.7" ixy="0" ixz="0" iyz="0"/>
    </inertial>
    <collision><geometry><box size="0.2 0.2 0.2"/></geometry></collision>
  </link>
</robot>
XML

cat > "$work/show.py" <<'PY'
import platform
import sys
from importlib.metadata import version

import pybullet as p


def cube(label, **change):
    """Load the cube, change it, look at it, then push it for one step around its first axis."""
    body = p.loadURDF(sys.argv[1], flags=p.URDF_USE_INERTIA_FROM_FILE)
    if change:
        p.changeDynamics(body, -1, **change)
    mass, _, inertia = p.getDynamicsInfo(body, -1)[:3]
    inertia = tuple(round(value, 4) for value in inertia)
    p.applyExternalTorque(body, -1, (24, 0, 0), p.LINK_FRAME)
    p.stepSimulation()
    turning = p.getBaseVelocity(body)[1][0]
    p.removeBody(body)
    print(f"{label:22} mass {mass}, inertia {inertia}, a push turns it by {turning:.3f} rad/s")
    return mass, inertia


print("Python", platform.python_version(), "pybullet", version("pybullet"), "numpy", version("numpy"))
p.connect(p.DIRECT)
loaded = cube("as loaded:")
friction = cube("friction set:", lateralFriction=0.3)
same_mass = cube("mass set to the same:", mass=2)
both = cube("mass and inertia set:", mass=2, localInertiaDiagonal=(0.5, 0.6, 0.7))

assert loaded == friction == both == (2.0, (0.5, 0.6, 0.7))
assert same_mass == (2.0, (0.0133, 0.0133, 0.0133)), "changed: the inertia of the file stays"
PY
"$work/venv/bin/python" "$work/show.py" "$work/cube.urdf"
