"""The algorithms piece by piece, against numbers worked out by hand: what to run after a change of the scripts.

    python -m pytest tests/test_formulas.py    # seconds, on every system; needs no pybullet

Losses, targets, log-probabilities, replay buffers, one update, and that a time limit is no end of the task.
"""

import copy
import math
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
import torch
from torch import nn
from torch.distributions import Independent, Normal, TanhTransform, TransformedDistribution

import common
import dqn_cartpole
import sac_minitaur
from dqn_cartpole import DQNAgent, QNetwork
from sac_minitaur import Actor, SACAgent

CPU = torch.device("cpu")


# DQN


def dqn_agent(**choices):
    torch.manual_seed(0)
    config = dqn_cartpole.Config(**{"layers": (8, 6)} | choices)
    space = gym.spaces.Box(np.float32([-4, -np.inf, -0.4, -np.inf]), np.float32([4, np.inf, 0.4, np.inf]))
    return DQNAgent(config, space, gym.spaces.Discrete(2), CPU)


def dqn_batch(size=64):
    """As `ReplayBuffer.sample` returns it."""
    s, next_s = torch.randn(2, size, 4)
    return s, torch.randint(2, (size,)), torch.ones(size), torch.randint(2, (size,)).float(), next_s


def test_dqn_targets():
    """Only `terminated` cuts the bootstrap."""
    rewards = torch.tensor([1.0, 1.0, 2.0])
    next_q = torch.tensor([[10.0, 20.0], [10.0, 20.0], [-4.0, 8.0]])
    targets = dqn_cartpole.td_targets(rewards, torch.tensor([0.0, 1.0, 0.0]), next_q, gamma=0.5)
    assert targets.tolist() == [1 + 0.5 * 20, 1.0, 2 + 0.5 * 8]


def test_gap_to_best():
    gap = dqn_cartpole.gap_to_best(torch.tensor([[3.0, 1.0, 2.0], [3.0, 1.0, 2.0]]), torch.tensor([0, 1]))
    assert gap.tolist() == [0.0, 2.0]


@pytest.mark.parametrize("tutorial", (False, True))
def test_dqn_update(tutorial):
    """From the formulas, with Adam's first step −lr · g / (|g| + ε): textbook DQN as the tutorial's, and ours."""
    choices = {"gamma": 0.9, "target_update_tau": 0.25, "learning_rate": 0.01, "adam_epsilon": 0.03}
    agent = dqn_agent(**(dqn_cartpole.TUTORIAL | choices if tutorial else choices))
    agent.target_network.load_state_dict(QNetwork(4, 2, (8, 6)).state_dict())  # unlike the Q-network
    old_target = [parameter.clone() for parameter in agent.target_network.parameters()]
    batch = dqn_batch()
    observations, actions, rewards, terminated, next_observations = batch
    agent.fit_scaling(observations, torch.tensor([-1.0, 3.0]))  # of mean 1 and mean size 2
    offset, scale = (0.0, 1.0) if tutorial else (10.0, 20.0)  # divided by 1 − 0.9: an endless episode's value
    assert (agent.value_offset.item(), agent.value_scale.item()) == pytest.approx((offset, scale))
    here = agent.scaling(observations)
    there = agent.scaling(next_observations)
    assert torch.equal(here, observations) == tutorial

    q = offset + scale * torch.where(actions == 0, *agent.q_network(here).unbind(1))
    with torch.no_grad():
        y = rewards + 0.9 * (1 - terminated) * (offset + scale * agent.target_network(there).max(1).values)
        if not tutorial:
            outputs = agent.target_network(here)
            own, other = torch.where(actions == 0, outputs.T, outputs.flip(1).T)
            y -= 0.9 * scale * (other - own).clamp(min=0)
    loss = (y - q).square().mean()
    gradients = torch.autograd.grad(loss, list(agent.q_network.parameters()))
    old = [parameter.detach().clone() for parameter in agent.q_network.parameters()]
    metrics = agent.update(batch, 9000)
    learning_rate = 0.01 if tutorial else 0.01 / (1 + (9000 / 3000) ** 2)
    torch.testing.assert_close(metrics, {"loss": loss.detach(), "mean_q": q.mean().detach()})
    moved = zip(gradients, old, old_target, agent.q_network.parameters(), agent.target_network.parameters())
    for gradient, before, target_before, after, target in moved:
        torch.testing.assert_close(after.grad, gradient)
        step = -learning_rate * gradient / (gradient.abs() + 0.03)
        torch.testing.assert_close(after.detach(), before + step, rtol=1e-5, atol=1e-6)
        assert gradient.any() and not target.requires_grad
        torch.testing.assert_close(target, 0.75 * target_before + 0.25 * after.detach())


def test_dqn_learning_rate():
    """It is half after 2 updates with a decay of 2, a tenth after 6, and stays as it is without."""
    for decay, expected in ((2, [0.01, 0.005, 0.001]), (None, 3 * [0.01])):
        agent = dqn_agent(learning_rate=0.01, learning_rate_decay=decay)
        rates = []
        for step in (0, 2, 6):
            agent.update(dqn_batch(), step)
            rates.append(agent.optimizer.param_groups[0]["lr"])
        assert rates == pytest.approx(expected)


def test_dqn_starts_as_the_tutorials_network():
    torch.manual_seed(0)
    first, _, second, _, last = QNetwork(400, 2, (500, 300)).net
    for layer in (first, second):
        std = math.sqrt(2 / layer.in_features)
        assert layer.weight.std().item() == pytest.approx(std, rel=0.01)
        assert 1.99 * std / 0.8796 < layer.weight.abs().max().item() <= 2 * std / 0.8796
        assert (layer.bias == 0).all()
    assert 0.029 < last.weight.abs().max().item() <= 0.03
    assert last.weight.std().item() == pytest.approx(0.03 / math.sqrt(3), rel=0.1)
    assert (last.bias == -0.2).all()


def test_dqn_acts_greedily_but_for_a_part_of_the_actions():
    agent = dqn_agent(epsilon=0.3)
    observations = torch.randn(4000, 4)
    with torch.no_grad():
        outputs = agent.q_network(agent.scaling(observations))
        gap = outputs[:, 1] - outputs[:, 0]
        agent.q_network.net[-1].bias[0] += gap.median()  # each action is best in half of the states
    greedy = agent.q_network(agent.scaling(observations)).argmax(1)
    assert torch.equal(agent.policy(observations), greedy) and greedy.sum() == pytest.approx(2000, abs=50)
    action = agent.policy.act(observations[0].double().numpy())
    assert action == greedy[0] and type(action) is np.int64  # as its space's samples
    assert agent.act(np.zeros(4)) in (0, 1)  # float64
    actions = torch.tensor([agent.act(observation) for observation in observations.numpy()])
    # One half of the random actions is greedy by chance: 0.85, with a standard deviation of 0.006.
    assert (actions == greedy).float().mean() == pytest.approx(1 - 0.3 / 2, abs=0.025)


@pytest.mark.parametrize(
    "gamma, rewards, unit", [(0.9, [0.0, 0.0], (0, 1)), (0.9, [0.0, -4.0], (-20, 20)), (1, [0.0, -4.0], (0, 1))]
)
def test_dqn_value_unit(gamma, rewards, unit):
    """It is 1 where no reward was seen, and without a discount."""
    agent = dqn_agent(gamma=gamma)
    agent.fit_scaling(torch.ones(2, 4), torch.tensor(rewards))
    assert (agent.value_offset.item(), agent.value_scale.item()) == pytest.approx(unit)


# The observations' scales, of both scripts


def fitted(low, high, data):
    scaling = common.ObservationScaling(gym.spaces.Box(np.float32(low), np.float32(high)))
    scaling.fit(torch.tensor(data))
    return scaling


def test_bounds_are_mapped_to_one():
    """From [2, 6] and [-4, 4]; without bounds or width, or with those that float32 cannot subtract: as they are."""
    huge = np.finfo(np.float32).max
    low, high = np.float32([[2, -4], [-np.inf, 0], [-huge, 5]]), np.float32([[6, 4], [np.inf, np.inf], [huge, 5]])
    scaling = common.ObservationScaling(gym.spaces.Box(low, high))
    observations = torch.tensor([[2.0, -4, 3, 3, 3, 5], [6, 4, -7, -7, -7, 5], [4, 1, 0, 0, 0, 5]])
    scaled = [[-1.0, -1, 3, 3, 3, 5], [1, 1, -7, -7, -7, 5], [0, 0.25, 0, 0, 0, 5]]
    assert scaling(observations).tolist() == scaled
    scaling.fit(observations)
    assert scaling(observations).tolist() == scaled


def test_bounds_that_nobody_reaches_are_dropped():
    """Of 35 and 1e8, more than 130 times wider than the data. 30 stays, and a byte's that was constant."""
    data = [[0.25, 300.0, 0.25, 0.0], [-0.25, -300, -0.25, 0]]
    scaling = fitted([-35, -1e8, -30, 0], [35, 1e8, 30, 255], data)
    torch.testing.assert_close(scaling(torch.tensor([2.0, 600, 15, 255])), torch.tensor([2.0, 1.0, 0.5, 1.0]))


def test_numbers_without_bounds_are_scaled_only_beyond_ten():
    inf = np.inf
    scaling = fitted([-inf] * 4, [inf] * 4, [[1000.0, -3, 30000, 5000], [1002, 9, 30100, 5000]])
    assert scaling(torch.tensor([1002.0, 9, 30050, 5001])).tolist() == [0.5, 9, 0, 0.5]


# SAC


def sac_agent(observation_size=3, action_size=2, state_size=None, device=CPU, **choices):
    torch.manual_seed(0)
    config = sac_minitaur.Config(**{"actor_layers": (16, 16), "critic_layers": (16, 12)} | choices)
    observation_space = gym.spaces.Box(-np.inf, np.inf, (observation_size,))
    action_space = gym.spaces.Box(-1, 1, (action_size,))
    return SACAgent(config, observation_space, action_space, state_size or observation_size, device)


def sac_batch(size=32, state_size=3, action_size=2):
    """As `ReplayBuffer.sample` returns it."""
    generator = torch.Generator().manual_seed(1)
    observations, next_observations = torch.randn(2, size, state_size, generator=generator)
    actions = 2 * torch.rand(size, action_size, generator=generator) - 1
    rewards = torch.randn(size, generator=generator)
    terminated = (torch.rand(size, generator=generator) < 0.3).float()
    return observations, actions, rewards, terminated, next_observations


def test_sac_targets():
    rewards = torch.tensor([1.0, 1.0, -2.0])
    terminated = torch.tensor([0.0, 1.0, 0.0])
    next_q = torch.tensor([[4.0, 4.0, 7.0], [3.0, 3.0, 9.0]])
    next_log_probs = torch.tensor([-2.0, -2.0, 4.0])
    targets = sac_minitaur.td_targets(rewards, terminated, next_q, next_log_probs, alpha=torch.tensor(0.5), gamma=0.9)
    # The second's episode has ended: 1 + 0.9 (3 + 0.5 · 2), 1, −2 + 0.9 (7 − 0.5 · 4).
    torch.testing.assert_close(targets, torch.tensor([4.6, 1.0, 2.5]))


def test_critic_loss():
    q = torch.tensor([[1.0, 2.0], [3.0, 5.0]], requires_grad=True)
    loss = sac_minitaur.critic_loss(q, torch.tensor([2.0, 2.0]), weight=0.5)
    assert loss.item() == 0.5 * ((1 + 0) / 2 + (1 + 9) / 2)
    loss.backward()
    assert q.grad.tolist() == [[-0.5, 0.0], [0.5, 1.5]]  # (q − target) / B: towards the target


def test_actor_loss():
    log_probs = torch.tensor([-1.0, -3.0], requires_grad=True)
    q = torch.tensor([[1.0, 4.0], [2.0, 3.0]], requires_grad=True)
    loss = sac_minitaur.actor_loss(log_probs, q, torch.tensor(0.5))
    assert loss.item() == ((-0.5 - 1) + (-1.5 - 3)) / 2
    loss.backward()
    assert log_probs.grad.tolist() == [0.25, 0.25]  # less likely actions, so more entropy
    assert q.grad.tolist() == [[-0.5, 0.0], [0.0, -0.5]]  # more of the smaller twin


@pytest.mark.parametrize("log_prob, gradient", [(-2.0, 3.0), (5.0, -4.0)])
def test_alpha_loss(log_prob, gradient):
    log_alpha = torch.tensor(2.0, requires_grad=True)
    log_probs = torch.full((4,), log_prob, requires_grad=True)
    loss = sac_minitaur.alpha_loss(log_alpha, log_probs, target_entropy=-1.0)
    assert loss.item() == 2 * gradient
    loss.backward()
    # An entropy of 2, above the target, lets α fall; one of −5 lets it rise.
    assert log_alpha.grad.item() == gradient
    assert log_probs.grad is None


def test_log_probabilities_are_those_of_torch_distributions():
    torch.manual_seed(0)
    actor = Actor(3, 2, (16,)).double()
    observations = torch.randn(500, 3, dtype=torch.float64)
    actions, log_probs = actor.sample(observations)
    mean, log_std = actor(observations)
    assert mean.shape == log_std.shape == actions.shape == (500, 2) and log_probs.shape == (500,)
    expected = TransformedDistribution(Independent(Normal(mean, log_std.exp()), 1), TanhTransform()).log_prob(actions)
    assert actions.abs().max() > 0.95
    torch.testing.assert_close(log_probs, expected, rtol=1e-6, atol=1e-6)
    # The samples are the distribution's: standard normal before scaling, shifting and squashing.
    normal = (actions.atanh() - mean) / log_std.exp()
    assert normal.mean().abs() < 0.15 and (normal.std() - 1).abs() < 0.15


@pytest.mark.parametrize("mean", [20.0, -20.0])
def test_log_probabilities_where_tanh_saturates(mean):
    actor = Actor(3, 2, ())
    with torch.no_grad():
        actor.net[0].weight.zero_()
        actor.net[0].bias.copy_(torch.tensor([mean, mean, -100.0, 100.0]))
    torch.manual_seed(0)
    actions, log_probs = actor.sample(torch.zeros(5, 3))
    assert (actions[:, 0] == math.copysign(1, mean)).all()  # the very ends, where atanh is infinite
    torch.manual_seed(0)
    log_std = torch.tensor([-20.0, 2.0], dtype=torch.float64)  # the bounds that ±100 are clamped to
    u = mean + log_std.exp() * torch.randn(5, 2).double()
    log_normal = Normal(mean, log_std.exp()).log_prob(u)
    log_determinant = TanhTransform().log_abs_det_jacobian(u, u.tanh())
    torch.testing.assert_close(log_probs.double(), (log_normal - log_determinant).sum(1), rtol=1e-5, atol=1e-4)
    (log_probs.sum() + actions.sum()).backward()
    assert actor.net[0].bias.grad.isfinite().all()


def test_sac_networks_start_glorot_uniform():
    net = sac_minitaur.mlp(28, (256, 256), 8)
    linears = [layer for layer in net if isinstance(layer, nn.Linear)]
    assert [tuple(layer.weight.shape) for layer in linears] == [(256, 28), (256, 256), (8, 256)]
    for layer in linears:
        bound = math.sqrt(6 / sum(layer.weight.shape))
        assert 0.95 * bound < layer.weight.abs().max() <= bound and (layer.bias == 0).all()
        assert layer.weight.std().item() == pytest.approx(bound / math.sqrt(3), rel=0.1)


def test_twin_critics_normalize_the_inputs_of_their_layers_and_are_independent():
    critics = sac_agent().critics
    norms = [module for module in critics.modules() if isinstance(module, nn.BatchNorm1d)]
    assert [norm.num_features for norm in norms] == 2 * [3 + 2, 16, 12]
    assert {(norm.momentum, norm.eps) for norm in norms} == {(0.01, 1e-3)}  # CrossQ's
    observations, actions, *_ = sac_batch()
    q = critics(observations, actions)
    assert q.shape == (2, 32) and not torch.allclose(q[0], q[1])
    q[0].sum().backward()
    assert all(parameter.grad.any() for parameter in critics.q1.parameters())
    assert not any(parameter.grad.any() for parameter in critics.q2.parameters())


def test_policy_acts_with_the_mean_in_the_tasks_units():
    action_space = gym.spaces.Box(np.float32([[0, -3], [-1, 5]]), np.float32([[10, 1], [1, 6]]))
    config = sac_minitaur.Config(actor_layers=(16,))
    policy = sac_minitaur.Policy(config, gym.spaces.Box(-2, 2, (2, 3)), action_space)
    observations = torch.randn(5, 2, 3)
    actions = policy(observations)
    mean, _ = policy.actor(observations.flatten(1) / 2)  # scaled
    squashed = mean.tanh().view(5, 2, 2)
    expected = torch.tensor([[5.0, -1.0], [0.0, 5.5]]) + torch.tensor([[5.0, 2.0], [1.0, 0.5]]) * squashed
    torch.testing.assert_close(actions, expected)
    np.testing.assert_allclose(policy.act(observations[0].numpy()), expected[0].detach(), rtol=1e-5, atol=1e-6)
    with torch.no_grad():
        policy.actor.net[-1].bias[:4] = 100
    assert torch.equal(policy(observations)[0].detach(), torch.as_tensor(action_space.high))


@pytest.mark.parametrize("batch_norm", (True, False))
def test_sac_update(batch_norm):
    """Against separate gradients and Adam's first step by hand: −lr · g / (|g| + ε). No value is the default's."""
    choices = {
        "adam_epsilon": 1e-2, "critic_learning_rate": 2e-3, "actor_learning_rate": 3e-3, "alpha_learning_rate": 4e-3,
        "gamma": 0.9, "critic_loss_weight": 0.7, "initial_log_alpha": -0.5, "averaged_actor_tau": 0.3,
        "target_update_tau": 0.2, "adam_beta1": 0.7,
    }  # fmt: skip
    agent = sac_agent(**choices, critic_batch_norm=batch_norm)
    assert {optimizer.defaults["betas"] for optimizer in agent.optimizers} == {(0.7, 0.999)}
    agent.critics.eval()  # as the update before has left them
    config, batch = agent.config, sac_batch()
    observations, actions, rewards, terminated, next_observations = batch
    agent.fit_scaling(100 * observations, 3 * rewards)
    rewards = agent.reward_scale * rewards
    scaled, next_scaled = agent.scaling(observations), agent.scaling(next_observations)
    assert not torch.allclose(scaled, observations)
    alpha = agent.log_alpha.exp().item()
    with torch.no_grad():
        followers = (agent.policy.actor,) if batch_norm else (agent.policy.actor, agent.target_critics)
        for parameter in nn.ModuleList(followers).parameters():  # else they would equal what they follow
            parameter += 0.05 * torch.randn_like(parameter)
    actor, critics, target_critics = (copy.deepcopy(m) for m in (agent.actor, agent.critics, agent.target_critics))
    critics.train()
    averaged = [parameter.clone() for parameter in agent.policy.actor.parameters()]

    def adam_step(parameters, gradients, learning_rate):
        with torch.no_grad():
            for parameter, gradient in zip(parameters, gradients):
                parameter -= learning_rate * gradient / (gradient.abs() + config.adam_epsilon)

    torch.manual_seed(5)
    metrics = agent.update(batch, 0)

    torch.manual_seed(5)
    with torch.no_grad():
        next_actions, next_log_probs = actor.sample(next_scaled)
    if batch_norm:
        q = critics(torch.cat((scaled, next_scaled)), torch.cat((actions, next_actions)))
        q, next_q = q[:, :32], q[:, 32:].detach()
        critics.eval()
    else:
        q, next_q = critics(scaled, actions), target_critics(next_scaled, next_actions).detach()
    targets = rewards + 0.9 * (1 - terminated) * (next_q.min(0).values - alpha * next_log_probs)
    loss = 0.7 * ((q[0] - targets) ** 2).mean() + 0.7 * ((q[1] - targets) ** 2).mean()
    critic_gradients = torch.autograd.grad(loss, list(critics.parameters()))
    adam_step(critics.parameters(), critic_gradients, config.critic_learning_rate)
    assert metrics["critic_loss"].item() == pytest.approx(loss.item(), rel=1e-5)
    assert metrics["mean_q"].item() == pytest.approx(q.mean().item(), rel=1e-4)
    # The critics moved by their own loss alone: the actor's left them neither a gradient nor a step.
    for own, expected, gradient in zip(agent.critics.parameters(), critics.parameters(), critic_gradients):
        torch.testing.assert_close(own, expected, rtol=1e-5, atol=1e-6)
        torch.testing.assert_close(own.grad, gradient, rtol=1e-4, atol=1e-6)
        assert gradient.any() and own.requires_grad

    new_actions, log_probs = actor.sample(scaled)  # the actor learns from the critics that have just moved
    loss = (alpha * log_probs - critics(scaled, new_actions).min(0).values).mean()
    gradients = torch.autograd.grad(loss, list(actor.parameters()))
    adam_step(actor.parameters(), gradients, config.actor_learning_rate)
    assert metrics["actor_loss"].item() == pytest.approx(loss.item(), rel=1e-4)
    assert metrics["entropy"].item() == pytest.approx(-log_probs.mean().item(), rel=1e-4)
    for own, expected, gradient in zip(agent.actor.parameters(), actor.parameters(), gradients):
        torch.testing.assert_close(own, expected, rtol=1e-5, atol=1e-6)
        assert gradient.any()

    gradient = -(log_probs.mean() + agent.target_entropy).item()
    step = -config.alpha_learning_rate * gradient / (abs(gradient) + config.adam_epsilon)
    assert agent.log_alpha.item() == pytest.approx(-0.5 + step, abs=1e-6)
    assert metrics["alpha"].item() == pytest.approx(alpha) == math.exp(-0.5)
    assert metrics["alpha_loss"].item() == pytest.approx(-0.5 * gradient, rel=1e-4)

    for own, before, mine in zip(agent.policy.actor.parameters(), averaged, agent.actor.parameters()):
        torch.testing.assert_close(own, before + 0.3 * (mine - before), rtol=0, atol=1e-7)
        assert not torch.equal(own, before)
    if batch_norm:
        return
    moved = zip(agent.target_critics.parameters(), target_critics.parameters(), agent.critics.parameters())
    for own, before, critic in moved:
        torch.testing.assert_close(own, before + 0.2 * (critic - before), rtol=0, atol=1e-7)
        assert not torch.equal(own, before) and own.grad is None


def test_actor_and_alpha_are_updated_at_every_few_updates():
    agent = sac_agent(actor_update_interval=3, averaged_actor_tau=0.5)
    others = {"actor.net.0.weight", "log_alpha", "policy.actor.net.0.weight"}
    for step in range(7):
        before = {name: tensor.clone() for name, tensor in agent.state_dict().items()}
        metrics = agent.update(sac_batch(), step)
        moved = {name for name, tensor in agent.state_dict().items() if not torch.equal(tensor, before[name])}
        assert "critics.q1.1.weight" in moved and "critic_loss" in metrics
        due = step in (0, 3, 6)
        assert others & moved == (others if due else set())
        assert ("actor_loss" in metrics) == due


def test_only_the_critics_see_the_end_of_a_longer_observation():
    agent = sac_agent(observation_size=3, state_size=5)
    agent.update(sac_batch(state_size=5), 0)
    observations = torch.randn(4, 5)
    others = torch.cat((observations[:, :3], torch.randn(4, 2)), dim=1)
    torch.manual_seed(7)
    sampled, _ = agent.actor.sample(observations[:, :3])
    for seen in (observations, others):
        torch.manual_seed(7)
        assert torch.equal(torch.from_numpy(agent.act(seen.double().numpy())), sampled.detach())  # float64, as MuJoCo's
    assert (agent.critics(observations, torch.zeros(4, 2)) != agent.critics(others, torch.zeros(4, 2))).all()


@pytest.mark.parametrize("rewards, scale", [([-0.001, 0.005], 6 / 0.003), (1000 * [0.0], 6), (1000 * [-16.3], 6)])
def test_reward_scale(rewards, scale):
    """Rewards as the Minitaur's; those that are all equal stay as they are."""
    agent = sac_agent(reward_scale_factor=6.0)
    agent.fit_scaling(torch.zeros(len(rewards), 3), torch.tensor(rewards))
    assert agent.reward_scale.item() == pytest.approx(scale)


# Both


def test_replay_buffers_sample_all_that_is_stored_and_nothing_else():
    """Five transitions of which the numbers tell which they are; SAC's come two at once. Number 6 terminates."""
    torch.manual_seed(0)
    one = dqn_cartpole.ReplayBuffer(5, 2, CPU)
    two = sac_minitaur.ReplayBuffer(5, 2, 1, CPU)
    for first, count, stored in ((0, 4, {0, 1, 2, 3}), (4, 4, {3, 4, 5, 6, 7})):  # the second wraps around
        n = np.arange(first, first + count)
        observations = np.stack((n, n + 0.5), axis=1)  # float64, as MuJoCo's
        actions = n % 2
        for i in range(count):
            one.add(observations[i], actions[i], 10.0 * n[i], n[i] == 6, observations[i] + 0.25)
        for i in (slice(0, 2), slice(2, 4)):
            two.add(observations[i], actions[i, None], 10.0 * n[i], n[i] == 6, observations[i] + 0.25)
        for batch in (one.sample(5000, torch.Generator()), two.sample(5000)):
            observations_, actions, rewards, terminated, next_observations = batch
            n = rewards / 10
            assert set(n.tolist()) == stored and n.shape == terminated.shape == (5000,)
            assert n.long().bincount()[min(stored) :].min() > 0.85 * 5000 / len(stored)  # uniformly
            assert torch.equal(observations_, torch.stack((n, n + 0.5), 1))
            assert torch.equal(actions.flatten(), n.to(actions.dtype) % 2)
            assert torch.equal(terminated, (n == 6).float())
            assert torch.equal(next_observations, observations_ + 0.25)
    draws = [one.sample(9, torch.Generator().manual_seed(1))[2] for _ in range(2)]
    assert torch.equal(*draws)


@pytest.mark.parametrize("time_limit_terminates", (False, True))
@pytest.mark.parametrize("how", ("terminated", "truncated"))
def test_the_last_transition_of_an_episode(how, time_limit_terminates):
    """It has the episode's last observation, not the next one's first. A time limit may count as an end."""
    terminated, truncated = how == "terminated", how == "truncated"
    stored = []
    config = SimpleNamespace(time_limit_terminates=time_limit_terminates)
    run = SimpleNamespace(config=config, env_steps=5, world_size=1)
    run.log_episode = lambda episode_return, length: stored.append((episode_return, length))
    buffer = SimpleNamespace(add=lambda *transition: stored.append(transition))
    episode = {"episode": {"r": 7.0, "l": 3}}
    last_step = ("last", 1.0, terminated, truncated, episode)
    env = SimpleNamespace(step=lambda action: last_step, reset=lambda: ("first", {}))
    assert dqn_cartpole.collect_step(env, "here", 0, buffer, run) == "first"
    assert stored == [("here", 0, 1.0, terminated or time_limit_terminates, "last"), (7.0, 3)] and run.env_steps == 6

    stored.clear()
    first, last = np.float32([[0], [1]]), [None, np.float32([9])]
    flags = np.array([False, terminated]), np.array([False, truncated])
    infos = {"final_obs": last, "final_info": {"episode": {"r": np.array([0, 7.0]), "l": np.array([0, 3])}}}
    step = first, np.array([1.0, 2.0]), *flags, infos
    assert sac_minitaur.store(buffer, "here", "action", step, run) is first
    assert stored[0] == (7.0, 3) and stored[1][:2] == ("here", "action") and run.env_steps == 8
    assert stored[1][3].tolist() == [False, terminated or time_limit_terminates]
    assert stored[1][4].tolist() == [[0], [9]] and first.tolist() == [[0], [1]]


@pytest.mark.parametrize("tutorial", (False, True))
def test_an_update_reads_and_creates_nothing_on_another_device(monkeypatch, tutorial):
    """On the meta device, whose tensors have no numbers: one of the CPU in between them is an error, as on a GPU."""
    adam = torch.optim.Adam
    monkeypatch.setattr(torch.optim, "Adam", lambda *args, **kwargs: adam(*args, **kwargs | {"fused": False}))
    meta = torch.device("meta")
    agent = sac_agent(device=meta, state_size=5, **(sac_minitaur.TUTORIAL if tutorial else {}))
    batch = tuple(tensor.to(meta) for tensor in sac_batch(state_size=5))
    assert {value.device for value in agent.update(batch, 0).values()} == {meta}
    agent = dqn_agent(**(dqn_cartpole.TUTORIAL if tutorial else {})).to(meta)
    batch = tuple(tensor.to(meta) for tensor in dqn_batch())
    assert {value.device for value in agent.update(batch, 0).values()} == {meta}


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA GPU")
@pytest.mark.parametrize("tutorial", (False, True))
def test_an_update_on_the_gpu_is_that_of_the_cpu(monkeypatch, tutorial):
    generator = torch.Generator().manual_seed(3)
    noise = [torch.randn(32, 2, generator=generator) for _ in range(2)]
    choices = (sac_minitaur.TUTORIAL if tutorial else {}) | {"adam_epsilon": 1e-2}
    agents = [sac_agent(device=torch.device(device), state_size=5, **choices) for device in ("cpu", "cuda")]
    agents[1].load_state_dict(agents[0].state_dict())  # each device has a generator of its own
    results = []
    for agent in agents:
        draws = iter(noise)
        monkeypatch.setattr(torch, "randn_like", lambda mean, draws=draws: next(draws).to(mean.device))
        metrics = agent.update(tuple(tensor.to(agent.device) for tensor in sac_batch(state_size=5)), 0)
        results.append({name: value.cpu() for name, value in (metrics | agent.state_dict()).items()})
    torch.testing.assert_close(results[1], results[0], rtol=1e-3, atol=1e-5)
