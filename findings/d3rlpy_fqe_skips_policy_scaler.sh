#!/usr/bin/env bash
# d3rlpy: fitted Q evaluation (FQE) asks the policy without the policy's own observation scaler.
#
# Who meets it: somebody who trained a policy with StandardObservationScaler (or another scaler),
# and estimates offline how good it is, as the reference page shows: FQE(algo=policy,
# config=FQEConfig()).
#
# The guess: FQE estimates the value of what policy.predict does. The policy has its scaler: it
# is saved with it, and predict uses it.
#
# The behaviour: the targets take the next actions from the policy's inner network. That skips the
# policy's scalers and uses those of FQEConfig, which has none. So another policy is evaluated, and
# there is no warning. The same holds for an action scaler. Give FQEConfig the same scalers.
#
# Seen on 2026-11-29 with Python 3.11.7, d3rlpy 2.8.1, torch 2.13.0, numpy 2.4.6, gymnasium 1.0.0.
# Episodes of two steps; the second pays 1 if the action says whether a sensor is above 2:
#   the policy's actions at 1 and 3: [0, 1], so its value is 1
#   FQEConfig(): asks at 1 and 3 and gets [1, 1], and estimates 0.69
#   FQEConfig(observation_scaler=the same): estimates 0.97
set -euo pipefail

work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install -qq --no-compile --disable-pip-version-check \
    d3rlpy==2.8.1 torch==2.13.0 numpy==2.4.6 gymnasium==1.0.0

cat > "$work/show.py" <<'PY'
import logging
import platform
from importlib.metadata import version

import d3rlpy
import numpy as np
import structlog
import torch
from d3rlpy.algos import DQNConfig
from d3rlpy.dataset import Episode, create_infinite_replay_buffer
from d3rlpy.metrics import InitialStateValueEstimationEvaluator
from d3rlpy.ope import DiscreteFQE, FQEConfig
from d3rlpy.preprocessing import StandardObservationScaler

structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.ERROR))
d3rlpy.seed(0)
generator = np.random.default_rng(0)
SENSORS = np.array([[1.0], [3.0]], np.float32)
FIT = {
    "n_steps": 1500,
    "n_steps_per_epoch": 1500,
    "show_progress": False,
    "logger_adapter": d3rlpy.logging.NoopAdapterFactory(),
}
LEARN = {"learning_rate": 1e-3, "gamma": 1.0, "target_update_interval": 50}


def episode():
    sensor = 2 + generator.choice([-1.0, 1.0], size=(2, 1)).astype(np.float32)
    action = generator.integers(0, 2, size=(2, 1))
    right = action[1, 0] == (sensor[1, 0] > 2)
    return Episode(sensor, action, np.array([[0.0], [float(right)]], np.float32), True)


def estimate(config):
    """Fit FQE to the policy. Return the actions that its targets use, and the value it reports."""
    evaluation = DiscreteFQE(algo=policy, config=config)
    asked = []
    inner = policy.impl.predict_best_action

    def listen(observations):
        actions = inner(observations)
        asked.extend(zip(observations.flatten().tolist(), actions.flatten().tolist()))
        return actions

    policy.impl.predict_best_action = listen
    evaluation.fit(data, **FIT)
    policy.impl.predict_best_action = inner
    return dict(asked), float(InitialStateValueEstimationEvaluator()(evaluation, data))


names = ("d3rlpy", "torch", "numpy", "gymnasium")
print("Python", platform.python_version(), *(f"{name} {version(name)}" for name in names))
data = create_infinite_replay_buffer([episode() for _ in range(500)])
policy = DQNConfig(observation_scaler=StandardObservationScaler(), **LEARN).create()
policy.fit(data, **FIT)
actions = policy.predict(SENSORS).tolist()
print(f"the policy's actions at 1 and 3: {actions}, so its value is 1")
asked, plain = estimate(FQEConfig(**LEARN))
found = [asked[1.0], asked[3.0]]
print(f"FQEConfig(): asks at 1 and 3 and gets {found}, and estimates {plain:.2f}")
_, scaled = estimate(FQEConfig(observation_scaler=StandardObservationScaler(), **LEARN))
print(f"FQEConfig(observation_scaler=the same): estimates {scaled:.2f}")

assert actions == [0, 1]
assert found != actions, "changed: FQE asks with the policy's own scaler now"
assert plain < 0.85 and abs(scaled - 1) < 0.1, "changed: the estimates differ"
PY
"$work/venv/bin/python" -W ignore "$work/show.py"
