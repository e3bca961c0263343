#!/usr/bin/env bash
# torch's vector_to_parameters: it says that it copies, but the network then lives inside the vector.
#
# Who meets it: somebody who works on all weights of a policy as one long vector, as in evolution
# strategies, the cross-entropy method, TRPO, or when a population starts from one parent.
#
# The guess: the documentation says "Copy slices of a vector into an iterable of parameters". So
# the numbers are copied, as load_state_dict does. Later the vector and the network go their own
# ways. Two networks which were filled from one vector do not touch each other.
#
# The behaviour: each parameter becomes a view of the vector. Nothing is copied. Train one of the
# two networks and the other one has the new weights too, and so has the vector that was kept as
# "the parent" or "the best so far". And "vector += step" changes the network at once, without
# another call. There is no error and no warning. Give the function vector.clone().
#
# Seen on 2026-11-29 with Python 3.11.7 and torch 2.13.0+cpu:
#   parent vector 0 0 0, two children filled from it, then one step of SGD on child 1 alone:
#   vector_to_parameters: child 1 [-0.5, -0.5, -0.5] child 2 [-0.5, -0.5, -0.5] parent [-0.5, -0.5, -0.5]
#   with .clone():        child 1 [-0.5, -0.5, -0.5] child 2 [0.0, 0.0, 0.0] parent [0.0, 0.0, 0.0]
#   load_state_dict:      child 1 [-0.5, -0.5, -0.5] child 2 [0.0, 0.0, 0.0] parent [0.0, 0.0, 0.0]
#   policy filled from a vector of 0, then vector += 1: policy [1.0, 1.0, 1.0]
set -euo pipefail

work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install -qq --no-compile --disable-pip-version-check torch==2.13.0 numpy==2.4.6

cat > "$work/show.py" <<'PY'
import platform

import torch
from torch.nn.utils import parameters_to_vector, vector_to_parameters

SAME, LATER = [0.0, 0.0, 0.0], [-0.5, -0.5, -0.5]


def numbers(network):
    return parameters_to_vector(network.parameters()).tolist()


def fill_shared(network, vector):
    vector_to_parameters(vector, network.parameters())


def fill_clone(network, vector):
    vector_to_parameters(vector.clone(), network.parameters())


def fill_state(network, vector):
    network.load_state_dict({"weight": vector[:2].view(1, 2), "bias": vector[2:]})


def train_one(label, fill):
    """Fill two networks from one vector. Train the first. Return all three sets of numbers."""
    parent = torch.zeros(3)
    children = [torch.nn.Linear(2, 1) for _ in range(2)]
    for child in children:
        fill(child, parent)
        assert numbers(child) == SAME
    optimizer = torch.optim.SGD(children[0].parameters(), lr=0.5)
    children[0](torch.ones(1, 2)).sum().backward()
    optimizer.step()
    seen = numbers(children[0]), numbers(children[1]), parent.tolist()
    print(f"{label:21} child 1 {seen[0]} child 2 {seen[1]} parent {seen[2]}")
    return seen


print("Python", platform.python_version(), "torch", torch.__version__)
print("parent vector 0 0 0, two children filled from it, then one step of SGD on child 1 alone:")
shared = train_one("vector_to_parameters:", fill_shared)
clone = train_one("with .clone():", fill_clone)
state = train_one("load_state_dict:", fill_state)

policy, vector = torch.nn.Linear(2, 1), torch.zeros(3)
vector_to_parameters(vector, policy.parameters())
vector += 1
moved = numbers(policy)
print("policy filled from a vector of 0, then vector += 1: policy", moved)

assert clone == state == (LATER, SAME, SAME)
assert shared == (LATER, LATER, LATER), "changed: the numbers are copied now"
assert moved == [1.0, 1.0, 1.0], "changed: the policy keeps its own numbers now"
PY
"$work/venv/bin/python" "$work/show.py"
