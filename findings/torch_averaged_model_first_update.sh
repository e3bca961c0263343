#!/usr/bin/env bash
# torch's AveragedModel: the first "moving average" update is a plain copy.
#
# Who meets it: somebody who uses AveragedModel with get_ema_multi_avg_fn(0.99) as the target
# network of DQN or SAC, because it looks like the ready-made Polyak update.
#
# The guess: the target is a copy of the network from the moment of creation. Each call of
# update_parameters moves it by 1% towards the network, and the first call too.
#
# The behaviour: the first call copies the network completely, whatever the decay is. If the
# network was trained before the first call, the slow start of the target is lost. Only the
# later calls move by 1%. The target's parameters also still ask for gradients.
#
# Seen on 2026-11-28 with Python 3.11.7 and torch 2.13.0+cpu:
#   weight 0 at creation, network then at 1, decay 0.99
#   expected after call 1, 2, 3: [0.01, 0.0199, 0.0297]
#   seen     after call 1, 2, 3: [1.0, 1.0, 1.0]
#   network then at 2, call 4:   1.01
#   target.requires_grad: True
set -euo pipefail

work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install -qq --no-compile --disable-pip-version-check torch==2.13.0 numpy==2.4.6

cat > "$work/show.py" <<'PY'
import platform

import torch
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

DECAY = 0.99
print("Python", platform.python_version(), "torch", torch.__version__)
net = torch.nn.Linear(1, 1, bias=False)
torch.nn.init.constant_(net.weight, 0.0)
target = AveragedModel(net, multi_avg_fn=get_ema_multi_avg_fn(DECAY))
weight = target.module.weight
assert weight.item() == 0.0

torch.nn.init.constant_(net.weight, 1.0)  # stands for some training before the first update
expected = [round(1 - DECAY**n, 4) for n in (1, 2, 3)]
seen = []
for _ in range(3):
    target.update_parameters(net)
    seen.append(round(weight.item(), 4))
torch.nn.init.constant_(net.weight, 2.0)
target.update_parameters(net)
fourth = round(weight.item(), 4)

print("weight 0 at creation, network then at 1, decay", DECAY)
print("expected after call 1, 2, 3:", expected)
print("seen     after call 1, 2, 3:", seen)
print("network then at 2, call 4:  ", fourth)
print("target.requires_grad:", weight.requires_grad)
assert seen[0] == 1.0, "changed: the first call averages now"
assert fourth == 1.01, "changed: later calls do not move by 1%"
assert weight.requires_grad, "changed: the target asks for no gradients now"
PY
"$work/venv/bin/python" "$work/show.py"
