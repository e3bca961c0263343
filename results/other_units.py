"""Tasks in units that a user's own task may have, for the rows "Other units" of results/README.md.

    PYTHONPATH=results python dqn_cartpole.py --env-id other_units:CartPoleTimes1000-v0
"""

import math

import gymnasium as gym
import numpy as np


class OtherUnits(gym.ObservationWrapper):
    """A task whose observation is `factor` × the usual one + `offset`, with declared bounds of ±`bound`."""

    def __init__(self, env_id, factor=1.0, offset=0.0, bound=np.inf, render_mode=None):
        super().__init__(gym.make(env_id, render_mode=render_mode))
        self.factor = factor
        self.offset = offset
        self.observation_space = gym.spaces.Box(-bound, bound, self.env.observation_space.shape)

    def observation(self, observation):
        return (self.factor * observation + self.offset).astype(np.float32)


class Trade(gym.Env):
    """A price near 30 000 swings by 1 % in 20 steps. Action 1 holds the stock for a step: reward its change / 100.

    Observation: price, its last change. Perfect foresight earns about 31 in 100 steps, holding for ever 0.
    """

    observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float32)
    action_space = gym.spaces.Discrete(2)

    def __init__(self, render_mode=None):
        self.render_mode = render_mode

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.time = self.np_random.uniform(0, 20)
        self.price = self.change = 0.0
        self._advance()
        self._advance()
        return self._observation(), {}

    def step(self, action):
        self._advance()
        return self._observation(), float(action) * self.change / 100, False, False, {}

    def _advance(self):
        self.time += 1
        price = 30_000 + 300 * math.sin(2 * math.pi * self.time / 20) + self.np_random.normal(0, 10)
        self.change = price - self.price
        self.price = price

    def _observation(self):
        return np.array([self.price, self.change], np.float32)


def flat_frozen_lake(render_mode=None):
    """FrozenLake without slipping, its state one of 16 as 16 numbers: one reward, at the goal."""
    return gym.wrappers.FlattenObservation(gym.make("FrozenLake-v1", is_slippery=False, render_mode=render_mode))


UNITS = {
    "CartPoleTimes1000-v0": ("CartPole-v0", 200, {"factor": 1000}),
    "CartPoleBounds1e8-v0": ("CartPole-v0", 200, {"factor": 1000, "bound": 1e8}),
    "CartPolePlus1000-v0": ("CartPole-v0", 200, {"offset": 1000}),
    "PendulumTimes100-v0": ("Pendulum-v1", 200, {"factor": 100}),
    "PendulumTimes1000-v0": ("Pendulum-v1", 200, {"factor": 1000}),
    "PendulumPlus1000-v0": ("Pendulum-v1", 200, {"offset": 1000}),
}
for name, (env_id, limit, units) in UNITS.items():
    gym.register(name, OtherUnits, max_episode_steps=limit, kwargs={"env_id": env_id} | units)
gym.register("Trade-v0", Trade, max_episode_steps=100)
gym.register("FlatFrozenLake-v0", flat_frozen_lake, max_episode_steps=100)
