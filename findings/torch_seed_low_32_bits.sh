#!/usr/bin/env bash
# torch.manual_seed takes a 64-bit seed, but the CPU generator uses only the low 32 bits.
#
# Who meets it: an RL programmer who makes one seed from two numbers, such as
#   seed = (worker << 32) + run
# to give every worker its own exploration noise. All workers then draw the same noise.
# Random 64-bit seeds (for example from numpy's generate_state with uint64) also lose half
# of their bits.
#
# The guess: the documentation allows seeds from -2**63 to 2**64 - 1, and initial_seed()
# gives the whole number back. So two different 64-bit seeds start two different streams.
#
# The behaviour: seeds that differ only above bit 31 start the same stream on the CPU.
# There is no warning, and initial_seed() still shows different seeds. numpy's default_rng
# does see a difference between the same two seeds.
#
# Seen on 2026-11-28 with Python 3.11.7, torch 2.13.0+cpu, numpy 2.4.6:
#   worker 0: initial_seed 7, torch [0.5349, 0.1988, 0.6592], numpy [0.6251, 0.8972, 0.7757]
#   worker 1: initial_seed 4294967303, torch [0.5349, 0.1988, 0.6592], numpy [0.7701, 0.1119, 0.1891]
#   worker 2: initial_seed 8589934599, torch [0.5349, 0.1988, 0.6592], numpy [0.278, 0.4452, 0.9337]
#   a separate torch.Generator: the same stream as well
set -euo pipefail

work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install -qq --no-compile --disable-pip-version-check torch==2.13.0 numpy==2.4.6

cat > "$work/show.py" <<'PY'
import platform

import numpy as np
import torch


def short(numbers):
    return [round(number, 4) for number in numbers.tolist()]


print("Python", platform.python_version(), "torch", torch.__version__, "numpy", np.__version__)
run = 7
torch_rows, numpy_rows, generator_rows, seeds = [], [], [], []
for worker in range(3):
    seed = (worker << 32) + run
    torch.manual_seed(seed)
    seeds.append(torch.initial_seed())
    torch_rows.append(short(torch.rand(3)))
    numpy_rows.append(short(np.random.default_rng(seed).random(3)))
    own = torch.Generator().manual_seed(seed)
    generator_rows.append(short(torch.rand(3, generator=own)))
    print(f"worker {worker}: initial_seed {seeds[-1]}, torch {torch_rows[-1]}, numpy {numpy_rows[-1]}")

assert len(set(seeds)) == 3, "torch no longer remembers the whole seed"
assert numpy_rows[0] != numpy_rows[1] != numpy_rows[2]
assert torch_rows[0] == torch_rows[1] == torch_rows[2], "changed: the high bits count now"
assert generator_rows == torch_rows, "changed: torch.Generator behaves in another way now"
print("a separate torch.Generator: the same stream as well")
PY
"$work/venv/bin/python" "$work/show.py"
