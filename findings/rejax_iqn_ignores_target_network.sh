#!/usr/bin/env bash
# rejax: its IQN never reads the target network. polyak and target_update_freq change nothing.
#
# Who meets it: somebody who trains rejax.IQN, or sweeps target_update_freq to see how much a slow
# target helps, and finds that it makes no difference.
#
# The guess: as in DQN of the same library, the targets come from the target network. A copy at
# each update, a copy every 500 steps and a copy that is never renewed give three different
# agents.
#
# The behaviour: IQN stores a target network and updates it as asked. But both the best next
# action and its quantiles come from the network that is being trained. The weights after
# training are the same to the last bit, whatever the two settings are.
#
# Seen on 2026-11-29 with Python 3.11.7, rejax 0.1.3, gymnax 0.0.9, jax 0.10.2, flax 0.12.8,
# CartPole-v1, 2 000 steps, seed 0, the largest difference of a weight (gymnax 1 has another step()):
#   DQN: copy each step and every 500: 1.14, and never renewed: 1.23
#   IQN: copy each step and every 500: 0, and never renewed: 0
#   IQN, for comparison, two learning rates: 2
set -euo pipefail

work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install -qq --no-compile --disable-pip-version-check \
    rejax==0.1.3 gymnax==0.0.9 jax==0.10.2 jaxlib==0.10.2 flax==0.12.8 numpy==2.4.6

cat > "$work/show.py" <<'PY'
import platform
from importlib.metadata import version

import jax
import jax.numpy as jnp
from rejax import DQN, IQN

NEVER = 1_000_000


def weights(algorithm, target_update_freq, learning_rate=1e-3, **options):
    """Train on CartPole. Return all weights of the network, and of its target, flat."""
    agent = algorithm.create(
        env="CartPole-v1",
        total_timesteps=2_000,
        eval_freq=2_000,
        skip_initial_evaluation=True,
        fill_buffer=500,
        buffer_size=2_000,
        num_envs=1,
        batch_size=32,
        learning_rate=learning_rate,
        polyak=0.0,  # the target becomes a plain copy
        target_update_freq=target_update_freq,
        **options,
    )
    agent = agent.replace(eval_callback=lambda *_: ())
    state, _ = jax.jit(agent.train)(jax.random.PRNGKey(0))
    flat = [jnp.concatenate([leaf.ravel() for leaf in jax.tree.leaves(tree)])
            for tree in (state.q_ts.params, state.q_target_params)]
    return flat


def difference(a, b):
    return float(jnp.abs(a - b).max())


names = ("rejax", "gymnax", "jax", "flax")
print("Python", platform.python_version(), *(f"{name} {version(name)}" for name in names))
few = {"num_tau_samples": 8, "num_tau_prime_samples": 8}
for algorithm, options in ((DQN, {}), (IQN, few)):
    each, each_target = weights(algorithm, 1, **options)
    some, _ = weights(algorithm, 500, **options)
    never, never_target = weights(algorithm, NEVER, **options)
    a, b = difference(each, some), difference(each, never)
    print(f"{algorithm.__name__}: copy each step and every 500: {a:.3g}, and never renewed: {b:.3g}")
    assert difference(each_target, never_target) > 0.01  # the settings reach the target network itself
    if algorithm is DQN:
        assert a > 0.01 and b > 0.01
    else:
        assert a == b == 0, "changed: IQN reads its target network now"
faster, _ = weights(IQN, 1, learning_rate=2e-3, **few)
print(f"IQN, for comparison, two learning rates: {difference(each, faster):.2g}")
assert difference(each, faster) > 0.01
PY
JAX_PLATFORMS=cpu "$work/venv/bin/python" -W ignore "$work/show.py"
