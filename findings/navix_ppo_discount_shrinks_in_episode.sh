#!/usr/bin/env bash
# navix: its PPO discounts step t of an episode by gamma ** t, not by gamma.
#
# Who meets it: everybody who trains the agent that comes with it, navix.agents.PPO, on a task
# whose reward comes at the end of the episode, such as to reach a goal.
#
# The guess: env.gamma is the discount of one step. With gamma = 0.99, lambda = 1, values of 0 and
# a reward of 1 in the last of 100 steps, the target k steps before the end is 0.99 ** k.
#
# The behaviour: the agent gives rlax's advantage estimator, which wants the discount of each
# step, the number gamma ** t, with t counted from the start of the episode. Late in an episode
# one step is discounted by 0.37. Ten steps before the end nothing is left of the reward, and the
# same transition has another target when it comes later. Only short episodes hide it.
#
# Seen on 2026-11-29 with Python 3.11.7, navix 0.7.4, rlax 0.1.9, jax 0.10.2, flax 0.12.8:
#   Navix-Empty-5x5-v0: t of the first steps 0 1 2 3, gamma 0.99
#   steps to the end:      0        1        2        4        9       19       99
#   0.99 ** steps:    1.0000   0.9900   0.9801   0.9606   0.9135   0.8262   0.3697
#   PPO's target:     1.0000   0.3735   0.1409   0.0207   0.0002   0.0000   0.0000
set -euo pipefail

work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install -qq --no-compile --disable-pip-version-check \
    navix==0.7.4 rlax==0.1.9 jax==0.10.2 jaxlib==0.10.2 flax==0.12.8 numpy==2.4.6

cat > "$work/show.py" <<'PY'
import platform
from importlib.metadata import version
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import navix
from navix.agents.ppo import PPO, Buffer, PPOHparams

STEPS = 100
GAMMA = 0.99

names = ("navix", "rlax", "jax", "flax")
print("Python", platform.python_version(), *(f"{name} {version(name)}" for name in names))
env = navix.make("Navix-Empty-5x5-v0", gamma=GAMMA)
step = jax.jit(env.step)
now = env.reset(jax.random.PRNGKey(0))
times = [int(now.t)]
for _ in range(3):
    now = step(now, jnp.asarray(0))
    times.append(int(now.t))
print("Navix-Empty-5x5-v0: t of the first steps", *times, "gamma", env.gamma)
assert times == [0, 1, 2, 3]


def column(numbers):
    return jnp.asarray(numbers, jnp.float32)[:, None]


# One environment, one whole episode: its last step pays 1 and ends it. The values are 0.
last = column([0.0] * (STEPS - 1) + [1.0])
episode = Buffer(
    done=last,
    reward=last,
    t=jnp.arange(STEPS)[:, None],
    obs=jnp.zeros((STEPS, 1, 1)),
    action=None,
    log_prob=None,
    info=None,
    state=None,
)
agent = PPO(hparams=PPOHparams(gae_lambda=1.0), network=None, env=env)
critic = SimpleNamespace(params=None, value_fn=lambda params, observation: jnp.zeros(observation.shape[0]))
_, _, targets = agent.evaluate_experience(critic, episode, jnp.zeros(1))

ahead = [0, 1, 2, 4, 9, 19, 99]
right = [GAMMA**k for k in ahead]
found = [float(targets[STEPS - 1 - k, 0]) for k in ahead]
print("steps to the end:", *(f"{k:6d}  " for k in ahead))
print("0.99 ** steps:  ", *(f"{x:8.4f}" for x in right))
print("PPO's target:   ", *(f"{x:8.4f}" for x in found))

assert abs(found[0] - 1) < 1e-6
product = 1.0
for k in range(1, STEPS):
    product *= GAMMA ** (STEPS - 1 - k)
    target = float(targets[STEPS - 1 - k, 0])
    assert abs(target - product) < 1e-4, f"changed: {k} steps before the end the target is {target}"
assert abs(found[1] - right[1]) > 0.5, "changed: the discount of one step is gamma now"
PY
JAX_PLATFORMS=cpu "$work/venv/bin/python" -W ignore "$work/show.py"
