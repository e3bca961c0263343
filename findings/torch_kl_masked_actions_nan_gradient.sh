#!/usr/bin/env bash
# torch's kl_divergence of two Categoricals with masked actions: a good value, a NaN gradient.
#
# Who meets it: somebody who masks the illegal actions of a game with logits of -inf, and keeps the
# policy near an older one or near a prior with a penalty kl_divergence(policy, prior).
#
# The guess: Categorical and kl_divergence take chances of 0 into account, since the value is
# right, and log_prob and entropy() work with -inf too. So the gradient is right as well. For the
# masked action it is 0.
#
# The behaviour: both policies have the same mask, and the value is right. But the gradient of each
# legal action is NaN, and one step of the optimizer makes the network's weights NaN. It is so in
# one direction alone: kl_divergence(prior, policy) has a good gradient, and so has entropy().
# A large negative number in place of -inf gives the right gradient everywhere.
#
# Seen on 2026-11-29 with Python 3.11.7 and torch 2.13.0+cpu, logits 1, 2, 3, the third one masked:
#   -inf,  KL(policy, prior)  value 0.1109 gradient [nan, nan, 0.0]
#   -inf,  KL(prior, policy)  value 0.1201 gradient [-0.2311, 0.2311, 0.0]
#   -inf,  entropy            value 0.5822 gradient [0.1966, -0.1966, 0.0]
#   -inf,  log_prob           value -1.3133 gradient [0.7311, -0.7311, 0.0]
#   -1e9,  KL(policy, prior)  value 0.1109 gradient [-0.1966, 0.1966, 0.0]
#   -1e9,  KL(prior, policy)  value 0.1201 gradient [-0.2311, 0.2311, 0.0]
set -euo pipefail

work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install -qq --no-compile --disable-pip-version-check torch==2.13.0 numpy==2.4.6

cat > "$work/show.py" <<'PY'
import math
import platform

import torch
from torch.distributions import Categorical, kl_divergence

LEGAL = torch.tensor([True, True, False])
print("Python", platform.python_version(), "torch", torch.__version__)


def show(label, filler, measure):
    """Print the measure of a masked policy, and its gradient for the logits. Return both."""
    logits = torch.tensor([1.0, 2.0, 3.0], requires_grad=True)
    policy = Categorical(logits=logits.masked_fill(~LEGAL, filler))
    prior = Categorical(logits=torch.zeros(3).masked_fill(~LEGAL, filler))
    value = measure(policy, prior)
    value.backward()
    gradient = [round(number, 4) for number in logits.grad.tolist()]
    print(f"{label:25} value {value.item():.4f} gradient {gradient}")
    return round(value.item(), 4), gradient


def forward(policy, prior):
    return kl_divergence(policy, prior)


def backward(policy, prior):
    return kl_divergence(prior, policy)


bad_value, bad = show("-inf,  KL(policy, prior)", -math.inf, forward)
other = show("-inf,  KL(prior, policy)", -math.inf, backward)
entropy = show("-inf,  entropy", -math.inf, lambda policy, _: policy.entropy())
log_prob = show("-inf,  log_prob", -math.inf, lambda policy, _: policy.log_prob(torch.tensor(0)))
good_value, good = show("-1e9,  KL(policy, prior)", -1e9, forward)
good_other = show("-1e9,  KL(prior, policy)", -1e9, backward)

assert bad_value == good_value and other == good_other
assert all(map(math.isfinite, good + other[1] + entropy[1] + log_prob[1]))
assert math.isnan(bad[0]) and math.isnan(bad[1]), "changed: the gradient is a number now"
PY
"$work/venv/bin/python" "$work/show.py"
