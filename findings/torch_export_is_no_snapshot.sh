#!/usr/bin/env bash
# torch.export.export freezes no weights: the exported program changes as training goes on.
#
# Who meets it: somebody who exports the policy at its best evaluation, trains on, and saves
# the exported program at the end of the run. The file then holds the last weights.
#
# The guess: an exported program is a finished thing, a snapshot of the network.
#
# The behaviour: it shares its weights, buffers and plain tensor attributes with the living
# network. A change in place (an optimizer step is one) changes the program too. Python
# numbers are frozen, so one program mixes old and new. torch.export.save makes a snapshot.
#
# Seen on 2026-11-28 with Python 3.11.7 and torch 2.13.0+cpu:
#   at the export                 network 1.0, program 1.0
#   after an optimizer step       network 2.0, program 2.0
#   after a buffer changed        network 6.0, program 6.0
#   after a tensor changed        network 30.0, program 30.0
#   after a Python number changed network 210.0, program 30.0
#   saved at the export 1.0, saved at the end 30.0
set -euo pipefail

work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install -qq --no-compile --disable-pip-version-check torch==2.13.0 numpy==2.4.6

cat > "$work/show.py" <<'PY'
import io
import platform

import torch


class Policy(torch.nn.Module):
    def __init__(self):
        super().__init__()
        self.weight = torch.nn.Parameter(torch.ones(1))
        self.register_buffer("mean", torch.ones(1))
        self.scale, self.factor = torch.ones(1), 1.0

    def forward(self, x):
        return x * self.weight * self.mean * self.scale * self.factor


def look(label):
    seen.append((policy(x).item(), program.module()(x).item()))
    print(f"{label:29} network {seen[-1][0]}, program {seen[-1][1]}")


print("Python", platform.python_version(), "torch", torch.__version__)
seen, x, policy, early, late = [], torch.ones(1), Policy(), io.BytesIO(), io.BytesIO()
program = torch.export.export(policy, (x,))
torch.export.save(program, early)
look("at the export")
policy.weight.grad = torch.full((1,), -1.0)
torch.optim.SGD([policy.weight], lr=1.0).step()
look("after an optimizer step")
policy.mean.mul_(3)
look("after a buffer changed")
policy.scale.mul_(5)
look("after a tensor changed")
policy.factor = 7.0
look("after a Python number changed")
torch.export.save(program, late)
files = [torch.export.load(io.BytesIO(f.getvalue())).module()(x).item() for f in (early, late)]
print(f"saved at the export {files[0]}, saved at the end {files[1]}")
assert seen == [(1, 1), (2, 2), (6, 6), (30, 30), (210, 30)], "changed"
assert files == [1, 30], "changed"
PY
"$work/venv/bin/python" "$work/show.py"
