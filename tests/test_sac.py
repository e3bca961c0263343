"""Soft Actor-Critic piece by piece against numbers worked out by hand, then `train` and the command line as a whole."""

import copy
import importlib.util
import json
import math
import re
import shutil
import sys

import gymnasium as gym
import imageio
import numpy as np
import pytest
import torch
from pydantic import ValidationError
from torch import nn
from torch.distributions import Independent, Normal, TanhTransform, TransformedDistribution

import common
import sac_minitaur
from runs import ROOT, checkpoint, load_policy, read_command_line, read_csv
from sac_minitaur import Actor, Config, Policy, ReplayBuffer, SACAgent

# The tutorials' values, here written down a second time.
TUTORIALS = dict(
    actor_learning_rate=3e-4, critic_learning_rate=3e-4, alpha_learning_rate=3e-4,
    adam_beta1=0.9, privileged_critics=False, critic_batch_norm=False, reward_scaling=False,
    reward_scale_factor=1, averaged_actor_tau=1, target_entropy_per_action=-0.5,
    replay_buffer_capacity=10_000,
)  # fmt: skip


def make_agent(observation_size=3, action_size=2, device="cpu", state_size=None, **choices):
    torch.manual_seed(0)
    config = Config(**{"actor_layers": (16, 16), "critic_layers": (16, 12)} | choices)
    observation_space = gym.spaces.Box(-np.inf, np.inf, (observation_size,))
    action_space = gym.spaces.Box(-1, 1, (action_size,))
    state_size = state_size or observation_size
    return SACAgent(config, observation_space, action_space, state_size, torch.device(device), common.Ranks())


def make_batch(size=32, observation_size=3, action_size=2):
    """As `ReplayBuffer.sample` returns it."""
    generator = torch.Generator().manual_seed(1)
    observations, next_observations = torch.randn(2, size, observation_size, generator=generator)
    actions = 2 * torch.rand(size, action_size, generator=generator) - 1
    rewards = torch.randn(size, generator=generator)
    terminated = (torch.rand(size, generator=generator) < 0.3).float()
    return observations, actions, rewards, terminated, next_observations


def test_td_targets():
    targets = sac_minitaur.td_targets(
        rewards=torch.tensor([1.0, 1.0, -2.0]),
        terminated=torch.tensor([0.0, 1.0, 0.0]),
        next_q=torch.tensor([[4.0, 4.0, 7.0], [3.0, 3.0, 9.0]]),
        next_log_probs=torch.tensor([-2.0, -2.0, 4.0]),
        alpha=torch.tensor(0.5),
        gamma=0.9,
    )
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


def test_actor_log_probabilities_are_those_of_torch_distributions():
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
def test_actor_log_probabilities_where_tanh_saturates(mean):
    actor = Actor(3, 2, ())
    with torch.no_grad():
        actor.net[0].weight.zero_()
        actor.net[0].bias.copy_(torch.tensor([mean, mean, -100.0, 100.0]))
    torch.manual_seed(0)
    actions, log_probs = actor.sample(torch.zeros(5, 3))
    assert (actions[:, 0] == math.copysign(1, mean)).all()  # the very ends, where atanh is infinite
    torch.manual_seed(0)
    noise = torch.randn(5, 2).double()
    log_std = torch.tensor([-20.0, 2.0], dtype=torch.float64)  # the bounds that ±100 are clamped to
    u = mean + log_std.exp() * noise
    log_normal = -(noise**2) / 2 - log_std - math.log(2 * math.pi) / 2
    log_determinant = math.log(4) - 2 * u.abs() - 2 * torch.log1p((-2 * u.abs()).exp())  # log(1 − tanh²u)
    torch.testing.assert_close(log_probs.double(), (log_normal - log_determinant).sum(1), rtol=1e-5, atol=1e-4)
    (log_probs.sum() + actions.sum()).backward()
    assert actor.net[0].bias.grad.isfinite().all()


def test_networks_start_glorot_uniform():
    net = sac_minitaur.mlp(28, (256, 256), 8)
    linears = [layer for layer in net if isinstance(layer, nn.Linear)]
    assert [tuple(layer.weight.shape) for layer in linears] == [(256, 28), (256, 256), (8, 256)]
    for layer in linears:
        bound = math.sqrt(6 / sum(layer.weight.shape))
        assert 0.95 * bound < layer.weight.abs().max() <= bound and (layer.bias == 0).all()
        assert layer.weight.std().item() == pytest.approx(bound / math.sqrt(3), rel=0.1)


def test_twin_critics_normalize_the_inputs_of_their_layers_and_are_independent():
    critics = make_agent().critics
    norms = [module for module in critics.modules() if isinstance(module, nn.BatchNorm1d)]
    assert [norm.num_features for norm in norms] == 2 * [3 + 2, 16, 12]
    assert {(norm.momentum, norm.eps) for norm in norms} == {(0.01, 1e-3)}  # CrossQ's
    observations, actions, *_ = make_batch()
    q = critics(observations, actions)
    assert q.shape == (2, 32) and not torch.allclose(q[0], q[1])
    q[0].sum().backward()
    assert all(parameter.grad.any() for parameter in critics.q1.parameters())
    assert not any(parameter.grad.any() for parameter in critics.q2.parameters())


def test_policy_acts_with_the_mean_in_the_tasks_units():
    action_space = gym.spaces.Box(np.float32([[0, -3], [-1, 5]]), np.float32([[10, 1], [1, 6]]))
    policy = Policy(Config(actor_layers=(16,)), gym.spaces.Box(-1, 1, (2, 3)), action_space)
    actor, observations = policy.actor, torch.randn(5, 2, 3)
    actions = policy(observations)
    mean, _ = actor(observations.flatten(1))
    squashed = mean.tanh().view(5, 2, 2)
    expected = torch.tensor([[5.0, -1.0], [0.0, 5.5]]) + torch.tensor([[5.0, 2.0], [1.0, 0.5]]) * squashed
    torch.testing.assert_close(actions, expected)
    np.testing.assert_allclose(policy.act(observations[0].numpy()), expected[0].detach(), rtol=1e-5, atol=1e-6)
    with torch.no_grad():
        actor.net[-1].bias[:4] = 100
    assert torch.equal(policy(observations)[0].detach(), torch.as_tensor(action_space.high))


@pytest.mark.parametrize("batch_norm", (True, False))
def test_update_is_one_step_of_each_gradient(batch_norm):
    """Against separate gradients and Adam's first step by hand: −lr · g / (|g| + ε). No value is the default's."""
    choices = dict(
        adam_epsilon=1e-2, critic_learning_rate=2e-3, actor_learning_rate=3e-3, alpha_learning_rate=4e-3, gamma=0.9,
        critic_loss_weight=0.7, initial_log_alpha=-0.5, averaged_actor_tau=0.3, target_update_tau=0.2, adam_beta1=0.7,
    )  # fmt: skip
    agent = make_agent(**choices, critic_batch_norm=batch_norm)
    assert {optimizer.defaults["betas"] for optimizer in agent.optimizers} == {(0.7, 0.999)}
    agent.critics.eval()  # as the update before has left them
    config, batch = agent.config, make_batch()
    agent.fit_reward_scale(3 * batch[2])
    observations, actions, rewards, terminated, next_observations = batch
    rewards = agent.reward_scale * rewards
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
    metrics = agent.update(batch)

    torch.manual_seed(5)
    with torch.no_grad():
        next_actions, next_log_probs = actor.sample(next_observations)
    if batch_norm:
        q = critics(torch.cat((observations, next_observations)), torch.cat((actions, next_actions)))
        q, next_q = q[:, :32], q[:, 32:].detach()
        critics.eval()
    else:
        q, next_q = critics(observations, actions), target_critics(next_observations, next_actions).detach()
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
        assert gradient.any()

    new_actions, log_probs = actor.sample(observations)  # the actor learns from the critics that have just moved
    loss = (alpha * log_probs - critics(observations, new_actions).min(0).values).mean()
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


def test_a_forks_normalized_actor_is_evaluated_with_its_statistics():
    module = nn.Sequential(nn.BatchNorm1d(3), nn.Linear(3, 2))
    average = copy.deepcopy(module)
    module(torch.rand(8, 3))
    sac_minitaur.soft_update(average, module, 0.5)
    assert module[0].running_mean.all() and torch.equal(average[0].running_mean, module[0].running_mean)


def test_only_the_critics_see_the_end_of_a_longer_observation():
    agent = make_agent(observation_size=3, state_size=5)
    agent.update(make_batch(observation_size=5))
    observations = torch.randn(4, 5)
    others = torch.cat((observations[:, :3], torch.randn(4, 2)), dim=1)
    torch.manual_seed(7)
    sampled, _ = agent.actor.sample(observations[:, :3])
    for seen in (observations, others):
        torch.manual_seed(7)
        assert torch.equal(torch.from_numpy(agent.act(seen.numpy())), sampled.detach())
    assert (agent.critics(observations, torch.zeros(4, 2)) != agent.critics(others, torch.zeros(4, 2))).all()


@pytest.mark.parametrize(
    "rewards, scale",
    [([-0.001, 0.005], 6 / 0.003), (1000 * [0.0], 6), (1000 * [0.1], 6), (1000 * [1.0], 6), (1000 * [-16.3], 6)],
)
def test_fit_reward_scale(rewards, scale):
    """Rewards as the Minitaur's; those that are all equal stay as they are."""
    agent = make_agent(reward_scale_factor=6.0)
    agent.fit_reward_scale(torch.tensor(rewards))
    assert agent.reward_scale.item() == pytest.approx(scale)


def test_the_tutorials_values_are_the_defaults():
    config = Config()
    assert config.env_id == "MinitaurBulletEnv-v0" and config.num_iterations == 100_000
    assert config.initial_collect_steps == 10_000 and config.collect_steps_per_iteration == 1
    assert config.batch_size == 256 and config.gamma == 0.99 and config.target_update_tau == 0.005
    assert config.actor_layers == config.critic_layers == (256, 256)
    assert (config.log_interval, config.eval_interval, config.num_eval_episodes) == (5_000, 10_000, 20)
    assert config.checkpoint_interval == 5_000 and config.critic_loss_weight == 0.5
    assert config.adam_epsilon == 1e-7 and config.initial_log_alpha == 0


def test_tutorial_sets_every_value_that_is_ours_to_theirs():
    lines = (ROOT / "sac_minitaur.py").read_text().splitlines()
    ours = {line.split(":")[0].strip() for line in lines if re.search(r"^    \w+: .* # ours\b", line)}
    assert TUTORIALS.keys() == sac_minitaur.TUTORIAL.keys() == ours and len(ours) == 11
    assert vars(Config(tutorial=True)) == vars(Config(**TUTORIALS)) | {"tutorial": True}
    given = {"adam_beta1": 0.7, "reward_scaling": True}  # counts beside it
    config = Config("Pendulum-v1", **given, tutorial=True)
    assert vars(config) == vars(Config(env_id="Pendulum-v1", **TUTORIALS | given)) | {"tutorial": True}
    assert all(getattr(Config(), name) != value for name, value in TUTORIALS.items())
    with pytest.raises(ValueError, match="tutorial"):
        Config(tutorial="no")  # not True, but not False either


def test_the_tutorials_agent():
    agent = make_agent(**TUTORIALS)
    agent.fit_reward_scale(7 * torch.randn(50))
    assert agent.reward_scale == 1 and agent.log_alpha.exp() == 1 and agent.target_entropy == -2 / 2
    assert not any(isinstance(module, nn.BatchNorm1d) for module in agent.critics.modules())
    assert agent.target_critics and not make_agent().target_critics


@pytest.mark.parametrize("choices", [{}, TUTORIALS])
def test_an_update_reads_and_creates_nothing_on_another_device(monkeypatch, choices):
    """On the meta device, whose tensors have no numbers: one of the CPU in between them is an error, as on a GPU."""
    adam = torch.optim.Adam
    monkeypatch.setattr(torch.optim, "Adam", lambda *args, **kwargs: adam(*args, **kwargs | {"fused": False}))
    agent = make_agent(device="meta", state_size=5, **choices)
    buffer = ReplayBuffer(40, 5, 2, agent.device)
    buffer.size = 40
    agent.fit_reward_scale(buffer.rewards())
    metrics = agent.update(buffer.sample(32))
    assert {value.device for value in metrics.values()} == {agent.device}


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA GPU")
@pytest.mark.parametrize("choices", [{}, TUTORIALS])
def test_an_update_on_the_gpu_is_that_of_the_cpu(monkeypatch, choices):
    generator = torch.Generator().manual_seed(3)
    noise = [torch.randn(32, 2, generator=generator) for _ in range(2)]
    agents = [make_agent(device=device, state_size=5, **choices | {"adam_epsilon": 1e-2}) for device in ("cpu", "cuda")]
    agents[1].load_state_dict(agents[0].state_dict())  # each device has a generator of its own
    results = []
    for agent in agents:
        draws = iter(noise)
        monkeypatch.setattr(torch, "randn_like", lambda mean: next(draws).to(mean.device))
        batch = tuple(tensor.to(agent.device) for tensor in make_batch(observation_size=5))
        agent.fit_reward_scale(batch[2])
        metrics = agent.update(batch)
        results.append({name: value.cpu() for name, value in (metrics | agent.state_dict()).items()})
    torch.testing.assert_close(results[1], results[0], rtol=1e-3, atol=1e-5)


class StepCounter(gym.Env):
    """Its observation says which episode and step it is. At step 4 it terminates, or leaves that to a time limit."""

    observation_space, action_space = gym.spaces.Box(-np.inf, np.inf, (2,)), gym.spaces.Box(-1, 1, (1,))

    def __init__(self, terminates=False):
        self.terminates, self.episode = terminates, 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.episode, self.step_number = self.episode + 1, 0
        return np.float32([self.episode, 0]), {}

    def step(self, action):
        self.step_number += 1
        observation = np.float32([self.episode, self.step_number])
        return observation, float(self.step_number), self.terminates and self.step_number == 4, False, {}


class Telling(StepCounter):
    """Tells the critics 100 more than the number of the step."""

    privileged_space = gym.spaces.Box(-np.inf, np.inf, (1,))

    def privileged_observation(self):
        return np.float32([100 + self.step_number])


# Named with the module, so that worker processes that are not forked find them too.
gym.register("Telling-v0", entry_point=Telling, max_episode_steps=4)
gym.register("Terminated-v0", entry_point=StepCounter, kwargs={"terminates": True})

TINY = dict(
    env_id="Pendulum-v1", device="cpu", num_iterations=60, initial_collect_steps=250, batch_size=32,
    replay_buffer_capacity=1000, actor_layers=(16, 16), critic_layers=(16, 16), log_interval=20, eval_interval=30,
    checkpoint_interval=25, num_eval_episodes=2, video=False,
)  # fmt: skip


def train(path, **choices):
    """A tiny run. Returns its directory and the agent's calls, in order: fit_reward_scale with its data, and update."""
    calls = []

    def recorded(name):
        method = getattr(SACAgent, name)

        def call(self, *arguments):
            assert torch.get_num_threads() == self.config.num_threads
            calls.append((name, arguments))
            return method(self, *arguments)

        return call

    with pytest.MonkeyPatch.context() as patch:
        for name in ("update", "fit_reward_scale"):
            patch.setattr(SACAgent, name, recorded(name))
        torch.set_num_threads(2)
        returned = sac_minitaur.train(Config(**TINY | {"run_dir": str(path)} | choices))
    assert returned == path and torch.get_num_threads() == 2
    return path, calls


def test_train_does_what_the_config_says_and_writes_its_rows(tmp_path, monkeypatch):
    sizes, sample = [], ReplayBuffer.sample
    actions, act = [], SACAgent.act

    def recorded(self, observations):
        actions.append(act(self, observations))
        return actions[-1]

    monkeypatch.setattr(ReplayBuffer, "sample", lambda self, count: sizes.append(self.size) or sample(self, count))
    monkeypatch.setattr(SACAgent, "act", recorded)
    path, calls = train(tmp_path / "run")
    assert sizes == list(range(250, 310))  # the step that each update needs runs during the update
    assert [name for name, _ in calls] == ["fit_reward_scale"] + 60 * ["update"]
    (rewards,) = calls[0][1]
    assert rewards.shape == (250,)
    assert all(batch[0].shape == (32, 3) for _, (batch,) in calls[1:])
    state = checkpoint(path)
    rows = state["ranks"][0]["buffer"]["rows"]
    assert state["step"] == 60 and state["env_steps"] == len(rows) == 250 + 60
    assert np.array_equal(rows[250:, 3:4], np.concatenate(actions))  # random ones first, then the agent's
    assert json.loads((path / "config.json").read_text())["num_iterations"] == 60
    evaluation = {"step", "env_steps", "seconds", "average_return", "std_return", "average_episode_length"}
    rows = read_csv(path / "random.csv")
    assert [(row["step"], row["env_steps"]) for row in rows] == [(0, 0)] and evaluation <= set(rows[0])
    rows = read_csv(path / "eval.csv")
    assert [(row["step"], row["env_steps"]) for row in rows] == [(0, 250), (30, 280), (60, 310)]
    assert evaluation <= set(rows[0]) and all(row["average_episode_length"] == 200 for row in rows)
    assert all(-2000 < row["min_return"] <= row["average_return"] <= row["max_return"] < 0 for row in rows)
    rows = read_csv(path / "train.csv")
    assert [(row["step"], row["env_steps"]) for row in rows] == [(20, 270), (40, 290), (60, 310)]
    metrics = {"critic_loss", "actor_loss", "alpha_loss", "alpha", "entropy", "mean_q"}
    assert metrics | {"seconds", "steps_per_second", "collect_return", "collect_episode_length"} <= set(rows[0])
    assert all(math.isfinite(value) for row in rows for value in row.values())
    assert rows[-1]["collect_episode_length"] == 200  # the one episode that ended is the random one


def test_several_environments_keep_the_ratio_of_collecting_to_updating(tmp_path):
    path, calls = train(tmp_path / "run", num_envs=3)
    # 250 is no multiple of 3. The scale is fitted before the first update all the same, on all there is.
    assert [name for name, _ in calls] == ["fit_reward_scale"] + 60 * ["update"] and len(calls[0][1][0]) == 252
    assert all(row["env_steps"] - 250 - row["step"] in range(6) for row in read_csv(path / "train.csv"))
    state = checkpoint(path)
    rows = state["ranks"][0]["buffer"]["rows"]
    assert state["env_steps"] == len(rows) == 312
    assert len(rows[:3, :3].unique(dim=0)) == 3  # each environment has episodes of its own


@pytest.mark.parametrize("env_id, num_envs", [("Telling-v0", 2), ("Terminated-v0", 1)])
def test_train_stores_the_true_last_observation(tmp_path, env_id, num_envs):
    """And nothing that an environment would tell the critics besides, without --privileged-critics."""
    choices = {"num_envs": num_envs, "initial_collect_steps": 40, "privileged_critics": False}
    path, _ = train(tmp_path / "run", env_id=f"{__name__}:{env_id}", **choices)
    rows = checkpoint(path)["ranks"][0]["buffer"]["rows"]
    observations, actions, rewards, terminated, next_observations = rows.split((2, 1, 1, 1, 2), dim=1)
    # Within an episode to its very end, never the first observation of the next.
    assert torch.equal(next_observations, observations + torch.tensor([0.0, 1.0]))
    assert observations[:, 1].unique().tolist() == [0, 1, 2, 3]
    assert torch.equal(rewards, next_observations[:, 1:])  # unscaled, as the environment gave them
    ended = next_observations[:, 1:] == 4
    assert torch.equal(terminated, (ended & (env_id == "Terminated-v0")).float())
    assert actions.abs().max() <= 1 and len(actions[:40].unique()) == 40
    # Every environment's episodes follow each other.
    for i in range(num_envs):
        count = torch.arange(len(rows[i::num_envs]))
        assert torch.equal(observations[i::num_envs], torch.stack((1 + count // 4, count % 4), 1).float())
    # Of the 24 or 25 that have ended the last ten are reported: returns of 1 + 2 + 3 + 4, lengths of 4.
    assert checkpoint(path)["ranks"][0]["environments"]["finished"] == 10 * [(10.0, 4)]
    row = read_csv(path / "train.csv")[-1]
    assert (row["collect_return"], row["collect_episode_length"]) == (10, 4)
    evaluations = read_csv(path / "eval.csv")
    assert {(row["average_return"], row["average_episode_length"]) for row in evaluations} == {(10, 4)}


def test_critics_alone_learn_from_what_the_environment_tells_besides(tmp_path):
    path, _ = train(tmp_path / "run", env_id=f"{__name__}:Telling-v0", initial_collect_steps=40)
    state = checkpoint(path)
    observations, _, rewards, _, next_observations = state["ranks"][0]["buffer"]["rows"].split((3, 1, 1, 1, 3), dim=1)
    assert torch.equal(next_observations[:, 1:2], rewards)
    # Of the step that each observation is of, to the very end of an episode.
    assert torch.equal(observations[:, 2], 100 + observations[:, 1])
    assert torch.equal(next_observations[:, 2], 100 + next_observations[:, 1])
    assert state["agent"]["critics.q1.1.weight"].shape == (16, 3 + 1)
    assert state["agent"]["actor.net.0.weight"].shape == (16, 2)
    observations = torch.rand(5, 2)
    exported = torch.export.load(path / "policy.pt2").module()(observations)
    assert exported.shape == (5, 1) and torch.equal(load_policy(path / "policy.pt")(observations), exported)


def main(monkeypatch, *arguments):
    """The command line within this process. Returns the exit status."""
    monkeypatch.setattr(sys, "argv", ["sac_minitaur.py", *map(str, arguments)])
    try:
        common.run_main(sac_minitaur.main)
    except SystemExit as exit_:
        return exit_.code
    return 0


def test_the_policy_that_readme_films(monkeypatch, capsys, tmp_path):
    pytest.importorskip("pybullet")
    path = shutil.copy(ROOT / "results" / "minitaur_policy.pt", tmp_path)
    monkeypatch.delenv("DISPLAY", raising=False)
    torch.set_num_threads(2)
    assert main(monkeypatch, "--evaluate", path, "--num-eval-episodes", 1, "--max-episode-steps", 50) == 0
    shown = re.search(r"AverageReturn = (\S+) .* = 50\.0", capsys.readouterr().out)
    assert float(shown[1]) > 0.5  # standing still has 0
    assert torch.get_num_threads() == 1  # as in a run's evaluations: another number may round differently
    with imageio.get_reader(tmp_path / "minitaur_policy.mp4") as video:
        frames = [np.asarray(frame) for frame in video]
    assert len(frames) == 26 and frames[0].shape == (360, 480, 3)
    assert np.abs(np.subtract(*np.float32([frames[0], frames[-1]]))).max() > 100  # the robot is seen, and moves


def test_evaluation_episodes_are_none_of_trainings():
    evaluation = set(common.evaluation_seeds(Config(num_eval_episodes=100)))
    training = {common.derive_seed(0, env, episode) for env in range(100) for episode in range(100)}
    assert len(evaluation) == 100 and len(training) == 10_000 and not evaluation & training


def test_learns_pendulum(tmp_path):
    choices = dict(
        num_iterations=5000, initial_collect_steps=1000, batch_size=128, replay_buffer_capacity=10_000,
        actor_layers=(64, 64), critic_layers=(64, 64), log_interval=1000, eval_interval=5000,
        checkpoint_interval=5000, num_eval_episodes=10,
    )  # fmt: skip
    path, _ = train(tmp_path / "run", **choices)
    random_return = read_csv(path / "random.csv")[0]["average_return"]
    rows = read_csv(path / "eval.csv")
    assert [row["step"] for row in rows] == [0, 5000]
    assert random_return < -700 and rows[0]["average_return"] < -700
    assert rows[1]["average_return"] > -300  # a pendulum kept upright from the first swing on has about −150


OUT_OF_RANGE = """
    --batch-size 0, --num-iterations -5, --initial-collect-steps 0, --collect-steps-per-iteration 0, --num-envs 0,
    --num-envs 1025, --replay-buffer-capacity -1, --max-episode-steps 0, --num-threads 0, --num-threads 1000000000,
    --log-interval 0, --eval-interval -1, --num-eval-episodes 0, --checkpoint-interval 0, --critic-layers 0,
    --actor-layers 1000000000, --device tpu, --device cuda:128, --actor-learning-rate -1,
    --critic-learning-rate nan, --adam-epsilon -1, --adam-beta1 1, --gamma 1.01, --target-update-tau -0.1,
    --averaged-actor-tau 7, --reward-scale-factor inf, --initial-log-alpha nan, --seed -1,
    --seed 9223372036854775808, --batch-size x, --wings 2""".split(",")


@pytest.mark.parametrize("arguments", OUT_OF_RANGE)
def test_values_out_of_range_are_refused_by_name(arguments, monkeypatch, capfd):
    flag, value = arguments.split()
    status = main(monkeypatch, flag, value)
    output = capfd.readouterr()
    assert status == 2 and output.out == "" and "Traceback" not in output.err
    assert flag in output.err or flag[2:].replace("-", "_") in output.err
    assert len(output.err.splitlines()) < 20
    if flag not in ("--wings", "--batch-size"):
        with pytest.raises(ValidationError, match=flag[2:].replace("-", "_")):
            Config(**{flag[2:].replace("-", "_"): [int(value)] if "layers" in flag else value})


@pytest.mark.parametrize(
    "arguments, named",
    [
        ("--env-id NoSuchTask-v0", "NoSuchTask"),
        ("--env-id no_such_module:Task-v0", "no_such_module"),
        ("--env-id a:b:c", "a:b:c"),
        ("--env-id .x:y-v0", ".x:y-v0"),
        ("--env-id :y-v0", ":y-v0"),
        ("--env-id CartPole-v1", "Discrete"),
        ("--device cuda:77", "cuda:77"),
        ("--device mps", "--device mps is not there"),
        ("--device cpu --cuda-graph", "with a CUDA GPU: use --no-cuda-graph"),
        ("--batch-size 300", "--batch-size 300"),
        ("--replay-buffer-capacity 9000000000000000", "--replay-buffer-capacity 9000000000000000 takes 324000000.0 GB"),
        ("--replay-buffer-capacity 20", "--batch-size 32 is more than the 20"),
        ("--resume nowhere", "nowhere/checkpoint.pt does not exist"),
        ("--resume=", "checkpoint.pt"),  # as of a shell's variable that is not set
        ("--evaluate nowhere.pt", "nowhere.pt does not exist"),
        ("--evaluate full/file", "full/file"),
        ("--evaluate=", "policy"),
        ("--run-dir full", "not empty"),
        ("--run-dir full/file", "full/file"),
        ("--run-dir caf\udce9", "cannot be used"),  # bytes that are no UTF-8
    ],
)
def test_bad_input_is_one_line_and_status_2(arguments, named, monkeypatch, capfd, tmp_path):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "file").write_text("somebody's work")
    flags = "--env-id Pendulum-v1 --device cpu --initial-collect-steps 250 --batch-size 32 --num-iterations 1"
    assert main(monkeypatch, *flags.split(), "--run-dir", "run", *arguments.split()) == 2
    output = capfd.readouterr()
    assert output.err.startswith("error: ") and output.err.count("\n") == 1
    assert named in output.err and output.out == ""
    assert (tmp_path / "full" / "file").read_text() == "somebody's work"
    assert not list(tmp_path.glob("run*"))  # the corrected command may name the same directory


@pytest.mark.parametrize(
    "kind, space",
    [
        ("action", gym.spaces.Box(0, 200, (2,), np.uint8)),
        ("action", gym.spaces.Box(-1, np.inf, (2,))),
        ("action", gym.spaces.Box(-1, 1, (2, 0))),
        ("action", gym.spaces.Box(np.float32([0, -1]), np.float32([0, 1]))),
        ("action", gym.spaces.Box(np.float32(-3e38), np.float32(3e38), (2,))),  # its range is not finite in float32
        ("action", gym.spaces.Box(-1e39, 1e39, (2,), np.float64)),
        ("action", gym.spaces.Box(1.0, 1.0 + 1e-12, (2,), np.float64)),  # and here it is none
        ("action", gym.spaces.Box(-1, 1, ())),
        ("action", gym.spaces.Box(-1, 1, (2,), np.longdouble)),
        ("observation", gym.spaces.Box(-1, 1, ())),
        ("observation", gym.spaces.Discrete(3)),
        ("observation", gym.spaces.MultiBinary(3)),
    ],
)
def test_spaces_that_sac_cannot_use(kind, space, monkeypatch):
    env = StepCounter()
    setattr(env, f"{kind}_space", space)
    monkeypatch.setitem(gym.registry, "Task-v0", gym.envs.registration.EnvSpec("Task-v0", entry_point=lambda: env))
    with pytest.raises(common.InputError, match=f"Task-v0 has the {kind} space"):
        common.find_task(Config(env_id="Task-v0"), gym.spaces.Box)


def test_readmes_tables_of_our_choices_are_the_reports(monkeypatch, capsys):
    spec = importlib.util.spec_from_file_location("report", ROOT / "results" / "report.py")
    spec.loader.exec_module(report := importlib.util.module_from_spec(spec))
    monkeypatch.setattr(report, "FIGURES", {})  # draws nothing
    report.main()
    printed, readme = (
        [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines() if line.startswith("|")]
        for text in (capsys.readouterr().out, (ROOT / "README.md").read_text().replace("−", "-"))
    )
    sac, earlier = ({row[0]: row[1:] for row in printed if len(row) == columns} for columns in (3, 5))
    sac = {(*returns, earlier[without][-1]) for without, returns in sac.items()}
    dqn = {(early, stay) for _, _, early, _, stay, _ in (row for row in printed if len(row) == 6)}
    rows = [tuple(row[4:]) for row in readme if re.fullmatch(r"-?\d+\.\d( -?\d+\.\d){2}|\d+ \d+", " ".join(row[4:]))]
    assert len(rows) == 9 + 8 and set(rows) <= sac | dqn


def test_commands_of_readme_and_docstrings_are_taken():
    text = "\n".join((ROOT / name).read_text() for name in ("README.md", "sac_minitaur.py", "dqn_cartpole.py"))
    commands = re.findall(r"(?:python|nproc-per-node \w+) (\w+)\.py((?: +-{1,2}[^`#\n]*)?)", text)
    assert len(commands) > 20
    for script, arguments in commands:
        arguments = re.sub(r"--(resume|evaluate) runs/\S+|--seed S|--help", "", arguments)
        read_command_line(script, *arguments.split())
