#!/usr/bin/env bash
# cherry: TanhNormal adds the whole normal log-density to each of the action's numbers. SAC sums that.
#
# Who meets it: somebody who trains cherry's SAC, or uses its TanhNormal, with actions of more
# than one number, and tunes the entropy's weight to a target entropy.
#
# The guess: log_prob of a batch (B, A) gives each number's own log-density, (B, A), as in
# torch.distributions, or the joint one, (B, 1). SAC.actions_log_probs sums them over the A
# numbers to the joint density.
#
# The behaviour: cherry's Normal already sums over the A numbers, to (B, 1). The correction for tanh
# is (B, A). The difference of both is (B, A) by broadcasting, and SAC sums it: so the normal
# part counts A times, the correction once. With 6 numbers the entropy is 7.3 where 0.8 is right,
# and a target of -6 asks for something else. With one number all is right.
#
# Seen on 2026-11-29 with Python 3.11.7, cherry-rl 0.2.0, torch 2.13.0, numpy 2.4.6, gym 0.23.1; standard
# deviation 0.3, 20 000 actions; the entropy as SAC estimates it, and by torch.distributions:
#   1 number:  0.133, right 0.133
#   2 numbers: 0.695, right 0.261
#   6 numbers: 7.257, right 0.777
#   log_prob of [0.3, -0.1, 0.5]: [-1.61, -1.69, -1.42], right [-0.16, -0.76, -0.4]
set -euo pipefail

work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install -qq --no-compile --disable-pip-version-check \
    cherry-rl==0.2.0 gym==0.23.1 six==1.17.0 torch==2.13.0 numpy==2.4.6

cat > "$work/show.py" <<'PY'
import platform
from importlib.metadata import version

import torch
from cherry.algorithms import SAC
from cherry.distributions import TanhNormal
from torch.distributions import Normal, TanhTransform, TransformedDistribution


def reference(mean, std):
    return TransformedDistribution(Normal(mean, std), [TanhTransform()])


def entropies(numbers):
    """By cherry's SAC and by torch.distributions, of the same actions."""
    torch.manual_seed(0)
    mean = torch.zeros(20_000, numbers)
    std = torch.full((20_000, numbers), 0.3)
    actions, log_probs = SAC.actions_log_probs(TanhNormal(mean, std))
    right = reference(mean, std).log_prob(actions).sum(-1)
    return float(-log_probs.mean()), float(-right.mean())


def rounded(tensor):
    return [round(x, 2) for x in tensor.flatten().tolist()]


names = ("cherry-rl", "torch", "numpy", "gym")
print("Python", platform.python_version(), *(f"{name} {version(name)}" for name in names))
found = {numbers: entropies(numbers) for numbers in (1, 2, 6)}
for numbers, (estimate, right) in found.items():
    word = "number: " if numbers == 1 else "numbers:"
    print(f"{numbers} {word} {estimate:.3f}, right {right:.3f}")
mean = torch.tensor([[0.2, -0.4, 0.1]])
std = torch.tensor([[0.5, 0.8, 0.6]])
action = torch.tensor([[0.3, -0.1, 0.5]])
given = TanhNormal(mean, std).log_prob(action)
right = reference(mean, std).log_prob(action)
print(f"log_prob of [0.3, -0.1, 0.5]: {rounded(given)}, right {rounded(right)}")

normal = Normal(mean, std).log_prob(torch.atanh(action))
several = right - normal + normal.sum()
assert torch.allclose(given, several, atol=1e-4), "changed: another log-density"
assert abs(found[1][0] - found[1][1]) < 1e-3
assert found[6][0] > found[6][1] + 5, "changed: SAC's entropy is right for several numbers now"
PY
"$work/venv/bin/python" -W ignore "$work/show.py"
