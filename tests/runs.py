"""Runs of the two scripts in processes of their own, to be killed and looked at.

Importing everything takes seconds, so Python's fork server does it once, and every run is a fork of it. A run is a
session of its own (setsid), so that whatever outlives it can be found. A hook is a function of a test module that is
called with the script's module in the new process, before its `main`.
"""

import csv
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from unittest import mock

import gymnasium as gym
import torch

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT))

import common  # noqa: E402
import dqn_cartpole  # noqa: E402
import sac_minitaur  # noqa: E402

MODULES = {"sac_minitaur": sac_minitaur, "dqn_cartpole": dqn_cartpole}
AGENTS = {"sac_minitaur": sac_minitaur.SACAgent, "dqn_cartpole": dqn_cartpole.DQNAgent}
# Short episodes: a checkpoint must let one end.
TINY = {
    "sac_minitaur": (
        "--env-id Pendulum-v1 --num-envs 2 --max-episode-steps 30 --actor-layers 32 32 --critic-layers 32 32"
    ),
    "dqn_cartpole": "--max-episode-steps 40 --layers 32",
}
COMMON = (
    "--device cpu --no-video --num-iterations 300 --initial-collect-steps 96 --batch-size 24 "
    "--replay-buffer-capacity 250 --log-interval 20 --eval-interval 100 --num-eval-episodes 2 --checkpoint-interval 50"
)


def flags(script, run_dir, *more):
    """The command line of a tiny run. Its replay wraps around, and its checkpoints cut episodes."""
    return [*TINY[script].split(), *COMMON.split(), "--run-dir", str(run_dir), *map(str, more)]


class Process:
    """One run, started at once; `output` is a new directory for what it prints."""

    def __init__(self, script, arguments, output, hook=None, **environ):
        self.output = Path(output)
        self.output.mkdir(parents=True)
        command_line = [f"{script}.py", *map(str, arguments)]
        context = multiprocessing.get_context("forkserver")
        context.set_forkserver_preload([*MODULES, "pytest", "matplotlib.figure", "torch.utils.tensorboard"])
        self.process = context.Process(target=run, args=(script, command_line, output, hook, environ))
        self.process.start()
        self.pid = self.process.pid

    def wait(self, seconds=600):
        """The exit status, negative for a signal, once the process and all that it started are gone."""
        try:
            self.process.join(seconds)
            wait_until(lambda: not session(self.pid), seconds=60)
        finally:
            for pid in session(self.pid):
                os.kill(pid, signal.SIGKILL)
        return self.process.exitcode

    @property
    def stdout(self):
        return (self.output / "stdout").read_text()

    @property
    def stderr(self):
        return (self.output / "stderr").read_text()


def run(script, command_line, output, hook, environ):
    """What the new process does."""
    os.setsid()
    signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored in what a shell started in the background
    for descriptor, name in ((1, "stdout"), (2, "stderr")):
        os.dup2(os.open(f"{output}/{name}", os.O_WRONLY | os.O_CREAT | os.O_APPEND), descriptor)
    os.environ.update(environ, CUDA_VISIBLE_DEVICES="")
    sys.argv = command_line
    module = MODULES[script]
    if hook:
        hook(module)
    common.run_main(module.main)


def read_command_line(script, *arguments):
    """What these arguments of the script ask for: config, directory to resume, policy to evaluate."""
    module = MODULES[script]
    with mock.patch.object(sys, "argv", [f"{script}.py", *map(str, arguments)]):
        return common.read_command_line(script, module.Config, module.TUTORIAL, "")


def wait_until(condition, seconds=600):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.05)


def session(leader):
    """The processes of a session that live, as pids."""
    pids = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, _, _, leader_of_this = path.read_text().rpartition(")")[2].split()[:4]
        except OSError:
            continue
        if int(leader_of_this) == leader and state not in "ZX":
            pids.append(int(path.parent.name))
    return pids


def run_python(directory, *arguments):
    """Runs a new interpreter in a directory, whose modules it finds beside this project's. It prints ASCII alone."""
    path = os.pathsep.join((str(ROOT), str(directory)))
    environment = os.environ | {"PYTHONPATH": path, "PYTHONIOENCODING": "ascii", "CUDA_VISIBLE_DEVICES": ""}
    command = [sys.executable, *map(str, arguments)]
    process = subprocess.run(command, cwd=directory, env=environment, capture_output=True, text=True, check=False)
    assert process.returncode == 0, process.stderr
    return process


def rows(path):
    """A CSV's rows without times, as text, after a check that all its lines are whole."""
    text = path.read_text()
    assert text.endswith("\n")
    lines = list(csv.reader(text.splitlines()))
    assert len(set(map(len, lines))) == 1
    keep = [i for i, name in enumerate(lines[0]) if name not in ("seconds", "steps_per_second")]
    return [[line[i] for i in keep] for line in lines]


def read_csv(path):
    """A CSV's rows as dicts of numbers."""
    with open(path) as file:
        return [{name: float(value) for name, value in row.items()} for row in csv.DictReader(file)]


def checkpoint(run_dir):
    return torch.load(run_dir / "checkpoint.pt", weights_only=True)


def load_policy(path):
    """The policy that `--evaluate` reads from this file."""
    file = torch.load(path, weights_only=True)
    module = MODULES[file["script"]]
    config = module.Config(**file["config"])
    with gym.make(config.env_id) as env:
        policy = module.Policy(config, env.observation_space, env.action_space)
    policy.load_state_dict(file["weights"])
    return policy


def assert_same(a, b, where="checkpoint"):
    """Fails unless two nested states are equal to the last bit (nan equals nan)."""
    assert type(a) is type(b), where
    if isinstance(a, (list, tuple)):
        a, b = dict(enumerate(a)), dict(enumerate(b))
    if isinstance(a, dict):
        assert list(a) == list(b), where
        for key in a:
            assert_same(a[key], b[key], f"{where}.{key}")
    elif isinstance(a, torch.Tensor):
        assert a.dtype == b.dtype and torch.equal(a, b), where
    else:
        assert repr(a) == repr(b), where


def assert_same_run(run_dir, reference):
    """Fails unless two runs have the same tables, checkpoint and policies, but for times."""
    for name in ("train.csv", "eval.csv", "random.csv"):
        assert rows(run_dir / name) == rows(reference / name), name
    for name in ("checkpoint.pt", "policy.pt", "best_policy.pt"):
        mine, other = (torch.load(path / name, weights_only=True) for path in (run_dir, reference))
        for state in (mine, other):  # of which the tables were compared above, without times
            for key in ("config", "seconds", "tables"):
                state.pop(key, None)
        assert_same(mine, other, name)


def die():
    os.kill(os.getpid(), signal.SIGKILL)


def interrupt():
    signal.raise_signal(signal.SIGINT)


def terminate():
    signal.raise_signal(signal.SIGTERM)


def before_call(owner, name, count, action, module=None):
    """Replaces a function by one that calls `action()` before its call number `count`.

    `partial(before_call, owner, name, count, action)` is a hook.
    """
    function = getattr(owner, name)
    calls = iter(range(1, 10**9))

    def counted(*args, **kwargs):
        if next(calls) == count:
            action()
        return function(*args, **kwargs)

    setattr(owner, name, counted)
