"""DQN: its formulas by hand, its parts by what they promise, and that it learns."""

import dataclasses
import math
import subprocess
import sys

import gymnasium as gym
import numpy as np
import pytest
import torch
from pydantic import ValidationError

import common
import dqn_cartpole
from dqn_cartpole import Config, DQNAgent, QNetwork, ReplayBuffer
from runs import ROOT, assert_same_run, checkpoint, read_csv

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
    # Bounds that nobody reaches are none, those within two hundred times of the data are.
    scaling = dqn_cartpole.ObservationScaling(gym.spaces.Box(np.float32([-1e6, -20]), np.float32([1e6, 20])))
    scaling.fit(torch.tensor([[0.3, 0.2], [-0.1, -0.1]]), common.Ranks())
    assert scaling(torch.tensor([2.0, 10.0])).tolist() == [2.0, 0.5]
    unscaled = make_agent(observation_scaling=False)
    assert torch.equal(unscaled.scaling(observations), observations)


@pytest.mark.parametrize("bound", [1e3, 1e6])
def test_bounds_that_cartpole_does_not_reach_are_none(bound):
    with gym.make("CartPole-v0") as env:
        env.action_space.seed(0)
        observations = [env.reset(seed=0)[0]]
        while len(observations) < 100:
            observation, _, terminated, *_ = env.step(env.action_space.sample())
            observations.append(env.reset()[0] if terminated else observation)
    scaling = dqn_cartpole.ObservationScaling(gym.spaces.Box(-bound, bound, (4,)))
    scaling.fit(observations := torch.tensor(np.array(observations)), common.Ranks())
    assert torch.equal(scaling(observations), observations)


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
    assert Config().layers == (100, 50)  # the tutorial's


def test_buffer_overwrites_the_oldest():
    buffer = ReplayBuffer(5, 2, "cpu")
    for i in range(7):
        value = np.full((1, 2), i, np.float32)
        buffer.add(value, np.array([i % 2]), np.array([10.0 * i]), np.array([i == 4]), value + 0.5)
    assert (buffer.size, buffer.position) == (5, 2)
    observations, actions, rewards, terminated, next_observations = buffer.sample(1000)
    assert sorted(set(rewards.tolist())) == [20, 30, 40, 50, 60]
    assert actions.dtype == torch.int64 and (actions == rewards / 10 % 2).all()
    assert (observations[:, 0] * 10 == rewards).all() and (next_observations == observations + 0.5).all()
    assert (terminated == (rewards == 40)).all()


def test_several_environments_fill_the_buffer_across_its_end():
    buffer = ReplayBuffer(4, 1, "cpu")
    for i in range(2):
        column = np.arange(3.0) + 3 * i
        buffer.add(column[:, None], np.zeros(3), column, np.zeros(3), column[:, None])
    assert buffer.rows[:, 0].tolist() == [4, 5, 2, 3]
    assert (buffer.size, buffer.position) == (4, 2)


def test_stored_next_observations_are_the_true_ones(tmp_path):
    """Every stored transition is a step of CartPole's physics, at the time limit too, where the reset comes after."""
    path = dqn_cartpole.train(dataclasses.replace(TINY, max_episode_steps=7, run_dir=tmp_path / "run"))
    rows = checkpoint(path)["ranks"][0]["buffer"]["rows"]
    assert len(rows) == 50 + 60 and rows.untyped_storage().nbytes() == rows.nbytes  # not those of the whole capacity
    rows = rows.double().numpy()
    observations, actions, rewards, terminated, next_observations = np.split(rows, [4, 5, 6, 7], axis=1)
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


def test_epsilon_greedy_frequencies():
    torch.manual_seed(0)
    agent = make_agent(epsilon=0.3)
    observations = np.random.default_rng(0).normal(size=(1, 4)).repeat(20_000, axis=0)
    greedy = agent.q_network(torch.tensor(observations[:1], dtype=torch.float32)).argmax().item()
    # One half of the random actions is greedy by chance: 0.85, and its standard deviation is 0.0025.
    assert (agent.act(observations) == greedy).mean() == pytest.approx(1 - 0.3 / 2, abs=0.01)
    assert len(set(make_agent(epsilon=0.0).act(observations).tolist())) == 1


def test_random_actions_are_uniform():
    torch.manual_seed(0)
    actions = make_agent().random_actions(20_000)
    assert set(actions.tolist()) == {0, 1} and actions.mean() == pytest.approx(0.5, abs=0.015)


def test_update_moves_what_it_should():
    torch.manual_seed(0)
    agent = make_agent(target_update_tau=0.25)
    with torch.no_grad():
        for parameter in agent.target_network.parameters():
            parameter.add_(torch.randn_like(parameter))
    networks = agent.q_network, agent.target_network
    old_q, old_target = ([p.detach().clone() for p in network.parameters()] for network in networks)
    metrics = agent.update(random_batch(), 0)
    for old, new, old_t, new_t in zip(old_q, networks[0].parameters(), old_target, networks[1].parameters()):
        assert (old != new).any()
        torch.testing.assert_close(new_t, 0.75 * old_t + 0.25 * new.detach())
        assert not new_t.requires_grad
    assert set(metrics) == {"loss", "mean_q"} and not any(value.requires_grad for value in metrics.values())


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
    """The loss that is logged, from the formulas: textbook DQN with `tutorial`, and with our choices."""
    torch.manual_seed(0)
    agent = make_agent(**dqn_cartpole.TUTORIAL | {"gamma": 0.9} if tutorial else {"gamma": 0.9})
    agent.target_network.load_state_dict(QNetwork(4, 2, TINY.layers).state_dict())
    observations, actions, rewards, terminated, next_observations = batch = random_batch(64)
    agent.fit_scaling(observations, torch.tensor([1.0, 3.0]))
    offset, scale = (0, 1) if tutorial else (20, 20)  # an endless episode is worth 2 / (1 − 0.9)
    assert (agent.value_offset.item(), agent.value_scale.item()) == pytest.approx((offset, scale))
    here, there = agent.scaling(observations), agent.scaling(next_observations)
    assert torch.equal(here, observations) == tutorial
    with torch.no_grad():
        q = offset + scale * torch.where(actions == 0, *agent.q_network(here).unbind(1))
        best_next = offset + scale * agent.target_network(there).max(1).values
        own, other = agent.target_network(here), agent.target_network(here).flip(1)
        gap = scale * torch.where(actions == 0, *(other - own).clamp(min=0).unbind(1))
        error = rewards + 0.9 * (1 - terminated) * best_next - (0 if tutorial else 0.9) * gap - q
    metrics = agent.update(batch, 0)
    torch.testing.assert_close(metrics["loss"], error.square().mean())
    torch.testing.assert_close(metrics["mean_q"], q.mean())


def test_learns_values_of_a_known_chain():
    """One state, reward 1, no end: Q → 1 / (1 − γ); where every step terminates: Q → 1. So with rewards that cost."""
    for reward in (1.0, -1.0):
        for terminated, value in ((0.0, 2.0), (1.0, 1.0)):
            torch.manual_seed(0)
            agent = make_agent(gamma=0.5, learning_rate=1e-2, target_update_tau=0.1)
            observations, actions = torch.ones(16, 4), torch.arange(16) % 2
            batch = observations, actions, torch.full((16,), reward), torch.full((16,), terminated), observations
            agent.fit_scaling(observations, batch[2])
            for step in range(400):
                agent.update(batch, step)
            q = agent.q_values(agent.q_network, agent.scaling(torch.ones(4)))
            assert q.tolist() == pytest.approx(2 * [reward * value], abs=0.02)


def test_rewards_of_zero_have_a_unit():
    agent = make_agent(gamma=0.9)
    agent.fit_scaling(torch.ones(3, 4), torch.zeros(3))
    assert (agent.value_offset.item(), agent.value_scale.item()) == pytest.approx((0, 10))


def test_policy_is_greedy():
    torch.manual_seed(0)
    agent = make_agent()
    observations = torch.randn(50, 4)
    q = agent.q_network(agent.scaling(observations))
    assert agent.policy(observations).tolist() == q.argmax(1).tolist() != q.argmin(1).tolist()
    with torch.no_grad():
        agent.q_network.net[-1].weight.neg_()
    assert agent.policy(observations).tolist() == q.argmin(1).tolist()


def test_policy_gives_a_task_the_type_of_action_that_its_space_has():
    spaces = gym.spaces.Box(-1, 1, (2,)), gym.spaces.Discrete(3)
    policy = dqn_cartpole.Policy(dqn_cartpole.Config(), *spaces)
    assert type(policy.act(np.zeros(2))) is type(spaces[1].sample())


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


@pytest.fixture(scope="module")
def tiny_run(tmp_path_factory):
    """The directory of a tiny run."""
    path = tmp_path_factory.mktemp("tiny") / "run"
    assert dqn_cartpole.train(dataclasses.replace(TINY, run_dir=str(path))) == path
    return path


def test_train_writes_what_it_should(tiny_run):
    rows = read_csv(tiny_run / "train.csv")
    assert [row["step"] for row in rows] == [10, 20, 30, 40, 50, 60]
    assert [row["env_steps"] for row in rows] == [60, 70, 80, 90, 100, 110]
    assert all(math.isfinite(row[name]) for row in rows for name in ("loss", "mean_q", "collect_return"))
    rows = read_csv(tiny_run / "eval.csv")
    assert [row["step"] for row in rows] == [0, 20, 40, 60]
    assert all(row["average_return"] == row["average_episode_length"] for row in rows)  # CartPole pays 1 a step
    assert len(read_csv(tiny_run / "random.csv")) == 1
    names = {path.name for path in tiny_run.iterdir()}
    assert names > {"config.json", "learning_curve.png", "checkpoint.pt", "policy.pt", "policy.pt2", "best_policy.pt2"}


def test_train_updates_as_often_as_asked(tiny_run):
    state = checkpoint(tiny_run)
    assert (state["step"], state["env_steps"], len(state["ranks"][0]["buffer"]["rows"])) == (60, 110, 110)
    optimizer = state["optimizers"][0]["state"]
    assert all(each["step"] == 60 for each in optimizer.values()) and len(optimizer) == 6
    torch.manual_seed(TINY.seed)
    untrained = make_agent().state_dict()
    for name in (name for name in untrained if name.startswith(("q_network", "target_network"))):
        assert not torch.equal(state["agent"][name], untrained[name]), name


def test_same_seed_same_bits(tiny_run, tmp_path):
    assert_same_run(dqn_cartpole.train(dataclasses.replace(TINY, run_dir=tmp_path / "same")), tiny_run)
    other = dqn_cartpole.train(dataclasses.replace(TINY, seed=TINY.seed + 1, run_dir=tmp_path / "other"))
    mine, others = checkpoint(tiny_run), checkpoint(other)
    assert not torch.equal(mine["agent"]["q_network.net.0.weight"], others["agent"]["q_network.net.0.weight"])
    assert not torch.equal(mine["ranks"][0]["buffer"]["rows"], others["ranks"][0]["buffer"]["rows"])


def test_ratio_holds_with_several_environments(tmp_path):
    config = dataclasses.replace(TINY, num_envs=3, collect_steps_per_iteration=2, run_dir=str(tmp_path / "run"))
    state = checkpoint(dqn_cartpole.train(config))
    assert state["step"] == 60 and 50 + 2 * 60 <= state["env_steps"] < 50 + 2 * 60 + 3
    own = state["ranks"][0]
    assert len(own["environments"]["episodes"]) == 3 and len(own["buffer"]["rows"]) == state["env_steps"]


def test_other_tasks_train(tmp_path):
    """Three actions, six observations."""
    config = dataclasses.replace(TINY, env_id="Acrobot-v1", num_iterations=20, run_dir=str(tmp_path / "run"))
    assert read_csv(dqn_cartpole.train(config) / "eval.csv")[-1]["step"] == 20


@pytest.mark.parametrize("seed", (0, 1))
def test_learns_cartpole(seed, tmp_path):
    """195 is the task's own threshold. A random policy stays 22 steps on average."""
    choices = dict(seed=seed, num_iterations=3000, eval_interval=500, device="cpu", video=False)
    path = dqn_cartpole.train(Config(**choices, run_dir=tmp_path / "run"))
    returns = [row["average_return"] for row in read_csv(path / "eval.csv")]
    assert max(returns) >= 195, returns
    assert read_csv(path / "random.csv")[0]["average_return"] < 60


def test_imports_without_pybullet():
    code = (
        "import sys; sys.modules.update(dict.fromkeys(('pybullet', 'pybullet_data', 'pybullet_utils')));"
        "import dqn_cartpole; assert 'sac_minitaur' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True)


@pytest.mark.parametrize(
    "arguments, said",
    [
        ("--env-id Pendulum-v1", "Discrete"),
        ("--env-id FromOne-v0", "Discrete"),
        ("--batch-size 101", "batch"),
        ("--replay-buffer-capacity 1000000000000", "44000.0 GB"),
    ],
)
def test_bad_input_is_one_line(arguments, said, monkeypatch, capfd):
    """What DQN has to refuse itself. SAC's test has what both refuse."""
    monkeypatch.setitem(gym.registry, "FromOne-v0", gym.envs.registration.EnvSpec("FromOne-v0", FromOne))
    monkeypatch.setattr(sys, "argv", ["dqn_cartpole.py", *arguments.split()])
    with pytest.raises(SystemExit) as stopped:
        common.run_main(dqn_cartpole.main)
    lines = capfd.readouterr().err.splitlines()
    assert stopped.value.code == 2
    assert len(lines) == 1 and lines[0].startswith("error: ") and said in lines[0]


class FromOne(gym.Env):
    observation_space = gym.spaces.Box(-1, 1, (4,))
    action_space = gym.spaces.Discrete(2, start=1)


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


def test_tutorial_sets_every_choice_of_ours_back(monkeypatch):
    """The tutorial's values; a flag beside --tutorial counts."""
    source = (ROOT / "dqn_cartpole.py").read_text().splitlines()
    ours = {line.split(":")[0].strip() for line in source if "  # ours (" in line and ": " in line}
    assert ours == set(dqn_cartpole.TUTORIAL)
    monkeypatch.setattr(sys, "argv", ["dqn_cartpole.py", "--tutorial", "--gamma", "0.9"])
    config = common.read_command_line(Config, "")
    assert config == Config(tutorial=True, gamma=0.9)
    assert (config.learning_rate_decay, config.target_update_tau, config.gamma) == (None, 1.0, 0.9)
    assert (config.value_unit, config.advantage_learning, config.observation_scaling) == (False, 0.0, False)
    assert Config(tutorial=True).gamma == 1.0
    with pytest.raises(ValueError, match="tutorial"):
        Config(tutorial="no")
    monkeypatch.setattr(sys, "argv", ["dqn_cartpole.py", "--tutorial", "--gamma", "1"])
    assert common.read_command_line(Config, "") == Config(tutorial=True)


def test_a_flag_is_judged_beside_the_saved_values(monkeypatch, tmp_path):
    """Not beside the defaults: γ = 1 goes with no value unit."""
    saved = {"kind": "policy", "script": "dqn_cartpole", "format": common.FILE_FORMAT}
    torch.save(saved | {"config": common.plain_config(Config(tutorial=True))}, path := tmp_path / "policy.pt")
    for flags in (["--evaluate", str(path), "--gamma", "1"], ["--gamma=1", f"--evaluate={path}"]):
        monkeypatch.setattr(sys, "argv", ["dqn_cartpole.py", *flags])
        assert common.read_command_line(Config, "") == Config(tutorial=True, evaluate=path)


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
