#!/usr/bin/env bash
# numpy: restoring bit_generator.state from a checkpoint does not restore spawn().
#
# Who meets it: an RL programmer who calls rng.spawn(1) for each new episode or worker and
# saves rng.bit_generator.state in the checkpoint. After the restart, the "new" episodes get
# the generators of the first episodes again, so old start states and old noise come back.
#
# The guess: the state is everything. A generator with a restored state goes on as if
# nothing had happened, for random() and for spawn().
#
# The behaviour: random() goes on correctly, but spawn() starts again with the first child.
# The number of children is kept in bit_generator.seed_seq, and the state does not hold it.
# If the new generator was made from another seed, the children come from that seed instead.
# A pickle of the whole generator does keep the number.
#
# Seen on 2026-11-28 with Python 3.11.7 and numpy 2.4.6:
#   child 1 and 2 of the first run  0.9429 0.6772
#   next child, no restart          0.8383
#   next child, state restored      0.9429
#   next child, other seed + state  0.699
#   next child, pickle              0.8383
#   random() after the restore goes on: True
set -euo pipefail

work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install -qq --no-compile --disable-pip-version-check numpy==2.4.6

cat > "$work/show.py" <<'PY'
import pickle
import platform

import numpy as np


def next_child(rng):
    return round(rng.spawn(1)[0].random(), 4)


print("Python", platform.python_version(), "numpy", np.__version__)
rng = np.random.default_rng(0)
first, second = next_child(rng), next_child(rng)
rng.random(10)
state, whole = rng.bit_generator.state, pickle.dumps(rng)  # two kinds of checkpoint

restored = np.random.default_rng(0)
restored.bit_generator.state = state
other = np.random.default_rng(1)
other.bit_generator.state = state
goes_on = rng.random() == restored.random() == other.random()
third, again, foreign, pickled = map(next_child, (rng, restored, other, pickle.loads(whole)))

print("child 1 and 2 of the first run ", first, second)
print("next child, no restart         ", third)
print("next child, state restored     ", again)
print("next child, other seed + state ", foreign)
print("next child, pickle             ", pickled)
print("random() after the restore goes on:", goes_on)
assert goes_on
assert third not in (first, second) and pickled == third
assert again == first, "changed: the state now holds the number of children"
assert foreign == next_child(np.random.default_rng(1)), "changed: the state now holds the seed"
PY
"$work/venv/bin/python" "$work/show.py"
