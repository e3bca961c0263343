"""DQN: its formulas by hand, its parts by what they promise, and that it learns."""

import copy
import dataclasses
import math
import re
import subprocess
import sys
from concurrent import futures

import gymnasium as gym
import numpy as np
import pytest
import torch
from pydantic import ValidationError

import common
import dqn_cartpole
from dqn_cartpole import Config, DQNAgent, QNetwork, ReplayBuffer
from runs import ROOT, assert_same, checkpoint, load_policy, read_command_line, read_csv

TINY = Config(
    num_iterations=60, initial_collect_steps=50, batch_size=16, replay_buffer_capacity=200, layers=(8, 6),
    log_interval=10, eval_interval=20, num_eval_episodes=2, checkpoint_interval=25, device="cpu", video=False,
)  # fmt: skip


def make_agent(device="cpu", **changes):
    _, *spaces = common.find_task(TINY, gym.spaces.Discrete)
    return DQNAgent(dataclasses.replace(TINY, **changes), *spaces, torch.device(device), common.Ranks())


def random_batch(size=16):
    s, next_s = torch.randn(2, size, 4)
    return s, torch.randint(2, (size,)), torch.ones(size), torch.randint(2, (size,)).float(), next_s


def test_targets_by_hand():
    """Only `terminated` cuts the bootstrap."""
    rewards, next_q = torch.tensor([1.0, 1.0, 2.0]), torch.tensor([[10.0, 20.0], [10.0, 20.0], [-4.0, 8.0]])
    targets = dqn_cartpole.td_targets(rewards, torch.tensor([0.0, 1.0, 0.0]), next_q, gamma=0.5)
    assert targets.tolist() == [1 + 0.5 * 20, 1.0, 2 + 0.5 * 8]


def test_gap_to_best():
    gap = dqn_cartpole.gap_to_best(torch.tensor([[3.0, 1.0, 2.0], [3.0, 1.0, 2.0]]), torch.tensor([0, 1]))
    assert gap.tolist() == [0.0, 2.0]


def test_scaling_maps_bounds_to_one():
    """From [2, 6] and [-4, 4]; without bounds or width, or with those that float32 cannot subtract: as they are."""
    huge = np.finfo(np.float32).max
    low, high = np.float32([[2, -4], [-np.inf, 0], [-huge, 5]]), np.float32([[6, 4], [np.inf, np.inf], [huge, 5]])
    scaling = dqn_cartpole.ObservationScaling(gym.spaces.Box(low, high))
    observations = torch.tensor([[2.0, -4, 3, 3, 3, 5], [6, 4, -7, -7, -7, 5], [4, 1, 0, 0, 0, 5]])
    scaled = [[-1.0, -1, 3, 3, 3, 5], [1, 1, -7, -7, -7, 5], [0, 0.25, 0, 0, 0, 5]]
    assert scaling(observations).tolist() == scaled
    # Bounds that nobody reaches are none, on one side too, wherever the data lie. Those within ten times of these are.
    low, high = np.float32([-35, -2, 0, -3, -1e6, -1000, -1e6]), np.float32([35, 2, 1e4, 3, 1e6, 2000, 1e6])
    scaling = dqn_cartpole.ObservationScaling(gym.spaces.Box(low, high))
    data = torch.tensor([[0.2, 0.25, 5, 0.25, 0, 1000.5, 300], [-0.3, -0.25, 0, -0.25, 0, 999.5, -300]])
    scaling.fit(data, common.Ranks())
    scaled = scaling(torch.tensor([2.0, 1, 5, 2, 3, 1002, 600])).tolist()
    assert scaled == pytest.approx([2.05, 0.5, 1, 2, 3, 2, 2])
    scaling = dqn_cartpole.ObservationScaling(gym.spaces.Box(np.float32([-30, 0]), np.float32([30, 255])))
    scaling.fit(data[:, [1, 4]], common.Ranks())  # within 130 times, or a black pixel
    assert scaling(torch.tensor([15.0, 255])).tolist() == [0.5, 1]
    for dtype in (np.uint8, np.longdouble, ">f4"):
        assert dqn_cartpole.ObservationScaling(gym.spaces.Box(0, 1, (2,), dtype)).center.tolist() == [0.5, 0.5]
    unscaled = make_agent(observation_scaling=False)
    assert torch.equal(unscaled.scaling(observations), observations)


def test_initialization():
    torch.manual_seed(0)
    first, _, second, _, last = QNetwork(400, 2, (500, 300)).net
    for layer in (first, second):
        std = math.sqrt(2 / layer.in_features)
        assert layer.weight.std().item() == pytest.approx(std, rel=0.01)
        # Truncated at two standard deviations of the normal that is cut, and close to it somewhere.
        assert 1.99 * std / 0.8796 < layer.weight.abs().max().item() <= 2 * std / 0.8796
        assert (layer.bias == 0).all()
    assert 0.029 < last.weight.abs().max().item() <= 0.03
    assert last.weight.std().item() == pytest.approx(0.03 / math.sqrt(3), rel=0.1)
    assert (last.bias == -0.2).all()


def test_the_tutorials_values_are_the_defaults():
    config = Config()
    assert config.env_id == "CartPole-v0" and config.num_iterations == 20_000 and config.layers == (100, 50)
    assert (config.initial_collect_steps, config.collect_steps_per_iteration, config.batch_size) == (100, 1, 64)
    assert config.replay_buffer_capacity == 100_000 and config.learning_rate == 1e-3
    assert config.epsilon == 0.1 and config.adam_epsilon == 1e-7
    assert (config.log_interval, config.eval_interval, config.num_eval_episodes) == (200, 1_000, 10)


def test_stored_next_observations_are_the_true_ones(tmp_path):
    """Every stored transition is a step of CartPole's physics, at the time limit too, where the reset comes after."""
    still = {"learning_rate": 0.0, "epsilon": 0.0}  # so that the policy which acts is the last one
    path = dqn_cartpole.train(dataclasses.replace(TINY, max_episode_steps=7, run_dir=tmp_path / "run", **still))
    rows = checkpoint(path)["ranks"][0]["buffer"]["rows"]
    assert len(rows) == 50 + 60 and rows.untyped_storage().nbytes() == rows.nbytes  # not those of the whole capacity
    rows = rows.double().numpy()
    observations, actions, rewards, terminated, next_observations = np.split(rows, [4, 5, 6, 7], axis=1)
    greedy = load_policy(path / "policy.pt")(torch.from_numpy(observations).float())
    assert actions[50:, 0].tolist() == greedy[50:].tolist() and 0 < actions[:50].sum() < 50  # random ones first
    assert (terminated == 0).all()  # a pole needs more than 7 steps to fall
    physics = gym.make("CartPole-v1").unwrapped
    physics.reset(seed=0)
    for observation, action, next_observation in zip(observations, actions, next_observations):
        physics.state = observation
        expected, *_ = physics.step(int(action[0]))
        physics.steps_beyond_terminated = None
        np.testing.assert_allclose(next_observation, expected, atol=1e-5)
    # Within an episode one transition's next observation is the next one's observation; after 7 steps comes a reset.
    follows = (next_observations[:-1] == observations[1:]).all(axis=1)
    assert follows.tolist() == [i % 7 != 6 for i in range(len(rows) - 1)]


def test_acts_greedily_but_for_a_part_of_the_actions():
    torch.manual_seed(0)
    agent = make_agent(epsilon=0.3)
    observations = torch.randn(20_000, 4)
    with torch.no_grad():
        q = agent.q_network(agent.scaling(observations))
        agent.q_network.net[-1].bias[0] += (q[:, 1] - q[:, 0]).median()  # so each action is best in half of the states
    greedy = agent.q_network(agent.scaling(observations)).argmax(1)
    assert torch.equal(agent.policy(observations), greedy) and greedy.sum() == pytest.approx(10_000, abs=100)
    action = agent.policy.act(observations[0].numpy())
    assert action == greedy[0] and type(action) is np.int64  # as its space's samples
    actions = torch.from_numpy(agent.act(observations.numpy()))
    # One half of the random actions is greedy by chance: 0.85, with a standard deviation of 0.0025.
    assert (actions == greedy).float().mean() == pytest.approx(1 - 0.3 / 2, abs=0.01)
    random = agent.random_actions(20_000)
    assert set(random.tolist()) == {0, 1} and random.mean() == pytest.approx(0.5, abs=0.015)


def test_learning_rate_decays():
    """It is half after 2 updates with a decay of 2, a tenth after 6, and stays as it is without."""
    for decay, expected in ((2, [0.01, 0.005, 0.001]), (None, 3 * [0.01])):
        agent, rates = make_agent(learning_rate=0.01, learning_rate_decay=decay), []
        for step in (0, 2, 6):
            agent.update(random_batch(), step)
            rates.append(agent.optimizer.param_groups[0]["lr"])
        assert rates == pytest.approx(expected)


@pytest.mark.parametrize("tutorial", (False, True))
def test_update_is_dqn(tutorial):
    """Its loss and gradients, from the formulas: textbook DQN with `tutorial`, and with our choices."""
    torch.manual_seed(0)
    choices = {"gamma": 0.9, "target_update_tau": 0.25}
    agent = make_agent(**dqn_cartpole.TUTORIAL | choices if tutorial else choices)
    agent.target_network.load_state_dict(QNetwork(4, 2, TINY.layers).state_dict())
    old_target = [parameter.clone() for parameter in agent.target_network.parameters()]
    observations, actions, rewards, terminated, next_observations = batch = random_batch(64)
    agent.fit_scaling(observations, torch.tensor([-1.0, 3.0]))  # of mean 1 and mean size 2
    offset, scale = (0, 1) if tutorial else (10, 20)  # divided by 1 − 0.9: an endless episode's value
    assert (agent.value_offset.item(), agent.value_scale.item()) == pytest.approx((offset, scale))
    here, there = agent.scaling(observations), agent.scaling(next_observations)
    assert torch.equal(here, observations) == tutorial
    q = offset + scale * torch.where(actions == 0, *agent.q_network(here).unbind(1))
    with torch.no_grad():
        best_next = offset + scale * agent.target_network(there).max(1).values
        own, other = agent.target_network(here), agent.target_network(here).flip(1)
        gap = scale * torch.where(actions == 0, *(other - own).clamp(min=0).unbind(1))
        y = rewards + 0.9 * (1 - terminated) * best_next - (0 if tutorial else 0.9) * gap
    loss = (y - q).square().mean()
    gradients = torch.autograd.grad(loss, list(agent.q_network.parameters()))
    old = [parameter.detach().clone() for parameter in agent.q_network.parameters()]
    metrics = agent.update(batch, 0)
    torch.testing.assert_close(metrics, {"loss": loss.detach(), "mean_q": q.mean().detach()})
    moved = agent.q_network.parameters(), agent.target_network.parameters()
    for gradient, before, target_before, after, target in zip(gradients, old, old_target, *moved):
        torch.testing.assert_close(after.grad, gradient)
        assert (after != before).any() and not target.requires_grad
        torch.testing.assert_close(target, 0.75 * target_before + 0.25 * after.detach())


def test_rewards_of_zero_have_a_unit():
    agent = make_agent(gamma=0.9)
    agent.fit_scaling(torch.ones(3, 4), torch.zeros(3))
    assert (agent.value_offset.item(), agent.value_scale.item()) == pytest.approx((0, 10))


def test_an_update_reads_and_creates_nothing_on_another_device(monkeypatch):
    """On the meta device, whose tensors have no numbers: one of the CPU in between them is an error, as on a GPU."""
    adam = torch.optim.Adam
    monkeypatch.setattr(torch.optim, "Adam", lambda *args, **kwargs: adam(*args, **kwargs | {"fused": False}))
    agent = make_agent("meta")
    buffer = ReplayBuffer(40, 4, agent.device)
    buffer.size = 40
    agent.fit_scaling(*buffer.observations_and_rewards())
    metrics = agent.update(buffer.sample(16), 0)
    assert {value.device for value in metrics.values()} == {agent.device}


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA GPU")
def test_updates_on_the_gpu_are_those_of_the_cpu():
    batches = [random_batch() for _ in range(5)]
    agents = [make_agent(d, adam_epsilon=1e-2) for d in ("cpu", "cuda")]
    agents[1].load_state_dict(agents[0].state_dict())
    for agent in agents:
        agent.fit_scaling(batches[0][0].to(agent.device), batches[0][2].to(agent.device))
        for step, batch in enumerate(batches):
            metrics = agent.update([tensor.to(agent.device) for tensor in batch], step)
        agent.results = {name: value.cpu() for name, value in (metrics | agent.q_network.state_dict()).items()}
    torch.testing.assert_close(agents[1].results, agents[0].results, rtol=1e-3, atol=1e-4)


def test_ratio_holds_with_several_environments(tmp_path):
    """On a task of three actions and six observations, whose rewards are costs."""
    values = dict(env_id="Acrobot-v1", num_envs=3, collect_steps_per_iteration=2, learning_rate_decay=59, batch_size=51)
    state = checkpoint(path := dqn_cartpole.train(dataclasses.replace(TINY, **values, run_dir=tmp_path / "run")))
    assert state["optimizers"][0]["param_groups"][0]["lr"] == 0.0005  # half of it in update 59, the last from 0 on
    assert state["step"] == 60 and 50 + 2 * 60 <= state["env_steps"] < 50 + 2 * 60 + 3
    for row in read_csv(path / "eval.csv"):  # each step costs 1, but for the one that reaches the goal
        assert row["average_return"] == pytest.approx(-row["average_episode_length"], abs=1)
    own = state["ranks"][0]
    assert len(own["environments"]["episodes"]) == 3 and len(own["buffer"]["rows"]) == state["env_steps"]
    assert state["agent"]["value_offset"] == pytest.approx(-100) and state["agent"]["value_scale"] == pytest.approx(100)


def test_a_diverged_policy_is_not_the_best(tmp_path):
    choices = {"learning_rate": 1e39, "eval_interval": 1, "log_interval": 1000, "run_dir": tmp_path / "run"}
    with pytest.raises(common.RunError, match="is not finite at step 1; the last good checkpoint is kept"):
        dqn_cartpole.train(dataclasses.replace(TINY, **choices))
    weights = load_policy(tmp_path / "run" / "best_policy.pt").state_dict().values()
    assert all(tensor.isfinite().all() for tensor in weights)


def test_what_a_terminal_shows(monkeypatch, capsys, tmp_path):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    dqn_cartpole.train(dataclasses.replace(TINY, run_dir=tmp_path / "run"))
    shown = capsys.readouterr()
    assert "60/60" in shown.err and "return " in shown.err  # the progress bar
    for line in (r"step = 60: loss = \S+, steps per second = \d+", r"step = 60: AverageReturn = .*"):
        assert re.search(f"^{line}$", shown.out, re.MULTILINE), shown.out


def test_what_is_filmed(monkeypatch, tmp_path):
    """The trained agent, a random one, and five policies, closer to each other at the beginning."""
    films, done = {}, futures.Future()
    done.set_result(None)

    def record(run, clips, name, *more):
        films[name] = copy.deepcopy(clips)
        return done

    monkeypatch.setattr(common.Run, "_film", record)
    choices = {"eval_interval": 5, "video": True, "run_dir": tmp_path / "run"}
    path = dqn_cartpole.train(dataclasses.replace(TINY, **choices))
    captions = [caption.split(" updates: return ")[0] for _, _, caption in films["learning.mp4"]]
    assert captions == ["0", "5", "15", "35", "60"]
    ((trained, weights, _),) = films["trained_agent.mp4"]
    assert weights is None
    assert_same(trained.state_dict(), load_policy(path / "policy.pt").state_dict())
    assert films["random_agent.mp4"] == [(None, None, None)]


@pytest.mark.parametrize("seed", (0, 1))
def test_learns_cartpole(seed, tmp_path):
    """195 is the task's own threshold. A random policy stays 22 steps on average."""
    choices = dict(seed=seed, num_iterations=3000, eval_interval=500, device="cpu", video=False)
    path = dqn_cartpole.train(Config(**choices, run_dir=tmp_path / "run"))
    returns = [row["average_return"] for row in read_csv(path / "eval.csv")]
    assert max(returns) >= 195, returns
    assert read_csv(path / "random.csv")[0]["average_return"] < 60


class FromOne(gym.Env):
    observation_space = gym.spaces.Box(-1, 1, (4,))
    action_space = gym.spaces.Discrete(2, start=1)


def test_refuses_what_it_cannot_train_with(monkeypatch):
    """What DQN has to refuse itself. SAC's test has what both refuse, and how that is told."""
    monkeypatch.setitem(gym.registry, "FromOne-v0", gym.envs.registration.EnvSpec("FromOne-v0", FromOne))
    for choices, said in (
        ({"env_id": "Pendulum-v1"}, "Discrete"),
        ({"env_id": "FromOne-v0"}, "Discrete"),
        ({"batch_size": 51}, "--batch-size 51 is more than the 50"),
        ({"replay_buffer_capacity": 10**20}, "4400000000000.0 GB"),
    ):
        with pytest.raises(common.InputError, match=f"^[^\n]*{said}[^\n]*$"):
            dqn_cartpole.train(dataclasses.replace(TINY, **choices))


REFUSED = dict(
    num_iterations=(0, -5), num_envs=(0,), layers=((-4,), (10**9,)), learning_rate=(-1, math.nan), seed=(-1,),
    learning_rate_decay=(0,), epsilon=(3,), target_update_tau=(5,), gamma=(-1, 1), device=("tpu",),
    advantage_learning=(1,), wings=(2,),
)  # fmt: skip


@pytest.mark.parametrize("field, values", REFUSED.items())
def test_config_refuses_what_no_run_can_use(field, values):
    for value in values:
        with pytest.raises(ValidationError, match=field):
            Config(**{field: value})


def test_tutorial_sets_every_choice_of_ours_back():
    """The tutorial's values; a flag beside --tutorial counts."""
    source = (ROOT / "dqn_cartpole.py").read_text().splitlines()
    ours = {line.split(":")[0].strip() for line in source if "  # ours (" in line and ": " in line}
    assert ours == set(dqn_cartpole.TUTORIAL)
    config = read_command_line("dqn_cartpole", "--tutorial", "--gamma", 0.9)
    assert config == Config(tutorial=True, gamma=0.9)
    assert (config.learning_rate_decay, config.target_update_tau, config.gamma) == (None, 1.0, 0.9)
    assert (config.value_unit, config.advantage_learning, config.observation_scaling) == (False, 0.0, False)
    assert Config(tutorial=True).gamma == 1.0 and Config(tutorial=False) == Config()
    with pytest.raises(ValueError, match="tutorial"):
        Config(tutorial="no")
    assert read_command_line("dqn_cartpole", "--tutorial", "--no-tutorial") == Config()
    assert read_command_line("dqn_cartpole", "--tutorial", "--gamma", 1) == Config(tutorial=True)


def test_a_flag_is_judged_beside_the_saved_values(tmp_path):
    """Not beside the defaults: γ = 1 goes with no value unit."""
    saved = {"kind": "policy", "script": "dqn_cartpole", "format": common.FILE_FORMAT}
    torch.save(saved | {"config": common.plain_config(Config(tutorial=True))}, path := tmp_path / "policy.pt")
    for flags in (["--evaluate", path, "--gamma", 1], ["--gamma=1", f"--evaluate={path}"]):
        assert read_command_line("dqn_cartpole", *flags) == Config(tutorial=True, evaluate=path)


def test_only_cartpoles_own_version_warning_is_silenced():
    code = """if 1:
        import gymnasium as gym, dqn_cartpole
        gym.make("CartPole-v0")
        for version in (0, 1):
            gym.register(f"OldTask-v{version}", "gymnasium.envs.classic_control.cartpole:CartPoleEnv")
        gym.make("OldTask-v0")"""
    command = [sys.executable, "-W", "default", "-c", code]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    assert "OldTask-v0 is out of date" in result.stderr and "CartPole-v0" not in result.stderr
