#!/usr/bin/env bash
# torch.distributed with gloo: all_reduce with MAX or MIN may lose a NaN.
# It depends on which process has the NaN.
#
# Who meets it: somebody who trains with several CPU processes and shares the largest loss or
# gradient norm, to stop all of them when one process has a NaN.
#
# The guess: MAX treats NaN as torch.max does. A NaN on any process gives NaN everywhere.
#
# The behaviour: with two processes and one number each, a NaN on rank 0 gives NaN on both,
# but a NaN on rank 1 disappears on both. Both ranks then see a healthy number. SUM keeps
# the NaN in both cases. So share a SUM, or a 0/1 flag, and not a MAX.
#
# Seen on 2026-11-28 with Python 3.11.7 and torch 2.13.0+cpu:
#   torch.max of [1, nan]: nan, torch.max of [nan, 1]: nan
#   rank 0 MAX: NaN on rank 0 -> nan, NaN on rank 1 -> 1.0
#   rank 0 MIN: NaN on rank 0 -> nan, NaN on rank 1 -> 1.0
#   rank 0 SUM: NaN on rank 0 -> nan, NaN on rank 1 -> nan
#   (rank 1 prints the same three lines)
set -euo pipefail

work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install -qq --no-compile --disable-pip-version-check torch==2.13.0 numpy==2.4.6

cat > "$work/show.py" <<'PY'
import math
import platform
import sys

import torch
import torch.distributed as dist
import torch.multiprocessing as mp

NAN = math.nan


def reduced(rank, op, bad):
    value = torch.tensor([NAN if rank == bad else 1.0])
    dist.all_reduce(value, op=op)
    return value.item()


def process(rank, meeting_file):
    dist.init_process_group("gloo", init_method=f"file://{meeting_file}", rank=rank, world_size=2)
    seen, lines = {}, []
    for name in ("MAX", "MIN", "SUM"):
        seen[name] = [reduced(rank, getattr(dist.ReduceOp, name), bad) for bad in (0, 1)]
        lines.append(f"rank {rank} {name}: NaN on rank 0 -> {seen[name][0]}, NaN on rank 1 -> {seen[name][1]}")
    for turn in (0, 1):  # one after the other, so the lines do not mix
        if turn == rank:
            print("\n".join(lines), flush=True)
        dist.barrier()
    dist.destroy_process_group()
    for name in ("MAX", "MIN"):
        assert math.isnan(seen[name][0]), "changed: a NaN of rank 0 is lost"
        assert seen[name][1] == 1.0, "changed: a NaN of rank 1 is kept now"
    assert all(map(math.isnan, seen["SUM"]))


if __name__ == "__main__":
    print("Python", platform.python_version(), "torch", torch.__version__)
    pair = [torch.tensor(values).max().item() for values in ([1.0, NAN], [NAN, 1.0])]
    print(f"torch.max of [1, nan]: {pair[0]}, torch.max of [nan, 1]: {pair[1]}")
    assert all(map(math.isnan, pair))
    mp.spawn(process, (sys.argv[1],), nprocs=2)
PY
"$work/venv/bin/python" "$work/show.py" "$work/meeting"
