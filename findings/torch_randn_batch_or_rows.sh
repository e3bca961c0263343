#!/usr/bin/env bash
# torch.randn on the CPU: drawing two rows of 8 is not the same as drawing one 2 x 8 batch.
#
# Who meets it: somebody who adds exploration noise to the actions of several environments
# (SAC on the Minitaur has 8 motors) and compares a loop over environments with one batched
# call, or one environment with two, from the same seed.
#
# The guess: a generator is one stream of numbers. So the batch holds the same numbers as
# the rows, and randn(15) is the beginning of randn(16). numpy works like this.
#
# The behaviour: from 16 elements on, torch.randn fills the tensor in another way and gives
# other numbers. For a size that is not a multiple of 16, it also draws the last 16 again:
# randn(16) and randn(17) share one number only. Small batches, torch.rand and numpy's
# standard_normal keep to one stream.
#
# Seen on 2026-11-28 with Python 3.11.7, torch 2.13.0+cpu, numpy 2.4.6:
#   shape     torch.randn  torch.rand  numpy normal    (batch equal to rows?)
#   (2, 4)    True         True        True
#   (2, 8)    False        True        True
#   (3, 17)   False        True        True
#   equal numbers at the start of randn(15) and randn(16): 0 of 15
#   equal numbers at the start of randn(16) and randn(17): 1 of 16
set -euo pipefail

work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install -qq --no-compile --disable-pip-version-check torch==2.13.0 numpy==2.4.6

cat > "$work/show.py" <<'PY'
import platform

import numpy as np
import torch


def torch_draw(function, shapes):
    generator = torch.Generator().manual_seed(0)
    return [function(shape, generator=generator).numpy() for shape in shapes]


def numpy_draw(shapes):
    generator = np.random.default_rng(0)
    return [generator.standard_normal(shape) for shape in shapes]


def batch_is_rows(draw, rows, columns):
    return np.array_equal(draw([(rows, columns)])[0], np.stack(draw([(columns,)] * rows)))


def equal_start(small, large):
    one, two = (torch_draw(torch.randn, [(size,)])[0] for size in (small, large))
    return int((one == two[:small]).sum())


print("Python", platform.python_version(), "torch", torch.__version__, "numpy", np.__version__)
print("shape     torch.randn  torch.rand  numpy normal    (batch equal to rows?)")
seen = []
for shape in ((2, 4), (2, 8), (3, 17)):
    draws = (lambda s: torch_draw(torch.randn, s), lambda s: torch_draw(torch.rand, s), numpy_draw)
    seen.append([batch_is_rows(draw, *shape) for draw in draws])
    print(f"{str(shape):9} {seen[-1][0]!s:12} {seen[-1][1]!s:11} {seen[-1][2]}")
print("equal numbers at the start of randn(15) and randn(16):", equal_start(15, 16), "of 15")
print("equal numbers at the start of randn(16) and randn(17):", equal_start(16, 17), "of 16")
assert seen == [[True] * 3, [False, True, True], [False, True, True]], "changed"
assert equal_start(15, 16) == 0 and equal_start(16, 17) == 1, "changed"
PY
"$work/venv/bin/python" "$work/show.py"
