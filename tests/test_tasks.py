"""Tasks of one's own: their arrays, bounds, types, time limits, errors and films."""

import multiprocessing
import os
import re
import runpy
import signal
import sys
import time
from pathlib import Path

import gymnasium as gym
import imageio
import numpy as np
import pytest
import torch
from matplotlib.figure import Figure

import common
import dqn_cartpole
import sac_minitaur
from runs import MODULES, ROOT, checkpoint, load_policy, read_csv, run_python
from test_input import main

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning:gymnasium", "ignore::DeprecationWarning:gymnasium")


class Echo(gym.Env):
    """Observes the number of the step and the action just taken, and checks that the action is in its space."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 100}

    def __init__(self, render_mode=None, low=-1, high=1, dtype=np.float32, discrete=False, fault=None, folder=None):
        self.render_mode = render_mode
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (1, 2))
        box = gym.spaces.Box(low, high, np.shape(low) or (1, 1), dtype)
        self.action_space = gym.spaces.Discrete(2) if discrete else box
        self.fault = fault
        self.state = np.zeros(2, np.float32)
        if folder:
            Path(folder, f"{os.getpid()}-{time.monotonic_ns()}").touch()

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        if self.fault == "seed":
            torch.manual_seed(42)
        if self.fault == "reset":
            raise ConnectionError("no server")
        self.state[:] = 0
        return self._observation(), {}

    def step(self, action):
        assert action in self.action_space, action
        self.state += 1
        self.state[1] = np.ravel(action)[0]
        if self.fault == "step" and self.state[0] == 3:
            raise ConnectionError("no server")
        if self.fault == "in place" and isinstance(action, np.ndarray):
            action[:] = 99
        return self._observation(), float(self.state[0]), False, False, {}

    def _observation(self):
        observation = self.state[None]
        return observation if self.fault == "in place" else observation.copy()

    def render(self):
        return None if self.fault == "render" else np.full((32, 48, 3), 10 * self.state[0], np.uint8)


@pytest.fixture
def register(monkeypatch):
    """Registers a task for one test and returns its id."""

    def register(entry_point=Echo, limit=4, **kwargs):
        spec = gym.envs.registration.EnvSpec("Mine-v0", entry_point, max_episode_steps=limit, kwargs=kwargs)
        monkeypatch.setitem(gym.registry, "Mine-v0", spec)
        return "Mine-v0"

    return register


SHORT = {
    "device": "cpu", "num_iterations": 20, "initial_collect_steps": 40, "batch_size": 16, "replay_buffer_capacity": 60,
    "log_interval": 10, "eval_interval": 10, "checkpoint_interval": 10, "num_eval_episodes": 2, "video": False,
}  # fmt: skip
SMALL = {"sac_minitaur": {"actor_layers": (16,), "critic_layers": (16,)}, "dqn_cartpole": {"layers": (8,)}}


def train(script, path, **choices):
    module = MODULES[script]
    return module.train(module.Config(**SHORT | SMALL[script] | {"run_dir": path} | choices))


def test_arrays_that_a_task_changes_in_place(script, register, tmp_path):
    """Copies of observations and actions are stored, in the order of the steps. Each worker makes the task once."""
    num_envs = {"num_envs": 2} if script == "sac_minitaur" else {}
    env_id = register(fault="in place", high=3, discrete=script == "dqn_cartpole", folder=str(tmp_path))
    choices = num_envs | {"replay_buffer_capacity": 1000, "collect_steps_per_iteration": 3}
    path = train(script, tmp_path / "run", env_id=env_id, **choices)
    replay = checkpoint(path)["processes"][0]["replay"]
    observations, next_observations = replay["observations"], replay["next_observations"]
    assert torch.equal(next_observations[:, 0], observations[:, 0] + 1)
    assert torch.equal(replay["rewards"], next_observations[:, 0]) and not replay["terminated"].any()
    assert observations[:, 0].unique().tolist() == [0, 1, 2, 3] and not observations[observations[:, 0] == 0].any()
    actions = replay["actions"].flatten()
    taken = 1 + 2 * actions if script == "sac_minitaur" else actions.float()
    torch.testing.assert_close(next_observations[:, 1], taken)
    step = 2 if num_envs else 1
    same_episode = observations[step:, 0] > 0
    assert torch.equal(observations[step:][same_episode], next_observations[:-step][same_episode])
    assert len(actions[:40].unique()) == (40 if script == "sac_minitaur" else 2)  # random ones first
    # Returns of 1 + 2 + 3 + 4, lengths of 4, of the last ten episodes that ended, and of the evaluations.
    row = read_csv(path / "train.csv")[-1]
    assert (row["collect_return"], row["collect_episode_length"]) == (10, 4)
    rows = read_csv(path / "eval.csv")
    assert {(row["average_return"], row["average_episode_length"]) for row in rows} == {(10, 4)}
    assert [row["env_steps"] for row in rows] == [40, 40 + 30 * step, 40 + 60 * step]
    made = [path.name.split("-")[0] for path in tmp_path.glob("*-*")]
    in_workers = [pid for pid in made if int(pid) != os.getpid()]
    assert in_workers and len(in_workers) == len(set(in_workers))


@pytest.mark.parametrize("dtype, scale", [(np.float32, 10), (np.float32, 3e38), (np.float64, 10), (np.float16, 6e4)])
def test_actions_never_leave_the_bounds(dtype, scale, register):
    random = np.random.default_rng(0)
    low, high = np.sort(random.uniform(-scale, scale, (2, 300)).astype(dtype), axis=0)
    low[:2], high[:2] = (-1, 0.9 * scale), (0.2, scale)  # one rounding out, and an overflow of their sum
    space = gym.spaces.Box(low, high, dtype=dtype)
    config = sac_minitaur.Config(actor_layers=())
    policy = sac_minitaur.Policy(config, gym.spaces.Box(-1, 1, (1,)), space)
    task = gym.spec(register(low=low, high=high, dtype=dtype))
    env = sac_minitaur.make_training_env(task, False)
    env.reset()
    for sign in (-1, 1, 0.999, -1e-3):
        with torch.no_grad():
            policy.actor.net[0].weight.zero_()
            policy.actor.net[0].bias.fill_(np.arctanh(sign) if abs(sign) < 1 else 100 * sign)
        acted, forward = policy.act(np.zeros(1)), policy(torch.zeros(2, 1))[1].detach().numpy()
        env.step(np.full(300, sign, np.float32))  # the task looks whether it is in its space
        assert acted in space and (low <= forward).all() and (forward <= high).all()  # as policy.pt2 acts, in float32
        exact = low.astype(float) + (high.astype(float) - low) * (1 + sign) / 2
        for actions in (acted, forward):
            np.testing.assert_allclose(actions, exact, rtol=0, atol=(1e-2 if dtype == np.float16 else 1e-5) * scale)
    assert env.action_space == gym.spaces.Box(-1, 1, (300,))


def test_float16_trains_evaluates_and_exports(register, tmp_path, monkeypatch, capsys):
    path = train("sac_minitaur", tmp_path / "run", env_id=register(dtype=np.float16, low=-60000, high=60000))
    capsys.readouterr()
    assert main(monkeypatch, "--evaluate", path / "policy.pt") == 0  # of a run without videos: this one wants a film
    output = capsys.readouterr().out
    assert f"AverageReturn = {read_csv(path / 'eval.csv')[-1]['average_return']:.6f}" in output
    assert "filmed one episode" in output and (path / "policy.mp4").exists()
    observations = torch.rand(5, 1, 2)
    exported = torch.export.load(path / "policy.pt2").module()(observations)
    assert torch.equal(exported, load_policy(path / "policy.pt")(observations))


def test_a_task_without_a_time_limit_gets_one_and_says_so(register, tmp_path, capsys):
    env_id = register(limit=None, discrete=True)
    config = dqn_cartpole.Config(env_id=env_id, checkpoint_interval=5)  # it may be shorter than our limit
    task, *_ = common.find_task(config, gym.spaces.Discrete)
    assert task.max_episode_steps == 1_000
    path = train("dqn_cartpole", tmp_path / "run", env_id=env_id, max_episode_steps=7)
    assert "at most 7 steps" in capsys.readouterr().out
    assert {row["average_episode_length"] for row in read_csv(path / "eval.csv") + read_csv(path / "random.csv")} == {7}


def test_workers_are_clean(tmp_path, monkeypatch):
    """As a task on JAX, this one starts a thread where it is imported, and works in no process that is forked later."""
    (tmp_path / "threaded_task.py").write_text("""
import os, threading
import gymnasium
from gymnasium.envs.classic_control.pendulum import PendulumEnv
IMPORTED_BY = os.getpid()
threading.Thread(target=threading.Event().wait, daemon=True).start()
class Task(PendulumEnv):
    def reset(self, **options):
        assert os.getpid() == IMPORTED_BY, "forked"
        return super().reset(**options)
gymnasium.register("Mine-v0", Task, max_episode_steps=4)
""")
    flags = "--initial-collect-steps 150 --num-iterations 2 --num-eval-episodes 2 --num-envs 1 --no-video --device cpu"
    run_python(tmp_path, ROOT / "sac_minitaur.py", "--env-id", "threaded_task:Mine-v0", *flags.split())
    assert len(list((tmp_path / "runs").glob("sac_minitaur-*-seed0"))) == 1  # where a run lies that has no --run-dir
    monkeypatch.setitem(sys.modules, "jax", sys)
    assert common.start_method("Mine-v0") == "forkserver"


def test_a_task_that_seeds_the_global_generator_repeats_no_batch(register, tmp_path):
    path = train("dqn_cartpole", tmp_path / "run", env_id=register(fault="seed", discrete=True), epsilon=1.0)
    replay = checkpoint(path)["processes"][0]["replay"]
    actions = replay["actions"].view(-1, 4)
    assert len(actions.unique(dim=0)) > 6


def test_wrappers_that_learn_statistics_are_named(register, tmp_path, capsys):
    make = gym.wrappers.NormalizeObservation
    env_id = register(lambda: make(gym.make("Pendulum-v1")), limit=None)
    common.find_task(sac_minitaur.Config(env_id=env_id), gym.spaces.Box)
    assert "warning: evaluations have their own NormalizeObservation" in capsys.readouterr().out


@pytest.mark.parametrize("fault", ("reset", "step"))
def test_an_error_of_the_task_ends_the_run_with_a_traceback(script, fault, register, tmp_path, monkeypatch):
    """Its own, and no process is left behind: "reset" fails in an evaluation, "step" in training."""
    if fault == "step":
        monkeypatch.setattr(common.Run, "evaluate", lambda run, step, policy: None)
    with pytest.raises(ConnectionError, match="no server"):
        train(script, tmp_path / "run", env_id=register(fault=fault, discrete=script == "dqn_cartpole"))
    assert not multiprocessing.active_children()


RATES = {"sac_minitaur": {"critic_learning_rate": 1e30}, "dqn_cartpole": {"learning_rate": 1e30}}


@pytest.mark.parametrize("log_interval, checkpoint_interval", [(1, 10), (1000, 10), (1000, 40)])
def test_a_run_that_diverges_ends(script, log_interval, checkpoint_interval, register, tmp_path):
    """Before a checkpoint has such weights: a row, a checkpoint or an evaluation finds them, or SAC's actions."""
    intervals = {"log_interval": log_interval, "checkpoint_interval": checkpoint_interval, "num_iterations": 50}
    env_id = register(discrete=script == "dqn_cartpole")
    said = r"loss is not finite at step \d+;" if log_interval == 1 else "is not finite at step 10;"
    if script == "sac_minitaur":
        said = f"{said}|the actor's actions are not finite"
    with pytest.raises(FloatingPointError, match=said):
        train(script, tmp_path / "run", env_id=env_id, **intervals, **RATES[script])
    for name in ("policy.pt", "best_policy.pt"):
        assert all(weights.isfinite().all() for weights in load_policy(tmp_path / "run" / name).parameters())
    assert all(tensor.isfinite().all() for tensor in checkpoint(tmp_path / "run")["agent"].values())


def test_a_task_that_only_the_main_program_knows(tmp_path):
    """As in a notebook: its class is no module's, and the run is started without `if __name__`."""
    choices = SHORT | SMALL["sac_minitaur"] | {"run_dir": "run", "env_id": "Mine-v0", "max_episode_steps": 5}
    program = f"""
import gymnasium as gym
from gymnasium.envs.classic_control import PendulumEnv
import sac_minitaur
class Mine(PendulumEnv):
    pass
gym.register("Mine-v0", entry_point=Mine)
print(sac_minitaur.train(sac_minitaur.Config(**{choices})))
"""
    (tmp_path / "program.py").write_text(program)
    assert run_python(tmp_path, "program.py").stdout.splitlines()[-1] == "run"


def test_dqn_learns_cartpole(tmp_path):
    """195 is the task's own threshold. A random policy stays 22 steps on average."""
    choices = {"num_iterations": 3000, "eval_interval": 500, "device": "cpu", "video": False}
    path = dqn_cartpole.train(dqn_cartpole.Config(**choices, run_dir=tmp_path / "run"))
    returns = [row["average_return"] for row in read_csv(path / "eval.csv")]
    assert max(returns) >= 195, returns
    assert read_csv(path / "random.csv")[0]["average_return"] < 60


def test_sac_learns_pendulum(tmp_path):
    choices = {
        "env_id": "Pendulum-v1", "device": "cpu", "num_iterations": 5000, "initial_collect_steps": 1000,
        "batch_size": 128, "actor_layers": (64, 64), "critic_layers": (64, 64), "log_interval": 1000,
        "eval_interval": 5000, "checkpoint_interval": 5000, "num_eval_episodes": 10, "video": False,
    }  # fmt: skip
    path = sac_minitaur.train(sac_minitaur.Config(**choices, run_dir=tmp_path / "run"))
    rows = read_csv(path / "eval.csv")
    assert rows[0]["average_return"] < -700
    assert rows[1]["average_return"] > -300  # a pendulum kept upright from the first swing on has about −150


# Films and the console


def test_films_in_real_time_with_a_caption_for_each_policy(register, tmp_path):
    register(limit=50)
    common.film(tmp_path / "film.mp4", "Mine-v0", 0, [(None, ""), (None, "a caption")])
    with imageio.get_reader(tmp_path / "film.mp4") as video:
        frames = [np.asarray(frame) for frame in video]
        assert video.get_meta_data()["fps"] == 50
    assert len(frames) == 2 * 26  # every second of 50 steps, and the last
    assert frames[0].shape == (32, 48, 3) and np.abs(frames[12].mean() - 240) < 12 and frames[0].std() < 3
    assert frames[26].std() > 10  # letters
    assert not list(tmp_path.glob(".tmp-*"))


def test_frames_that_cannot_be_filmed_cost_a_line(register, tmp_path, capsys):
    for frame, found in ((np.zeros((32, 32, 3)), "float64 (32, 32, 3)"), ([], "list")):
        with pytest.raises(ValueError, match=re.escape(f"render returned {found}; needed: an array of uint8")):
            common.with_caption(frame, "a caption")
    path = train("dqn_cartpole", tmp_path / "run", env_id=register(fault="render", discrete=True), video=True)
    assert "warning: no film (the task's render returned NoneType" in capsys.readouterr().out
    assert not list(path.glob("*.mp4")) + list(path.glob(".tmp*"))


def test_what_a_terminal_shows(monkeypatch, capsys, register, tmp_path):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    filmed = {}

    def film(path, task, seed, clips, seconds=None):
        filmed[path.name] = [(policy is None, caption) for policy, caption in clips]

    monkeypatch.setattr(common, "film", film)
    path = train("dqn_cartpole", tmp_path / "run", env_id=register(discrete=True), video=True)
    shown = capsys.readouterr()
    assert "20/20" in shown.err and "return 10" in shown.err  # the progress bar
    for line in (r"step = 20: loss = \S+, steps per second = \d+", r"step = 20: AverageReturn = .*"):
        assert re.search(f"^{line}$", shown.out, re.MULTILINE), shown.out
    assert filmed == {
        "trained_agent.mp4": [(False, "")],
        "random_agent.mp4": [(True, "")],
        "learning.mp4": [(False, f"{step} updates: return 10.0") for step in (0, 10, 20)],
    }
    assert [step for step, *_ in checkpoint(path)["snapshots"]] == [0, 10]  # a longer run goes on from here


@pytest.mark.parametrize("loss", ("loss", "critic_loss"))
def test_the_learning_curve(loss, monkeypatch, tmp_path):
    figures = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, *args, **kwargs: figures.append(figure))
    evaluations = [{"step": step, "average_return": step / 10, "std_return": 1.0} for step in (0, 10, 20)]
    train = [{"step": 10, loss: 2.0, "mean_q": 3.0}, {"step": 20, loss: 1.0, "mean_q": 4.0}]
    tables = {"eval": evaluations, "train": train, "random": [{"average_return": 0.5}]}
    common.plot_learning_curve(tmp_path / "curve.png", tables, "Mine-v0, seed 0", reward_threshold=5.0)
    lines = [line.get_ydata() for axes in figures[0].axes for line in axes.lines]
    assert [list(line) for line in lines if len(line)] == [[0, 1, 2], [0.5, 0.5], [5, 5], [2, 1], [3, 4]]


def test_the_formulas_tests_need_no_fork_and_no_signal(monkeypatch):
    """On Windows, too, conftest.py imports these helpers."""
    monkeypatch.setattr(multiprocessing, "get_context", None)
    for module, name in ((signal, "SIGKILL"), (os, "setsid"), (os, "killpg")):
        monkeypatch.delattr(module, name)
    runpy.run_path(str(ROOT / "tests" / "runs.py"))


def test_exported_policies_act_as_those_that_are_evaluated(script, reference):
    """For batches of any size."""
    for name in ("policy", "best_policy"):
        policy = load_policy(reference / f"{name}.pt")
        exported = torch.export.load(reference / f"{name}.pt2").module()
        for size in (1, 2, 300):
            observations = torch.randn(size, 4 if script == "dqn_cartpole" else 3)
            torch.testing.assert_close(exported(observations), policy(observations), rtol=1e-6, atol=1e-6)


def test_the_policy_that_readme_films(monkeypatch, capsys, tmp_path):
    pytest.importorskip("pybullet")
    path = Path(tmp_path / "minitaur_policy.pt")
    path.write_bytes((ROOT / "results" / "minitaur_policy.pt").read_bytes())
    arguments = ["--evaluate", path, "--num-eval-episodes", 1, "--max-episode-steps", 50]
    assert main(monkeypatch, *arguments) == 0
    shown = re.search(r"AverageReturn = (\S+) .* = 50\.0", capsys.readouterr().out)
    assert float(shown[1]) > 0.5  # standing still has 0
    with imageio.get_reader(tmp_path / "minitaur_policy.mp4") as video:
        frames = [np.asarray(frame) for frame in video]
    assert len(frames) == 26 and frames[0].shape == (360, 480, 3)
    assert np.abs(np.subtract(*np.float32([frames[0], frames[-1]]))).max() > 100  # the robot is seen, and moves


def test_evaluation_episodes_are_none_of_trainings():
    evaluation = set(common.evaluation_seeds(sac_minitaur.Config(num_eval_episodes=100)))
    training = {common.derive_seed(0, env, update) for env in range(100) for update in range(100)}
    training |= {common.derive_seed(0, env) for env in range(100)}
    assert len(evaluation) == 100 and len(training) == 10_100 and not evaluation & training
