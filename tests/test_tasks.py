"""Tasks of one's own: how they fail, what they do to arrays, their bounds, types and time limits."""

import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
from functools import partial
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch

import common
import sac_minitaur
from runs import Process, checkpoint, flags, load_policy, read_csv, wait_until
from sac_minitaur import Config, Policy
from test_sac import TINY, main, train

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning:gymnasium")  # what it says of such tasks
SHORT = dict(initial_collect_steps=40, num_iterations=20, replay_buffer_capacity=60, log_interval=20)


class Echo(gym.Env):
    """Observes the number of the step and the action just taken, and checks that the action is in its space."""

    def __init__(self, low=-1, high=1, dtype=np.float32, in_place=False, fails=None, error=None, observations=None):
        self.observation_space = observations or gym.spaces.Box(-np.inf, np.inf, (2,))
        self.action_space = gym.spaces.Box(low, high, np.shape(low) or (1,), dtype)
        self.in_place, self.fails, self.error = in_place, fails, error
        self.state = np.zeros(2, np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        assert torch.get_num_threads() == 1  # what a worker uses
        if self.fails == "reset":
            raise self.error()
        self.state[:] = 0
        return self._observation(), {}

    def step(self, action):
        assert action in self.action_space, action
        if self.fails == "step":
            raise self.error()
        self.state += 1
        self.state[1] = action[0]
        if self.in_place:
            action[:] = 99
        return self._observation(), float(self.state[0]), False, False, {}

    def _observation(self):
        return self.state if self.in_place else self.state.copy()


class Unrepeatable(Echo):
    """Its episodes end when something outside says so, which is not the same on resume. So with what it returns."""

    length, error_of_rewards, error_of_observations = 50, 0, 0

    def step(self, action):
        observation, reward, *_ = super().step(action)
        done = bool(self.state[0] >= self.length)
        return observation + self.error_of_observations, reward + self.error_of_rewards, done, False, {}


class Helped(gym.Wrapper):
    """It starts a program, as a simulator that is a server, and a forked process. Both run until it ends them."""

    def __init__(self, env_id):
        super().__init__(gym.make(env_id))
        self.program = subprocess.Popen(["sleep", "1000000"])
        self.process = multiprocessing.get_context("fork").Process(target=time.sleep, args=(10**6,))
        self.process.start()

    def step(self, action):
        observation, *_ = self.env.step(action)
        return observation, 1.0, False, False, {}  # its time limit alone ends an episode

    def close(self):
        ran = self.program.poll() is None and self.process.is_alive()
        for each, wait in ((self.program, self.program.wait), (self.process, self.process.join)):
            each.terminate()
            wait()
        assert ran


class Wordless(Exception):
    """It cannot tell its message, because of a fault in it."""

    def __str__(self):
        return self.message


class TwoArguments(Exception):
    """It cannot be made anew from its message, as pickle would."""

    def __init__(self, code, text):
        super().__init__(f"{text}: {code}")


gym.register("Echo-v0", entry_point=Echo, max_episode_steps=4)
gym.register("Endless-v0", entry_point=Echo)
gym.register("HelpedBox-v0", entry_point=Helped, kwargs={"env_id": "Pendulum-v1"})
gym.register("HelpedDiscrete-v0", entry_point=Helped, kwargs={"env_id": "CartPole-v1"})
gym.register("Unrepeatable-v0", entry_point=Unrepeatable, max_episode_steps=100)
IDS = {"env_id": f"{__name__}:Echo-v0"}


@pytest.fixture
def register(monkeypatch):
    """Registers a task for one test and returns its id."""

    def register(entry_point=Echo, limit=4, **kwargs):
        spec = gym.envs.registration.EnvSpec("Mine-v0", entry_point, max_episode_steps=limit, kwargs=kwargs)
        monkeypatch.setitem(gym.registry, "Mine-v0", spec)
        return "Mine-v0"

    return register


@pytest.mark.parametrize("high", [1, 3])  # the agent's actions themselves, or rescaled
def test_arrays_that_a_task_changes_in_place(high, register, tmp_path):
    path, _ = train(tmp_path / "run", **SHORT, env_id=register(high=high, in_place=True), num_envs=2)
    own = checkpoint(path)["ranks"][0]
    observations, actions, rewards, _, next_observations = own["buffer"]["rows"].split((2, 1, 1, 1, 2), dim=1)
    assert torch.equal(next_observations[:, :1], observations[:, :1] + 1)
    assert torch.equal(rewards, next_observations[:, :1])
    assert observations[:, 0].unique().tolist() == [0, 1, 2, 3] and not observations[observations[:, 0] == 0].any()
    torch.testing.assert_close(next_observations[:, 1:], actions if high == 1 else 1 + 2 * actions)
    # Those of the running episodes, to be played again on resume.
    assert all(len(actions) == 2 and actions.abs().max() <= 1 for _, actions in own["environments"]["episodes"])


@pytest.mark.parametrize(
    "dtype, low, high",
    [(np.float32, -1, 0.2), (np.float64, -0.1, 0.7), (np.float16, -0.1, 0.7), (np.float16, -60000, 60000)],
)
def test_every_type_of_float_trains_evaluates_and_exports(dtype, low, high, register, tmp_path, monkeypatch, capsys):
    env_id = register(dtype=dtype, low=low, high=high)
    path, _ = train(tmp_path / "run", **SHORT, env_id=env_id)
    capsys.readouterr()
    assert main(monkeypatch, "--evaluate", path / "policy.pt") == 0  # of a run without videos: this one wants a film
    output = capsys.readouterr().out
    assert f"AverageReturn = {read_csv(path / 'eval.csv')[-1]['average_return']:.6f}" in output
    assert "warning: no video (Echo.__init__() got an unexpected keyword argument 'render_mode'" in output
    observations = torch.rand(5, 2)
    exported = torch.export.load(path / "policy.pt2").module()(observations)
    assert torch.equal(exported, load_policy(path / "policy.pt")(observations))


@pytest.mark.parametrize("dtype, scale", [(np.float32, 10), (np.float32, 3e38), (np.float64, 10), (np.float16, 6e4)])
def test_actions_never_leave_the_bounds(dtype, scale, register):
    random = np.random.default_rng(0)
    low, high = np.sort(random.uniform(-scale, scale, (2, 300)).astype(dtype), axis=0)
    low[:2], high[:2] = (-1, 0.9 * scale), (0.2, scale)  # one rounding out, and an overflow of their sum
    space = gym.spaces.Box(low, high, dtype=dtype)
    policy = Policy(Config(actor_layers=()), gym.spaces.Box(-1, 1, (1,)), space)
    bounds = policy.low.clone()
    policy.load_state_dict(policy.state_dict() | {"low": torch.full((300,), -1e9)})  # the task's own bounds stay
    assert np.array_equal(space.low, low)
    policy.load_state_dict(policy.state_dict() | {"low": bounds})
    env = sac_minitaur.make_training_env(gym.spec(register(low=low, high=high, dtype=dtype)), False)
    env.reset()
    for sign in (-1, 1, 0.999, -1e-3):
        with torch.no_grad():
            policy.actor.net[0].weight.zero_()
            policy.actor.net[0].bias.fill_(np.arctanh(sign) if abs(sign) < 1 else 100 * sign)
        acted, forward = policy.act(np.zeros(1)), policy(torch.zeros(2, 1))[1].detach().numpy()
        received = env.action(np.full(300, sign, np.float32))  # what its step gives to the task
        env.step(np.full(300, sign, np.float32))  # which looks whether it is in its space
        assert acted in space and received in space
        assert (low <= forward).all() and (forward <= high).all()  # as policy.pt2 acts, in float32
        exact = low.astype(float) + (high.astype(float) - low) * (1 + sign) / 2
        tolerance = (1e-2 if dtype == np.float16 else 1e-5) * scale
        for actions in (acted, received, forward):
            np.testing.assert_allclose(actions, exact, rtol=0, atol=tolerance)
    assert env.action_space == gym.spaces.Box(-1, 1, (300,))


def test_a_task_without_a_time_limit_gets_one_and_says_so(tmp_path, capsys):
    task = {"env_id": f"{__name__}:Endless-v0"}
    assert common.find_task(Config(**task), gym.spaces.Box)[0].max_episode_steps == 10_000
    path, _ = train(tmp_path / "run", **SHORT, **task, max_episode_steps=7)
    assert "at most 7 steps (--max-episode-steps)" in capsys.readouterr().out
    assert {row["average_episode_length"] for row in read_csv(path / "eval.csv") + read_csv(path / "random.csv")} == {7}
    assert common.find_task(Config(env_id="Pendulum-v1"), gym.spaces.Box)[0].max_episode_steps == 200
    longer = Config(env_id="Pendulum-v1", max_episode_steps=300)
    assert common.find_task(longer, gym.spaces.Box)[0].max_episode_steps == 300


def test_a_task_that_wraps_another(register):
    """With a function, which gymnasium finds unequal to its like in the spec of an environment made before."""

    def make():
        space = gym.spaces.Box(-99, 99, (3,))
        return gym.wrappers.TransformObservation(gym.make("Pendulum-v1"), lambda o: 2 * o, space)

    task, observation_space, _ = common.find_task(Config(env_id=register(make, None)), gym.spaces.Box)
    assert task.max_episode_steps == 200 and observation_space.high[0] == 99  # the limit of the one that is wrapped
    with gym.make(task) as env:
        assert env.observation_space == observation_space


@pytest.mark.parametrize(
    "kind, scale, layout",
    [
        (np.uint8, 1 / 4, lambda array: array[::-1].copy()[::-1]),
        (np.int8, 200, lambda array: array.astype(">f4")),
        (np.float16, 1e5, np.longdouble),
        (np.float32, 1, list),
    ],
)
def test_observations_are_stored_as_they_are_returned(kind, scale, layout, monkeypatch, register, tmp_path):
    """In every layout, though the type of their space could not hold them."""
    right = Echo._observation
    monkeypatch.setattr(Echo, "_observation", lambda self: layout(scale * right(self)))
    path, _ = train(tmp_path / "run", **SHORT, env_id=register(observations=gym.spaces.Box(0, 9, (2,), kind)))
    rows = checkpoint(path)["ranks"][0]["buffer"]["rows"]
    assert rows[:, 0].unique().tolist() == [0, scale, 2 * scale, 3 * scale]


@pytest.mark.parametrize("draw", [np.random.rand, torch.rand])
def test_a_task_that_draws_from_a_librarys_own_generator_draws_anew_in_every_worker(draw, monkeypatch, tmp_path):
    monkeypatch.setattr(Echo, "_observation", lambda self: np.asarray(draw(2)))
    path, _ = train(tmp_path / "run", **SHORT, **IDS, num_envs=3)
    rows = checkpoint(path)["ranks"][0]["buffer"]["rows"]
    assert len(rows[:, 0].unique()) == len(rows)


@pytest.mark.parametrize("value", [np.nan, 1e39])  # which is too large for float32
@pytest.mark.filterwarnings("ignore:overflow:RuntimeWarning")
def test_a_task_that_returns_a_reward_that_is_not_finite(value, monkeypatch, tmp_path):
    step = Echo.step
    monkeypatch.setattr(Echo, "step", lambda *args: (step(*args)[0], value, False, False, {}))
    said = r"the task failed: it returned the reward (nan|1e\+39) .*: not all finite"
    with pytest.raises(common.TaskError, match=said):
        train(tmp_path / "run", **SHORT, **IDS)


SHAPE = "the task failed: it returned an observation of shape .* its space has "
FINITE = "the task failed: it returned the reward .*inf.*: not all finite"


@pytest.mark.filterwarnings("ignore:overflow:RuntimeWarning")
@pytest.mark.parametrize(
    "when, wrong, said",
    [
        (0, np.zeros(3), SHAPE),
        (3, np.float32(0), SHAPE),
        (3, np.zeros((1, 2)), SHAPE),
        (0, np.full(2, 1e39), FINITE),
        (3, np.full(2, np.inf), FINITE),
    ],
)
def test_a_task_that_returns_what_no_space_of_its_has(when, wrong, said, monkeypatch, tmp_path):
    right = Echo._observation
    monkeypatch.setattr(Echo, "_observation", lambda self: wrong if self.state[0] == when else right(self))
    with pytest.raises(common.TaskError, match=said):
        train(tmp_path / "run", **SHORT, **IDS)


@pytest.mark.parametrize("error", [ConnectionError, partial(TwoArguments, 7), SystemExit, Wordless])
@pytest.mark.parametrize("fails", ["reset", "step"])  # in an environment's worker, in an evaluation's
def test_an_error_of_the_task_is_shown_with_its_own_traceback(fails, error, register, tmp_path, capsys):
    with pytest.raises(common.TaskError) as caught:
        train(tmp_path / "run", **SHORT, env_id=register(fails=fails, error=partial(error, "no server")))
    text = str(caught.value)
    assert caught.value.__cause__ is None  # which would show it a second time
    assert "test_tasks.py" in text and f"in {fails}\n" in text and "died" not in text
    assert ("exception str() failed" if error is Wordless else "no server") in text
    assert ("Config(resume=" if fails == "step" else "there is no checkpoint yet") in capsys.readouterr().out


def test_the_first_line_of_an_error():
    noted, syntax = ValueError("\nno server\nat all"), SyntaxError("invalid", ("task.py", 1, 1, "a b"))
    noted.__notes__ = ["try again"]
    errors = noted, syntax, ValueError(), Wordless()
    assert [*map(common.first_line, errors)] == ["no server", "invalid (task.py, line 1)", "ValueError", "Wordless"]


def test_an_error_of_one_evaluation_episode_does_not_wait_for_the_others(monkeypatch, tmp_path):
    failing, slow = common.evaluation_seeds(Config(**TINY))
    reset = Echo.reset

    def reset_by_seed(self, *, seed=None, options=None):
        if seed == failing:
            raise ValueError("no server")
        if seed == slow:
            time.sleep(20)
            (tmp_path / "waited for").touch()
        return reset(self, seed=seed)

    monkeypatch.setattr(Echo, "reset", reset_by_seed)
    with pytest.raises(common.TaskError, match="no server"):
        train(tmp_path / "run", **SHORT, **IDS)
    assert not (tmp_path / "waited for").exists()


def test_ctrl_c_stops_the_run_and_nothing_that_its_task_has_started(script, tmp_path):
    """A terminal sends it to all. What the task starts is there until the task ends it, and does not outlive the run.

    It is in a worker, or with DQN in the training process.
    """
    task = f"{__name__}:Helped{'Box' if script == 'sac_minitaur' else 'Discrete'}-v0"
    more = ["--num-iterations", 10**6, "--max-episode-steps", 20, "--eval-interval", 10**6]
    run = Process(script, flags(script, tmp_path / "run", "--env-id", task, *more), tmp_path / "output")
    wait_until((tmp_path / "run" / "train.csv").exists)
    os.killpg(run.pid, signal.SIGINT)
    assert run.wait() == 0 and "stopped at step" in run.stdout, run.stderr
    assert run.stderr.count("stopping") == 1 and "Traceback" not in run.stderr


def test_a_task_that_is_made_of_another(register, tmp_path):
    """Once it has asked for the other one's spec, gymnasium takes that for its own."""

    def make():
        env = gym.make(IDS["env_id"])
        return gym.wrappers.TransformReward(env, lambda reward: reward + 100 * env.spec.max_episode_steps)

    path, _ = train(tmp_path / "run", **SHORT, env_id=register(make, limit=3))
    _, _, rewards, _, _ = checkpoint(path)["ranks"][0]["buffer"]["rows"].split((2, 1, 1, 1, 2), dim=1)
    assert rewards.unique().tolist() == [401, 402, 403]


def test_a_task_that_cannot_be_copied(register, tmp_path):
    """gymnasium then tells no spec. The time limit is the registered one."""
    path, _ = train(tmp_path / "run", **SHORT, env_id=register(partial(lambda lock: Echo(), threading.Lock()), limit=3))
    assert read_csv(path / "eval.csv")[-1]["average_episode_length"] == 3


def test_an_error_in_a_tasks_module_or_constructor_keeps_its_traceback(register, monkeypatch, tmp_path):
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "broken_module.py").write_text("1 / 0")
    with pytest.raises(ZeroDivisionError):
        main(monkeypatch, "--env-id", "broken_module:Task-v0")
    for make, error in ((lambda: [].pop(), IndexError), (lambda: open(tmp_path / "map"), FileNotFoundError)):
        with pytest.raises(error):
            main(monkeypatch, "--env-id", register(make))


@pytest.mark.parametrize(
    "entry_point, kwargs", [(f"{__name__}:Missing", {}), ("Echo", {}), (lambda: None, {}), (Echo, {"nothing": 1})]
)
def test_a_task_that_gymnasium_cannot_make(entry_point, kwargs, register, monkeypatch, capsys):
    assert main(monkeypatch, "--env-id", register(entry_point, **kwargs)) == 2
    message = capsys.readouterr().err
    assert message.startswith("error: --env-id Mine-v0 cannot be made: ") and message.count("\n") == 1


def test_train_leaves_the_process_as_it_was(monkeypatch, tmp_path):
    """A notebook's kernel draws with its own backend afterwards."""
    monkeypatch.setitem(sys.modules, "ipykernel", None)
    monkeypatch.setenv("MPLBACKEND", "agg")
    handler = signal.getsignal(signal.SIGINT)
    path, _ = train(tmp_path / "run", **SHORT, **IDS)
    assert signal.getsignal(signal.SIGINT) == handler and os.environ["MPLBACKEND"] == "agg"
    assert (path / "learning_curve.png").exists()


def test_train_in_a_thread(tmp_path):
    """It can be asked to stop in the main thread only."""
    thread = threading.Thread(target=train, args=(tmp_path / "run",), kwargs=SHORT | IDS)
    thread.start()
    thread.join()
    assert checkpoint(tmp_path / "run")["step"] == 20


def test_a_task_that_changes_the_directory(register, monkeypatch, tmp_path):
    """At its start and at every step. The run lies where the user asked, and the film."""

    def make(render_mode=None):
        os.chdir(tmp_path / "assets")
        env = gym.make("Pendulum-v1", render_mode=render_mode)
        return gym.wrappers.TransformReward(env, lambda reward: os.chdir(tmp_path / "assets") or reward)

    (tmp_path / "assets").mkdir()
    begin = common.Environments.__init__
    monkeypatch.setattr(common.Environments, "__init__", lambda *args, **_: begin(*args, in_workers=False))
    monkeypatch.chdir(tmp_path)
    sac_minitaur.train(Config(**TINY | SHORT | {"env_id": register(make, 20), "run_dir": "run", "video": True}))
    assert Path.cwd() == tmp_path / "assets"
    monkeypatch.chdir(tmp_path)
    assert main(monkeypatch, "--evaluate", "run/policy.pt") == 0
    files = {path.name for path in (tmp_path / "run").iterdir()}
    assert files > {"checkpoint.pt", "learning_curve.png", "policy.pt2", "trained_agent.mp4", "policy.mp4"}
    assert not any((tmp_path / "assets").iterdir())


def test_a_task_that_cannot_be_made_a_second_time(register, tmp_path):
    once = iter([Echo()])

    def make():
        for env in once:
            return env
        raise ConnectionError("no second server")

    with pytest.raises(common.TaskError, match="in make\n(.|\n)*no second server"):
        train(tmp_path / "run", **SHORT, env_id=register(make))


def test_a_config_takes_numpys_numbers_paths_and_lists(tmp_path, monkeypatch, capsys):
    choices = dict(critic_learning_rate=np.float64(1e-3), seed=np.int64(3), actor_layers=[16], num_envs=np.int32(1))
    config = Config(**TINY | SHORT | IDS | choices, run_dir=tmp_path / "run")
    path = sac_minitaur.train(config)
    assert main(monkeypatch, "--resume", path, "--num-iterations", 25) == 0
    assert checkpoint(path)["step"] == 25
    assert checkpoint(path)["config"]["seed"] == 3
    again = Config(**TINY | SHORT | IDS | choices | {"num_iterations": 30}, resume=str(path))
    assert sac_minitaur.train(again) == path and checkpoint(path)["step"] == 30
    again = Config(resume=str(path), num_iterations=35)  # the rest is the run's
    assert sac_minitaur.train(again) == path and checkpoint(path)["step"] == 35


@pytest.mark.parametrize("change", [{"length": 5}, {"error_of_rewards": 1e-3}, {"error_of_observations": 1e-3}])
def test_an_episode_that_cannot_be_played_again_on_resume(change, monkeypatch, tmp_path, capsys):
    """The user is told."""
    choices = SHORT | dict(env_id=f"{__name__}:Unrepeatable-v0", replay_buffer_capacity=200)
    train(tmp_path / "run", **choices)
    assert "warning" not in capsys.readouterr().out
    for name, value in change.items():
        monkeypatch.setattr(Unrepeatable, name, value)
    train(tmp_path / "run", **choices | {"num_iterations": 40}, run_dir=None, resume=str(tmp_path / "run"))
    assert "warning: an episode went differently" in capsys.readouterr().out
    rows = checkpoint(tmp_path / "run")["ranks"][0]["buffer"]["rows"]
    assert len(rows) == 40 + 40 and (rows[:, 5] > rows[:, 0]).all()  # no row leads from one episode into another


@pytest.mark.parametrize("env_id", [IDS["env_id"], "MinitaurBulletEnv-v0"])
@pytest.mark.parametrize("fault", [{"actor_learning_rate": 1e30}, {"critic_learning_rate": 1e30, "eval_interval": 1}])
def test_a_diverged_actor_ends_the_run_in_one_line(env_id, fault, tmp_path):
    if env_id == "MinitaurBulletEnv-v0":
        pytest.importorskip("pybullet")
    choices = SHORT | {"num_iterations": 200, "log_interval": 1000, "max_episode_steps": 20} | fault
    with pytest.raises(common.RunError, match="the actor's actions are not finite") as caught:
        train(tmp_path / "run", **choices, env_id=env_id)
    assert len(str(caught.value).splitlines()) == 1


def test_a_task_that_only_the_main_program_knows(tmp_path):
    """Where workers are not forked, as in a notebook on a Mac: with entry points that only cloudpickle takes."""
    (tmp_path / "program.py").write_text(f"""
import gymnasium as gym
import common, sac_minitaur
if __name__ == "__main__":
    from gymnasium.envs.classic_control import PendulumEnv
    common.START_METHOD = "spawn"
    gym.register("Base-v0", entry_point=lambda render_mode=None: PendulumEnv(render_mode))
    gym.register("Mine-v0", entry_point=lambda **kwargs: gym.make("Base-v0", **kwargs), max_episode_steps=5)
    choices = {TINY | SHORT} | dict(env_id="Mine-v0", num_eval_episodes=1, run_dir="run", video=True)
    print(sac_minitaur.train(sac_minitaur.Config(**choices)))
""")
    paths = {"PYTHONPATH": str(Path(common.__file__).parent), "PATH": "", "SDL_VIDEODRIVER": "dummy"}
    command = [sys.executable, "program.py"]
    process = subprocess.run(command, cwd=tmp_path, env=paths, capture_output=True, text=True)
    assert process.returncode == 0 and process.stdout.splitlines()[-1] == "run", process.stderr
    assert (tmp_path / "run" / "trained_agent.mp4").exists(), process.stdout
