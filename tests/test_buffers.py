"""The replay buffers of both scripts: what they store, overwrite and sample."""

import importlib

import numpy as np
import pytest
import torch


@pytest.fixture
def buffer(script):
    """Of five transitions, with two numbers in an observation."""
    sizes = (2, 1) if script == "sac_minitaur" else (2,)
    return importlib.import_module(script).ReplayBuffer(5, *sizes, "cpu")


def steps(first, count, num_envs):
    """Transitions whose numbers tell which they are: n counts them over all environments, number 6 terminates."""
    for n in np.arange(first, first + count).reshape(-1, num_envs):
        observations = np.stack((n, n + 0.5), axis=1).astype(np.float32)
        yield observations, n % 2, 10.0 * n, n == 6, observations + 0.25


@pytest.mark.parametrize("num_envs", (1, 3))
def test_samples_all_that_is_stored_and_nothing_else(buffer, num_envs):
    torch.manual_seed(0)
    buffer.rows.fill_(torch.nan)
    for first, count, stored in ((0, 3, {0, 1, 2}), (3, 6, {4, 5, 6, 7, 8})):  # the second wraps around
        for step in steps(first, count, num_envs):
            buffer.add(*step)
        assert (buffer.size, buffer.position) == (len(stored), (first + count) % 5)
        observations, actions, rewards, terminated, next_observations = buffer.sample(5000)
        n = rewards / 10
        assert observations.shape == next_observations.shape == (5000, 2)
        assert n.shape == terminated.shape == (5000,) and set(n.tolist()) == stored
        assert n.long().bincount()[min(stored) :].min() > 0.85 * 5000 / len(stored)  # uniformly
        assert torch.equal(observations, torch.stack((n, n + 0.5), 1))
        assert torch.equal(next_observations, observations + 0.25)
        assert torch.equal(actions.reshape(-1), (n % 2).to(actions.dtype)) and torch.equal(terminated, (n == 6).float())
        assert actions.shape == ((5000, 1) if hasattr(buffer, "rewards") else (5000,))
        assert actions.dtype == (torch.float32 if hasattr(buffer, "rewards") else torch.int64)
        everything = buffer.rewards() if hasattr(buffer, "rewards") else buffer.observations_and_rewards()[1]
        assert sorted(everything.tolist()) == [10.0 * n for n in sorted(stored)]
