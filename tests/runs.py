"""Runs of the two scripts in processes of their own, to be killed and looked at.

Importing everything takes seconds, so a server process does it once and forks itself for every run. A run is a session
of its own (setsid), so that whatever outlives it can be found. A hook is a function of a test module that is called
with the script's module in the new process, before its `main`.
"""

import atexit
import csv
import importlib
import os
import pickle
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from unittest import mock

ROOT = Path(__file__).parent.parent
SCRIPTS = ("sac_minitaur", "dqn_cartpole")
AGENTS = {"sac_minitaur": "SACAgent", "dqn_cartpole": "DQNAgent"}
# Short episodes: a checkpoint must let one end.
TINY = {
    "sac_minitaur": "--num-envs 1 --env-id Pendulum-v1 --max-episode-steps 30 --actor-layers 32 32 --critic-layers 32 32",
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

    server = None

    def __init__(self, script, arguments, output, hook=None, **environ):
        if Process.server is None:
            environ_of_server = os.environ | {"CUDA_VISIBLE_DEVICES": ""}
            pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
            Process.server = subprocess.Popen([sys.executable, __file__], cwd=ROOT, env=environ_of_server, **pipes)
            atexit.register(Process.server.wait)
            atexit.register(Process.server.stdin.close)  # called first: it ends the server
        self.output = Path(output)
        self.output.mkdir(parents=True)
        self.status = None
        self.pid = self._ask("start", (script, list(map(str, arguments)), str(output), pickle.dumps(hook), environ))

    def _ask(self, *request):
        pickle.dump(request, self.server.stdin)
        self.server.stdin.flush()
        return pickle.load(self.server.stdout)

    def poll(self):
        if self.status is None:
            self.status = self._ask("poll", self.pid)
        return self.status

    def wait(self, seconds=600):
        """The exit status, negative for a signal, once the process and all that it started are gone."""
        try:
            wait_until(lambda: self.poll() is not None, seconds)
            wait_until(lambda: not session(self.pid), seconds=60)
        finally:
            for pid in session(self.pid):
                os.kill(pid, signal.SIGKILL)
        return self.status

    def kill(self, number=signal.SIGKILL):
        os.kill(self.pid, number)

    @property
    def stdout(self):
        return (self.output / "stdout").read_text()

    @property
    def stderr(self):
        return (self.output / "stderr").read_text()


def finish(script, arguments, output, hook=None):
    run = Process(script, arguments, output, hook)
    assert run.wait() == 0, run.stderr
    return run


def read_command_line(script, *arguments):
    """What these arguments of the script ask for: config, directory to resume, policy to evaluate."""
    import common

    module = importlib.import_module(script)
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


def start_ranks(world_size, script, arguments, output, hook=None):
    """The processes of a distributed run, as torchrun would start them but without its watch over them."""
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        environ = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(listener.getsockname()[1])}
    ranks = []
    for rank in map(str, range(world_size)):
        environ |= {"RANK": rank, "LOCAL_RANK": rank, "WORLD_SIZE": str(world_size)}
        ranks.append(Process(script, arguments, Path(output) / rank, hook, **environ))
    return ranks


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
    import torch

    return torch.load(run_dir / "checkpoint.pt", weights_only=True)


def load_policy(path):
    """The policy that `--evaluate` reads from this file."""
    import gymnasium as gym
    import torch

    file = torch.load(path, weights_only=True)
    module = importlib.import_module(file["script"])
    config = module.Config(**file["config"])
    with gym.make(config.env_id) as env:
        policy = module.Policy(config, env.observation_space, env.action_space)
    policy.load_state_dict(file["weights"])
    return policy


def assert_same(a, b, where="checkpoint"):
    """Fails unless two nested states are equal to the last bit (nan equals nan)."""
    import torch

    assert type(a) is type(b), where
    if isinstance(a, dict):
        assert list(a) == list(b), where
        for key in a:
            assert_same(a[key], b[key], f"{where}.{key}")
    elif isinstance(a, (list, tuple)):
        assert len(a) == len(b), where
        for i, pair in enumerate(zip(a, b)):
            assert_same(*pair, f"{where}[{i}]")
    elif isinstance(a, torch.Tensor):
        assert a.dtype == b.dtype and torch.equal(a, b), where
    else:
        assert a == b or (a != a and b != b), where


def assert_same_run(run_dir, reference):
    """Fails unless two runs have the same tables, checkpoint and policies, but for times."""
    import torch

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


def before_call(owner, name, count, action):
    """Replaces a function by one that calls `action()` before its call number `count`."""
    function, calls = getattr(owner, name), iter(range(1, 10**9))

    def counted(*args, **kwargs):
        if next(calls) == count:
            action()
        return function(*args, **kwargs)

    setattr(owner, name, counted)


def before_update(module, count, action):
    before_call(getattr(module, AGENTS[module.__name__]), "update", count, action)


def _serve():
    """Forks a run whenever it is asked to, and tells how one ended."""
    requests, replies = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    sys.path.insert(0, str(ROOT))
    import matplotlib.figure  # noqa: F401
    from torch.utils.tensorboard import SummaryWriter  # noqa: F401

    for script in SCRIPTS:
        read_command_line(script)
    while True:
        try:
            request, argument = pickle.load(requests)
        except EOFError:
            return
        if request == "start":
            reply = os.fork()
            if reply == 0:
                requests.close()
                replies.close()
                return _run(*argument)
        else:
            pid, status = os.waitpid(argument, os.WNOHANG)
            reply = os.waitstatus_to_exitcode(status) if pid else None
        pickle.dump(reply, replies)
        replies.flush()


def _run(script, arguments, output, hook, environ):
    os.setsid()
    signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored in what a shell started in the background
    for descriptor, name in ((1, "stdout"), (2, "stderr")):
        os.dup2(os.open(f"{output}/{name}", os.O_WRONLY | os.O_CREAT | os.O_APPEND), descriptor)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    os.environ.update(environ)
    import common

    module = sys.modules[script]
    sys.argv = [f"{script}.py", *arguments]
    if hook := pickle.loads(hook):
        hook(module)
    common.run_main(module.main)


if __name__ == "__main__":
    _serve()
