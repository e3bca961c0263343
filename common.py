"""What both training scripts need besides their algorithms.

The command line, devices and processes, tasks and their workers, and the run directory with its tables, checkpoints,
policies, curve and videos. No network, loss or replay buffer is defined here.
"""

import argparse
import atexit
import contextlib
import copy
import csv
import ctypes
import errno
import gc
import io
import math
import multiprocessing
import os
import pickle
import shlex
import signal
import sys
import tempfile
import threading
import time
import traceback
import warnings
import zipfile
import zlib
from concurrent import futures
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Annotated

import cloudpickle
import gymnasium as gym
import numpy as np
import torch
import torch.distributed as dist
import tyro
from pydantic import ConfigDict, Field
from pydantic_core import ArgsKwargs, to_json, to_jsonable_python
from tqdm import tqdm

FILE_FORMAT = 3  # of checkpoints and policies
# Forked workers start quickly and share the libraries' memory. They use no GPU and one thread, so a fork is safe.
START_METHOD = "fork" if sys.platform == "linux" else "spawn"
STOP_SIGNALS = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
MAY_DIFFER_ON_RESUME = {"num_iterations", "video", "checkpoint_interval", "device", "num_threads", "cuda_graph"}


class InputError(Exception):
    """Something the user gave cannot be used."""


class RunError(Exception):
    """Something failed while running: a full disk, a dead worker, a loss that is not finite."""


class TaskError(Exception):
    """The task's own code failed, perhaps in a worker. The message ends with its traceback."""


def run_main(main):
    """Calls `main`. The errors above become their message on stderr and the exit status 2 (`InputError`) or 1."""
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="replace")  # a console without an α shows a question mark
    os.environ.setdefault("PYDANTIC_ERRORS_INCLUDE_URL", "0")  # a message says enough
    # TensorBoard's thread would print a traceback about a full disk, which the main thread reports anyway.
    hook = threading.excepthook
    threading.excepthook = lambda args: "tensorboard" in type(args.thread).__module__ or hook(args)
    atexit.register(gc.freeze)  # or Python would search all that was imported for garbage before it ends: a second
    try:
        return main()
    except (InputError, RunError, TaskError) as error:
        if os.environ.get("RANK", "0") != "0":
            time.sleep(1)  # rank 0 mostly fails alike, and torchrun then ends this process: one message is printed
        print(f"error: {error}", file=sys.stderr, flush=True)
        status = 2 if isinstance(error, InputError) else 1
    except KeyboardInterrupt:
        status = 130
    except BrokenPipeError:  # `--help | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # Python flushes it at the end
        status = 1
    if dist.is_initialized():
        os._exit(status)  # the others are not waited for: they may be gone
    sys.exit(status)


def first_line(error):
    text = ""
    with contextlib.suppress(Exception):  # a task's own error may fail to tell
        text = str(error).strip()
    return (text or type(error).__name__).splitlines()[0][:200]


CONFIG = ConfigDict(extra="forbid", allow_inf_nan=False, hide_input_in_errors=True)
Fraction = Annotated[float, Field(ge=0, le=1)]
Below1 = Annotated[float, Field(ge=0, lt=1)]
Seed = Annotated[int, Field(ge=0, lt=2**63)]
Device = Annotated[str, Field(pattern=r"^(auto|cpu|mps|cuda(:[1-9]?\d)?)$")]
Parallel = Annotated[int, Field(ge=1, le=1024)]  # environments, threads
Layers = tuple[Annotated[int, Field(ge=1, le=10_000)], ...]


def complete_config(given, config_class, tutorial, script):
    """Completes what `Config` is given: from the run to resume, the policy to evaluate, or with `tutorial=True` from
    `tutorial`. Raises InputError when a file is no good."""
    names = config_class.__dataclass_fields__.keys()
    values = dict(zip(names, given.args or ())) | (given.kwargs or {})
    defaults = tutorial if values.get("tutorial") else {}
    if run := values.get("resume"):
        defaults = read_file(Path(run, "checkpoint.pt"), "checkpoint", script)["config"]
        if others := (defaults.keys() ^ names) - MAY_DIFFER_ON_RESUME:
            raise InputError(f"{run} is of another version of this script: it differs in {min(others)}")
    elif policy := values.get("evaluate"):  # one of another version may have more fields, or fewer
        defaults = read_file(Path(policy), "policy", script)["config"] | {"video": True}
        defaults = {name: defaults[name] for name in names & defaults}
    return ArgsKwargs((), defaults | values)


def read_command_line(config_class, description):
    """The config that the command line asks for. Where a flag is not given, `complete_config` has the value."""
    sources = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    for flag in ("--resume", "--evaluate"):
        sources.add_argument(flag, type=Path, nargs="?")
    sources.add_argument("--tutorial", action=argparse.BooleanOptionalAction)
    given = {name: value for name, value in vars(sources.parse_known_args()[0]).items() if value}
    if given.keys() >= {"resume", "evaluate"}:
        raise InputError("--resume continues training, --evaluate plays a saved policy: give one of them")
    try:
        default = config_class(**given)
    except ValueError as error:
        what = " ".join(str(error).split())
        raise InputError(f"{given.get('resume', given.get('evaluate'))} has a config that is no good: {what}") from None
    return tyro.cli(config_class, description=description, default=default)


def plain_config(config):
    """The config as a dict of numbers, strings and lists, without the paths of this very run."""
    return to_jsonable_python(vars(config) | {"run_dir": None, "resume": None, "evaluate": None})


def select_device(name, local_rank=0):
    """The `torch.device` for --device: `auto` is CUDA or else the CPU, `cuda` is GPU number `local_rank`.

    Raises InputError for a device that is not there.
    """
    gpus = torch.cuda.device_count()
    if name == "auto":
        name = "cuda" if gpus else "cpu"
    device = torch.device(f"cuda:{local_rank}" if name == "cuda" else name)
    if device.type == "mps" and not torch.backends.mps.is_available() or device.type == "cuda" and device.index >= gpus:
        raise InputError(f"--device {device} is not there (CUDA GPUs found: {gpus}): use --device cpu")
    return device


def keep_freed_memory():
    """Tells glibc to keep what is freed. Otherwise every update would map its tensors in afresh, page by page."""
    with contextlib.suppress(OSError, AttributeError):  # no glibc
        libc = ctypes.CDLL("libc.so.6")
        libc.mallopt(-3, 32 << 20)  # M_MMAP_THRESHOLD, the most that glibc before 2.35 takes
        libc.mallopt(-1, 256 << 20)  # M_TRIM_THRESHOLD


def empty_replay(capacity, columns, device):
    """An uninitialized float32 tensor (capacity, columns). Raises InputError when that memory is refused."""
    try:
        return torch.empty(capacity, columns, device=device)
    except (RuntimeError, TypeError):  # the latter for a number beyond 64 bits
        size = f"{capacity * columns * 4 / 1e9:.1f} GB"
        raise InputError(f"--replay-buffer-capacity {capacity} takes {size}, more than is free: use less") from None


def derive_seed(*key):
    """A 32-bit seed from integers: (seed, env index, episode number) for an episode, (seed, rank) for a process."""
    return int(np.random.SeedSequence(key).generate_state(1)[0])


def evaluation_seeds(config):
    """The seeds of the episodes that every evaluation plays. No training environment has the number 2**32 - 1."""
    return [derive_seed(config.seed, 2**32 - 1, i) for i in range(config.num_eval_episodes)]


class Ranks:
    """This process among those that torchrun started. Without torchrun it is rank 0 of 1 and talks to nobody."""

    def __init__(self):
        """Joins the processes that torchrun's variables describe. Raises InputError when these are no good."""
        self.rank, self.world_size, self.local_rank = 0, 1, 0
        if "RANK" in os.environ and os.environ.get("WORLD_SIZE") != "1":
            try:
                self.local_rank = int(os.environ["LOCAL_RANK"])
                if not dist.is_initialized():
                    dist.init_process_group("cpu:gloo,cuda:nccl" if torch.cuda.is_available() else "gloo")
                    atexit.register(dist.destroy_process_group)  # NCCL warns without it
            except (KeyError, ValueError, dist.DistError) as error:
                what = f"RANK is set but the processes cannot join: {first_line(error)}"
                raise InputError(f"{what}; start them with torchrun, or unset RANK") from None
            self.rank, self.world_size = dist.get_rank(), dist.get_world_size()

    def average(self, tensors):
        """Replaces each tensor by its mean over the ranks, in one collective for all of them."""
        if self.world_size > 1:
            tensors = list(tensors)
            dist.all_reduce(flat := torch.cat([tensor.flatten() for tensor in tensors]))
            for tensor, total in zip(tensors, flat.split([tensor.numel() for tensor in tensors])):
                tensor.copy_(total.view_as(tensor) / self.world_size)


def find_task(config, action_space):
    """The gymnasium spec of --env-id, with a time limit for evaluations to end, and its observation and action spaces.

    An error of the task's own code is raised as it is. Raises InputError when the task is unknown or has not the kind
    of `action_space` that the algorithm needs, `gym.spaces.Discrete` or `Box`.
    """
    name = f"--env-id {config.env_id}"
    if config.env_id.count(":") > 1 or config.env_id.startswith((".", ":")):
        raise InputError(f"{name} is not the id of a task, as CartPole-v1 and my_module:MyTask-v0 are")
    try:
        with contextlib.ExitStack() as stack:
            stack.callback(os.chdir, os.getcwd())  # a simulator may go to its own files
            env = stack.enter_context(gym.make(config.env_id, max_episode_steps=config.max_episode_steps))
            observations, actions = env.observation_space, env.action_space
            # The registered spec, not env.spec. That has the task's wrappers, which gymnasium cannot always compare to
            # new ones. It may be None, or that of a task which this one is made of, whose time limit then counts.
            task = copy.copy(gym.registry[env.unwrapped.spec.id])
            task.max_episode_steps = config.max_episode_steps or (env.spec or task).max_episode_steps or 10_000
    except Exception as error:
        frames = traceback.extract_tb(error.__traceback__)[1:]
        in_task = any(not frame.filename.startswith(gym.__path__[0] + os.sep) for frame in frames)
        if in_task and not isinstance(error, (gym.error.Error, ImportError)):
            raise  # with its traceback. What gymnasium itself raises, as for a misspelt entry point, is one line.
        raise InputError(f"{name} cannot be made: {first_line(error)}") from None
    if not isinstance(observations, gym.spaces.Box) or not observations.shape or 0 in observations.shape:
        raise InputError(f"{name} has the observation space {observations}: a Box of some dimension is needed")
    if action_space is gym.spaces.Discrete:
        needed, fits = "Discrete from 0", isinstance(actions, action_space) and actions.start == 0
    else:
        needed = "Box of some dimension, of floats with finite bounds, low < high,"
        fits = isinstance(actions, action_space) and actions.dtype in (np.float16, np.float32, np.float64)
        if fits:  # in float32, as the agent computes
            widths = torch.tensor(actions.high).float() - torch.tensor(actions.low).float()
            fits = actions.shape and widths.numel() and (widths.isfinite() & (widths > 0)).all()
    if not fits:
        raise InputError(f"{name} has the action space {actions}: a {needed} is needed")
    return task, observations, actions


@contextlib.contextmanager
def telling_task_errors(what="the task"):
    """Turns an exception of the task into a `TaskError`, which a running worker can always send to the main process."""
    try:
        yield
    except RunError:
        raise
    except (Exception, SystemExit) as error:
        raise TaskError(f"{what} failed: {first_line(error)}\n{traceback.format_exc()}") from None


def around_fork(moment):
    """A process that a task forks ignores Ctrl-C. Other signals end it. During the fork they wait, so none is lost."""
    handled = [number for number in STOP_SIGNALS if getattr(signal.getsignal(number), "__module__", None) == __name__]
    if moment == "after_in_child":
        for number in handled:
            signal.signal(number, signal.SIG_IGN if number == signal.SIGINT else signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_BLOCK if moment == "before" else signal.SIG_UNBLOCK, handled)


for moment in ("before", "after_in_parent", "after_in_child"):
    if hasattr(os, "register_at_fork"):
        os.register_at_fork(**{moment: partial(around_fork, moment)})


def start_worker(registry, task=None):
    """Prepares a worker. It ends with the main process and leaves signals to it. Evaluations play `task` in it."""
    gym.registry.update(registry)  # the main process's: a task may be made of others
    start_worker.task = task
    torch.set_num_threads(1)
    np.random.seed()  # a task may use these generators: forked, all workers would draw the same
    torch.seed()
    for number in STOP_SIGNALS:
        # A program that the task starts ignores Ctrl-C, too. Other signals end it: handlers are not inherited.
        signal.signal(number, signal.SIG_IGN if number == signal.SIGINT else lambda *_: None)
    threading.Thread(target=lambda: (multiprocessing.parent_process().join(), os._exit(1)), daemon=True).start()


class SeededEpisodes(gym.Wrapper):
    """Flat float32 observations of a task. Every episode has a seed of its own, and can be begun in its middle.

    No simulator can be saved in mid-episode. But an episode follows from its seed and its actions: played again from
    the reset, it comes to the same state to the last bit. Arrays are copied: a task may change what it gave or got.
    """

    def __init__(self, registry, make_env, key, episode, actions):
        if os.getpid() != Run.training_process:  # in a worker
            start_worker(registry)
        with telling_task_errors():
            super().__init__(make_env())
        self.key, self.episode, self.actions = key, episode, list(np.asarray(actions))
        # Not the type of the task's own space: a task may return numbers that this type would cut.
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (math.prod(self.env.observation_space.shape),))

    def reset(self, **_):
        replay, self.actions, self.total = self.actions, [], 0.0
        with telling_task_errors():
            observation, _ = self.env.reset(seed=derive_seed(*self.key, self.episode))
            observation, _ = self._checked(observation, reward=0.0)
        for action in replay:
            observation, _, terminated, truncated, _ = self.step(action)
            if terminated or truncated:
                return self.reset()  # the task went differently and ended: begin a new episode
        return observation, {}

    def step(self, action):
        with telling_task_errors():
            observation, reward, terminated, truncated, _ = self.env.step(copy.copy(action))
            observation, reward = self._checked(observation, reward)
        self.actions.append(np.array(action))
        self.total += reward
        info = {}
        if terminated or truncated:
            info = {"return and length": (self.total, len(self.actions))}
            self.episode, self.actions = self.episode + 1, []
        return observation, reward, bool(terminated), bool(truncated), info

    def _checked(self, observation, reward):
        """A flat copy of the observation, if it has its space's shape, and the reward: both are finite in float32."""
        reward, flat, shape = float(reward), np.array(observation, np.float32), self.env.observation_space.shape
        if flat.shape != shape:
            raise ValueError(f"it returned an observation of shape {flat.shape}, but its space has {shape}")
        if not (np.isfinite(np.float32(reward)) and np.isfinite(flat).all()):
            raise ValueError(f"it returned the reward {reward} and the observation {flat}: not all finite")
        return flat.ravel(), reward


class Environments:
    """K environments of one task, stepped together; `observations` (K, O), flat, are those to act on (SAC: (K, S)).

    `steps` counts the steps of all, over all processes. With `in_workers` each environment has a process of its own.
    """

    def __init__(self, make_env, run, in_workers):
        seed, num_envs, rank = run.config.seed, run.config.num_envs, run.ranks.rank
        saved = run.checkpoint["ranks"][rank]["environments"] if run.checkpoint else {}
        self.in_workers = in_workers
        self.steps, self.steps_at_once = run.checkpoint.get("env_steps", 0), num_envs * run.ranks.world_size
        self.finished = saved.get("finished", [])  # returns and lengths of the last 10 episodes that ended
        # gymnasium would show a task's error once more for each process.
        warnings.filterwarnings("ignore", module="gymnasium.vector.async_vector_env")
        episodes = enumerate(saved.get("episodes", [(0, [])] * num_envs), rank * num_envs)
        makers = [partial(SeededEpisodes, gym.registry, make_env, (seed, i), *episode) for i, episode in episodes]
        workers = partial(gym.vector.AsyncVectorEnv, context=START_METHOD, daemon=False)  # daemons start no processes
        kind = workers if in_workers else gym.vector.SyncVectorEnv
        with run.killed_at_the_end(), contextlib.ExitStack() as making:
            if not in_workers and threading.current_thread() is threading.main_thread():
                # What the task's constructor starts in this process ignores Ctrl-C.
                making.callback(signal.signal, signal.SIGINT, signal.signal(signal.SIGINT, signal.SIG_IGN))
            self.vector = kind(makers, autoreset_mode=gym.vector.AutoresetMode.SAME_STEP)
        run.stack.callback(self._end_workers if in_workers else self.vector.close)
        self.observations, _ = self.vector.reset()  # brings each to where its episode stands
        if saved.get("fingerprint") not in (None, self._fingerprint()):
            say("warning: an episode went differently when it was played again: this resume is not exact")

    def step_async(self, actions):
        """Takes actions (K, …). Workers begin the step at once; without them `step_wait` does it."""
        self.actions = actions
        self.steps += self.steps_at_once
        if self.in_workers:
            self.vector.step_async(actions)

    def step_wait(self):
        """The transitions of that step: observations (K, O), actions (K, …), rewards (K,), terminated (K,), next
        observations (K, O). If an episode ended, its last one: `self.observations` has the next episode's first."""
        step = self.vector.step_wait() if self.in_workers else self.vector.step(self.actions)
        next_observations, rewards, terminated, truncated, infos = step
        observations, self.observations = self.observations, next_observations.copy()
        for i in np.flatnonzero(terminated | truncated):
            next_observations[i] = infos["final_obs"][i]
            self.finished = [*self.finished, infos["final_info"]["return and length"][i]][-10:]
        return observations, self.actions, rewards, terminated, next_observations

    def state_dict(self):
        actions = [torch.from_numpy(np.array(each)) for each in self.vector.get_attr("actions")]
        episodes = list(zip(self.vector.get_attr("episode"), actions))
        return {"episodes": episodes, "finished": self.finished, "fingerprint": self._fingerprint()}

    def _fingerprint(self):
        """Tells where the running episodes stand: a checksum of their last observations and returns so far."""
        return zlib.crc32(np.array(self.vector.get_attr("total")), zlib.crc32(self.observations))

    def _end_workers(self):
        for pipe in self.vector.parent_pipes:
            with contextlib.suppress(OSError, AttributeError):  # its worker has died
                pipe.send(("close", None))  # the task may have to end what it has started
        self.vector.closed = True  # nothing is left for gymnasium to do
        deadline = time.perf_counter() + 10  # for all together: a simulator may take seconds to end
        for process in self.vector.processes:
            process.join(max(0, deadline - time.perf_counter()))


def write_atomically(path, write):
    """Lets `write(file)` fill a temporary file, then renames it to `path`: a kill leaves the old file or the new one.

    Raises OSError, leaving the old file whole, when the disk is full or not writable.
    """
    temporary = path.with_name(f".tmp-{os.getpid()}-{path.name}")
    try:
        with open(temporary, "wb") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except RuntimeError as error:  # torch.save's, which hides an OSError
        raise error.__context__ or error
    finally:
        temporary.unlink(missing_ok=True)


def read_file(path, kind, script):
    """Reads a "checkpoint" or "policy" that a `Run` of this script wrote, onto the CPU. Nothing in it is executed.

    Raises InputError when it is missing, damaged or foreign.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            if damaged := archive.testzip():  # torch.load does not look at the checksums
                raise ValueError(f"{damaged} is damaged")
        state = torch.load(path, map_location="cpu", weights_only=True)
        found = "a {kind} of {script}, format {format}".format_map(state)
    except Exception as error:  # whatever a missing, damaged or hostile file provokes
        missing = isinstance(error, FileNotFoundError)
        what = "does not exist" if missing else f"is not a whole {kind} of this project ({first_line(error)})"
        raise InputError(f"{path} {what}: --resume takes a run's directory, --evaluate its policy.pt") from None
    if found != (needed := f"a {kind} of {script}, format {FILE_FORMAT}"):
        raise InputError(f"{path} is {found}; needed: {needed}")
    return state


def export_policy(path, policy, observation_shape):
    """Writes `policy`, for any batch size, so that `torch.export.load(path).module()` needs none of our code."""
    batch = torch.zeros((2, *observation_shape))
    program = torch.export.export(policy, (batch,), dynamic_shapes=({0: torch.export.Dim("batch")},))
    torch.export.save(program, archive := io.BytesIO())  # into a file on a full disk it would end the process
    write_atomically(path, lambda file: file.write(archive.getvalue()))


def _in_worker(file, *arguments):
    with telling_task_errors("the task or the policy"):
        function, large = pickle.loads(file.read_bytes())
        return function(large, start_worker.task, *arguments)


def say(line):
    """Prints a line, above the progress bar. A program whose output nobody reads any more goes on."""
    try:
        with contextlib.suppress(AttributeError, ValueError):  # no stream, a closed one, or one without such a letter
            tqdm.write(line)
            sys.stdout.flush()
    except OSError as error:
        if error.errno == errno.ENOSPC:
            raise
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # so that your own `print` does not fail either


class Run:
    """One training run: its processes, device, directory and evaluations, and the checkpoint that it continues from.

    The directory holds `config.json`, a CSV for each table of metrics (`train`, `eval`, `random`), TensorBoard's
    events, the checkpoint, the policies, the curve and the videos. A checkpoint has the tables too: on resume the files
    are written anew from it. Rank 0 alone evaluates, writes and prints.
    """

    training_process = None  # one run at a time: torch has one random generator

    def __init__(self, config, script, task, evaluate):
        """`evaluate(policy, task, seed)` plays one episode in a worker process and returns its return and length."""
        if multiprocessing.current_process().daemon:
            raise InputError("a daemon, as a Pool's worker is, cannot train: use multiprocessing.Process(daemon=False)")
        if config.evaluate is not None:
            raise InputError("train does not evaluate a saved policy: the command line does, with --evaluate")
        self.config, self.script, self.task, self.evaluate_episode = config, script, task, evaluate
        self.ranks, self.checkpoint = Ranks(), {}
        self.writes = self.ranks.rank == 0
        self.print = say if self.writes else lambda line: None
        self.device = select_device(config.device, self.ranks.local_rank)
        if self.ranks.world_size > 1 and ":" in config.device:
            raise InputError(f"--device {config.device}: several processes take a GPU each; use --device cuda")
        if config.resume is not None:
            self.checkpoint = read_file(config.resume / "checkpoint.pt", "checkpoint", script)
            self._require_same_run(self.checkpoint["config"])
        processes = self.ranks.world_size
        if config.batch_size % processes:
            raise InputError(f"--batch-size {config.batch_size} cannot be shared by {processes} processes")
        turns = math.ceil(config.initial_collect_steps / (processes * config.num_envs))  # of all environments
        stored = processes * min(turns * config.num_envs, config.replay_buffer_capacity)
        if config.batch_size > stored:
            raise InputError(f"--batch-size {config.batch_size} is more than the {stored} transitions stored at first")
        self.batch_size = config.batch_size // processes  # this process's share
        name = f"{script}-{datetime.now():%Y%m%d-%H%M%S-%f}-seed{config.seed}"  # %f: runs may start at once
        path = [config.resume or config.run_dir or Path("runs") / name]
        if self.ranks.world_size > 1:
            dist.broadcast_object_list(path)  # the others take rank 0's
        (self.path,) = path
        self.directory = self.path.absolute()  # a task may change the current one
        # The results so far. A snapshot is a caption and the policy's weights, for the film of how it learned.
        new = {"tables": {"train": [], "eval": [], "random": []}, "best": (-math.inf, None), "snapshots": []}
        self.results = {name: self.checkpoint.get(name, value) for name, value in new.items()}
        self.tables = self.results["tables"]
        self.texts = {table: io.StringIO() for table in self.tables}  # the CSVs', so that a row is formatted once
        self.started = time.perf_counter() - self.checkpoint.get("seconds", 0.0)
        self.saved_step = self.checkpoint.get("step", 0)
        self.stopping = self.stopped = False  # this process was asked to stop; all processes agreed to
        self.owner = os.urandom(16)  # in .owner: another process that resumes the run writes its own
        self.stack = contextlib.ExitStack()  # what to end and undo when the run ends, the last first

    def _require_same_run(self, saved):
        config = plain_config(self.config) | {"run_dir": self.config.run_dir}  # a run cannot move
        for name, value in config.items():
            shorter = name == "num_iterations" and value < saved[name]
            if shorter or name not in MAY_DIFFER_ON_RESUME and value != saved[name]:
                flag, what = f"--{name.replace('_', '-')} {value}", "raise it" if shorter else "leave it out"
                raise InputError(f"{flag} differs from the {saved[name]} of the run to resume: {what}")
        if (processes := len(self.checkpoint["ranks"])) != self.ranks.world_size:
            raise InputError(f"{self.config.resume} was saved by {processes} processes: continue it with as many")

    def __enter__(self):
        if Run.training_process == os.getpid():
            raise InputError("this process trains already: start a process of its own for the other training")
        Run.training_process = os.getpid()
        with contextlib.ExitStack() as failing:
            failing.push(self)  # __exit__ handles what fails here, as it does later
            self.stack.callback(setattr, Run, "training_process", None)
            if threading.current_thread() is threading.main_thread():
                for number in STOP_SIGNALS:
                    if number == signal.SIGINT or signal.getsignal(number) != signal.SIG_IGN:  # nohup ignores SIGHUP
                        self.stack.callback(signal.signal, number, signal.signal(number, self._request_stop))
            if self.writes:
                cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
                size = min(cores, self.config.num_eval_episodes, 61)  # a pool's most on Windows
                context = multiprocessing.get_context(START_METHOD)
                self.scratch = Path(self.stack.enter_context(tempfile.TemporaryDirectory()))
                start = gym.vector.utils.CloudpickleWrapper(partial(start_worker, gym.registry, self.task))
                self.pool = self.stack.enter_context(futures.ProcessPoolExecutor(size, context, start))
                with self.killed_at_the_end():
                    list(self.pool.map(int, range(size)))  # starts all before anything uses a GPU or threads
            keep_freed_memory()
            self.stack.callback(torch.set_num_threads, torch.get_num_threads())
            torch.set_num_threads(self.config.num_threads)
            failing.pop_all()
        return self

    @contextlib.contextmanager
    def killed_at_the_end(self):
        """The processes that start inside end with the run, whatever they do."""
        others = multiprocessing.active_children()
        try:
            yield
        finally:
            for worker in set(multiprocessing.active_children()).difference(others):
                if not worker.daemon:  # Python ends daemons, and would wait for a lock that a killed one holds
                    self.stack.callback(worker.kill)

    def __exit__(self, kind, error, trace):
        self.stack.close()
        died = isinstance(error, (EOFError, ConnectionError, futures.BrokenExecutor))
        lost = self.ranks.world_size > 1 and (isinstance(error, dist.DistError) or "gloo" in str(error))
        if died or lost or isinstance(error, OSError):
            reason = "a worker process died" if died else ("lost another process: " if lost else "") + first_line(error)
            raise RunError(f"{reason}; {self._how_to_continue()}") from error
        if isinstance(error, TaskError):
            error.__cause__ = None  # it is the pool's, with the same traceback
            self.print(self._how_to_continue())

    def _how_to_continue(self):
        if not (self.directory / "checkpoint.pt").exists():
            return "there is no checkpoint yet"
        python = f"torchrun --nproc-per-node {n}" if (n := self.ranks.world_size) > 1 else "python"
        file = Path(getattr(sys.modules.get(type(self.config).__module__), "__file__", "a notebook's cells"))
        if file.name != Path(sys.argv[0]).name:  # not this script runs, but a notebook or a program that calls `train`
            return f"to continue from the last checkpoint: train(Config(resume={str(self.path)!r}))"
        command = shlex.join(Path(part).as_posix() for part in (sys.argv[0], "--resume", self.path))  # on Windows, too
        return f"to continue from the last checkpoint: {python} {command}"

    def _request_stop(self, number, _):
        if self.stopping and number == signal.SIGINT:
            raise KeyboardInterrupt
        self.stopping = True
        with contextlib.suppress(Exception):  # no console
            os.write(sys.stderr.fileno(), b"\nstopping: saving a checkpoint first (Ctrl-C again stops at once)\n")

    def stop_requested(self, step):
        """Whether any rank was asked to stop. Several processes exchange messages for it, at every 20th update."""
        if self.ranks.world_size == 1:
            self.stopped = self.stopping
        elif step % 20 == 0 or step % self.config.eval_interval == 0:
            self.ranks.average([stopping := torch.tensor(float(self.stopping))])
            self.stopped = bool(stopping > 0)
        return self.stopped

    def start(self, agent, buffer, environments):
        """Restores the checkpoint, begins the files, saves a checkpoint for a new config, evaluates the random policy.

        Returns the number of updates done. Nothing is written earlier: by now all that the user gave proved usable.
        """
        self.agent, self.buffer, self.environments = agent, buffer, environments
        config, saved, self.checkpoint = self.config, self.checkpoint, {}
        if saved:
            own = saved["ranks"][self.ranks.rank]
            replay = own["buffer"]
            buffer.size, buffer.position = len(replay["rows"]), replay.pop("position")
            try:
                agent.load_state_dict(saved["agent"])
                for name, stored in replay.items():
                    getattr(buffer, name)[: buffer.size] = stored
                for optimizer, state in zip(agent.optimizers, saved["optimizers"], strict=True):
                    optimizer.load_state_dict(state)
                    if any(name not in optimizer.param_groups[0] for name in getattr(optimizer, "defaults", ())):
                        raise ValueError("saved by another kind of optimizer")
            except (AttributeError, RuntimeError, ValueError):
                raise InputError(f"{config.resume} does not fit this script's networks, optimizers, replay") from None
            torch.set_rng_state(own["random"]["cpu"])
            if self.device.type == "cuda" and own["random"].get("cuda") is not None:
                torch.cuda.set_rng_state(own["random"]["cuda"], self.device)
        if self.writes:
            self._start_files()
        hidden = not self.writes or getattr(sys.stderr, "closed", not sys.stderr)
        options = {"unit": "step", "disable": hidden or None}  # None: only on a terminal
        self.progress = self.stack.enter_context(tqdm(total=config.num_iterations, initial=self.saved_step, **options))
        limit = f"episodes of at most {self.task.max_episode_steps} steps (--max-episode-steps)"
        self.print(f"{config.env_id}, seed {config.seed}, {limit}")
        self.print(f"{self.ranks.world_size} process(es), {config.num_threads} CPU thread(s), device {self.device}")
        self.print(f"replay buffer of {buffer.rows.nbytes / 1e6:.0f} MB when full, run directory {self.path}")
        if plain_config(config) != saved.get("config"):  # or a kill before the next save would lose these settings
            self.save(self.saved_step)
        self.evaluate(0, policy=None)  # random actions, for comparison
        self.last_logged = time.perf_counter(), self.saved_step
        return self.saved_step

    def _start_files(self):
        from torch.utils.tensorboard import SummaryWriter  # takes a second

        try:
            str(self.directory).encode()  # TensorBoard takes no other names
            self.directory.mkdir(parents=True, exist_ok=True)
            if self.config.resume is None:
                if any(self.directory.iterdir()):
                    raise ValueError("not empty: name a new one, or continue it with --resume")
                (self.directory / "config.json").touch(exist_ok=False)  # fails for the second of two at once
        except (OSError, ValueError) as error:
            raise InputError(f"--run-dir {self.path} cannot be used: {first_line(error)}") from None
        text = to_json(plain_config(self.config), indent=2) + b"\n"
        write_atomically(self.directory / "config.json", lambda file: file.write(text))
        write_atomically(self.directory / ".owner", lambda file: file.write(self.owner))
        for name in ("events.out.tfevents.*", ".tmp-*", *(f"{table}.csv" for table in self.tables)):
            for path in self.directory.glob(name):
                path.unlink(missing_ok=True)  # the run may still go on in another process
        self.stack.enter_context(contextlib.suppress(OSError))  # when the writer closes: the same full disk again
        self.summary_writer = self.stack.enter_context(SummaryWriter(self.directory))
        for table, rows in self.tables.items():
            if rows:
                self._write_rows(table, rows)
        if weights := self.results["best"][1]:  # the file may be of an evaluation that came after the checkpoint
            self._save("best_policy.pt", "policy", {"weights": weights})

    def _log(self, table, step, values):
        seconds = round(time.perf_counter() - self.started, 3)
        self.tables[table].append({"step": step, "env_steps": self.environments.steps, "seconds": seconds} | values)
        self._write_rows(table, self.tables[table][-1:])

    def _write_rows(self, table, new):
        """Writes a table's file, which has all rows, and shows TensorBoard the `new` ones."""
        rows, text = self.tables[table], self.texts[table]
        if added := [name for name in new[-1] if name not in rows[0]]:  # a metric that you added
            rows[0] |= dict.fromkeys(added, math.nan)
            text.truncate(text.seek(0))
        writer = csv.DictWriter(text, rows[0], math.nan, lineterminator="\n")
        if not (begun := text.tell()):
            writer.writeheader()
        writer.writerows(new if begun else rows)
        with contextlib.suppress(PermissionError):  # on Windows, while Excel has the file open: the next row writes all
            self._write(f"{table}.csv", lambda file: file.write(text.getvalue().encode()))
        for row in new:  # after `_write`, which raises if another process continues this run
            for name, value in row.items():
                if name != "step" and math.isfinite(value):
                    self.summary_writer.add_scalar(f"{table}/{name}", value, row["step"])

    def log_training(self, step, metrics):
        """Logs one update's `metrics`, scalar tensors or numbers, recent episodes, and the speed since the last row.

        Every `log_interval` updates. Raises RunError naming the step and the first metric that is not finite.
        """
        self.progress.update()
        if not self.writes or step % self.config.log_interval:
            return
        values = [torch.as_tensor(value, dtype=torch.float32, device=self.device) for value in metrics.values()]
        values = dict(zip(metrics, torch.stack(values).tolist()))  # one wait for a GPU
        for name, value in values.items():
            if not math.isfinite(value):
                raise RunError(f"{name} is {value} at step {step}; the last good checkpoint is kept")
        now, (then, last_step) = time.perf_counter(), self.last_logged
        self.last_logged, speed = (now, step), (step - last_step) / (now - then)
        returns, lengths = zip(*self.environments.finished or [(math.nan, math.nan)])
        episodes = {"collect_return": float(np.mean(returns)), "collect_episode_length": float(np.mean(lengths))}
        self._log("train", step, {"steps_per_second": speed} | episodes | values)
        losses = ", ".join(f"{name} = {value:.4g}" for name, value in values.items() if "loss" in name)
        self.print(f"step = {step}: {losses}, steps per second = {speed:.0f}")

    def evaluate(self, step, policy):
        """Plays the evaluation episodes with `policy` (None: random actions) and logs them, unless this step is logged.

        The best policy so far is saved. A stop request ends this early; the resumed run does it again.
        """
        table = "eval" if policy else "random"
        if not self.writes or self.stopped or any(row["step"] == step for row in self.tables[table][-1:]):
            return
        policy = policy and copy.deepcopy(policy).cpu().eval()  # you may have added dropout
        episodes = self._in_pool(self.evaluate_episode, policy, "policy", evaluation_seeds(self.config))
        while not (self.stopping or all(episode.done() for episode in episodes)):
            for episode in futures.wait(episodes, 0.1, futures.FIRST_EXCEPTION).done:
                episode.result()  # raises what went wrong
        if self.stopping:
            return
        row, text = summarize([episode.result() for episode in episodes])
        self._log(table, step, row)
        self.print(f"{f'step = {step}' if policy else 'random policy'}: {text}")
        if policy:
            self.progress.set_postfix_str(f"return {row['average_return']:.2f}")
            require_finite(policy, step)
            weights = policy.state_dict()
            # Five policies, at 0, 1/16, 1/4, 9/16 and all of the updates: most is learned at the beginning.
            if step >= (len(self.results["snapshots"]) / 4) ** 2 * self.config.num_iterations:
                self.results["snapshots"].append((f"{step} updates: return {row['average_return']:.1f}", weights))
            if row["average_return"] > self.results["best"][0]:
                self.results["best"] = row["average_return"], weights
                self._save("best_policy.pt", "policy", {"weights": weights})

    def _in_pool(self, function, large, name, seeds, *more):
        """Futures of `function(large, task, seed, *more)` in the pool's workers, for each of the seeds."""
        file = self.scratch / name  # sent through a queue, a large one would hang where a worker has died
        try:
            payload = pickle.dumps((function, large))
        except Exception:  # at your lambda, or class inside a function
            with telling_task_errors("sending the policy to a worker"):
                payload = cloudpickle.dumps((function, large))
        file.write_bytes(payload)
        return [self.pool.submit(_in_worker, file, seed, *more) for seed in seeds]

    def _film(self, clips, name, *more):
        return self._in_pool(film, clips, name, evaluation_seeds(self.config)[:1], self.directory / name, *more)[0]

    def save(self, step):
        """Saves a checkpoint, and the policy for --evaluate. Raises RunError, saving nothing, for bad weights."""
        agent, buffer, self.saved_step = self.agent, self.buffer, step
        cuda = torch.cuda.get_rng_state(self.device) if self.device.type == "cuda" else None
        random = {"cpu": torch.get_rng_state(), "cuda": cuda}
        replay = {"position": buffer.position}
        for name, value in vars(buffer).items():  # `rows`, and what you keep beside it
            if torch.is_tensor(value) and value.shape[:1] == buffer.rows.shape[:1]:
                replay[name] = value[: buffer.size].to("cpu", copy=True)
        own = {"buffer": replay, "environments": self.environments.state_dict(), "random": random}
        ranks = [own] * self.ranks.world_size if self.writes else None
        if self.ranks.world_size > 1:
            dist.gather_object(own, ranks)  # fills rank 0's list
        if not self.writes:
            return
        require_finite(agent, step)
        state = {"step": step, "env_steps": self.environments.steps, "seconds": time.perf_counter() - self.started}
        state |= {"agent": agent.state_dict(), "optimizers": [optimizer.state_dict() for optimizer in agent.optimizers]}
        self._save("policy.pt", "policy", {"weights": copy.deepcopy(agent.policy).cpu().state_dict()})
        self._save("checkpoint.pt", "checkpoint", state | {"ranks": ranks} | self.results)

    def _save(self, name, kind, state):
        state |= {"kind": kind, "script": self.script, "format": FILE_FORMAT, "config": plain_config(self.config)}

        def write(file):
            torch.save(state, file)
            file.flush()
            if unsafe := torch.serialization.get_unsafe_globals_in_checkpoint(file.name):  # such as your np.float64
                what = f"{name} could not be read again: it has {min(unsafe)}, not only tensors and Python's numbers"
                raise RunError(f"{what}; the last good one is kept")

        self._write(name, write)

    def _write(self, name, write):
        with contextlib.suppress(FileNotFoundError):
            if (self.directory / ".owner").read_bytes() == self.owner:
                return write_atomically(self.directory / name, write)
        raise RunError(f"another process continues the run in {self.path}, or it was removed")

    def finish(self, step, observation_space):
        """Saves and evaluates once more, draws the curve, exports and films the policy, and says where everything lies.

        If curve, film or export fail it warns. After a stop it only saves, draws the curve and says how to continue.
        """
        if step > self.saved_step or self.stopped:
            self.save(step)
        self.evaluate(step, self.agent.policy)
        if not self.writes:
            return
        self.progress.close()
        title = f"{self.config.env_id}, seed {self.config.seed}"
        with or_warn("learning_curve.png"):
            plot_learning_curve(self.directory / "learning_curve.png", self.tables, title, self.task.reward_threshold)
        if self.stopped or self.stopping:  # the latter: the last evaluation was stopped and is still to do
            return self.print(f"stopped at step {step}; {self._how_to_continue()}")
        policy, films = copy.deepcopy(self.agent.policy).cpu().eval(), {}
        if self.config.video:
            self.print("filming the trained agent, a random one, and how it learned ...")
            learning = [(policy, weights, caption) for caption, weights in self.results["snapshots"]]
            with or_warn("films"):
                films["learning.mp4"] = self._film(learning, "learning.mp4", 4, 25)
                films["trained_agent.mp4"] = self._film([(policy, None, None)], "trained_agent.mp4")
                films["random_agent.mp4"] = self._film([(None, None, None)], "random_agent.mp4")
        with or_warn("exported policy"):
            export_policy(self.directory / "policy.pt2", policy, observation_space.shape)
            policy.load_state_dict(self.results["best"][1])
            export_policy(self.directory / "best_policy.pt2", policy, observation_space.shape)
        for name, recording in films.items():
            with or_warn(name):
                while futures.wait([recording], 0.1).not_done:
                    if self.stopping:
                        return self.print(f"stopped while filming; {self._how_to_continue()}")
                recording.result()
        files = ", ".join(sorted(path.name for path in self.directory.iterdir() if not path.name.startswith(".")))
        self.print(f"finished; {self.path} holds {files}")


@contextlib.contextmanager
def or_warn(what):
    """Turns an exception into a printed warning."""
    try:
        yield
    except Exception as error:
        say(f"warning: no {what} ({first_line(error)})")


def require_finite(module, step):
    """Raises RunError naming the first parameter that has a number which is not finite."""
    for name, parameter in module.named_parameters():
        if not parameter.isfinite().all():
            raise RunError(f"{name} is not finite at step {step}; the last good checkpoint is kept")


def summarize(results):
    """The metrics of evaluation episodes, from a list of (return, length), and a line that tells them."""
    returns, lengths = np.array(results, np.float64).T.tolist()  # a checkpoint may not hold numpy's own numbers
    mean, std, length, length_std = (float(f(x)) for x in (returns, lengths) for f in (np.mean, np.std))
    row = {"average_return": mean, "std_return": std, "min_return": min(returns), "max_return": max(returns)}
    row |= {"average_episode_length": length, "std_episode_length": length_std}
    return row, f"AverageReturn = {mean:.6f} +/- {std:.6f}, AverageEpisodeLength = {length:.6f} +/- {length_std:.6f}"


def evaluate_policy(config, script, policy, task, evaluate):
    """What --evaluate PATH does: plays the episodes that its run was evaluated with, tells the returns, films one."""
    try:
        policy.eval().load_state_dict(read_file(config.evaluate, "policy", script)["weights"])
    except RuntimeError:
        raise InputError(f"{config.evaluate} does not fit {config.env_id} and this script's network") from None
    torch.set_num_threads(1)  # as in a run's evaluation: the same digits
    seeds, video = evaluation_seeds(config), config.evaluate.with_suffix(".mp4").absolute()
    _, text = summarize([evaluate(policy, task, seed) for seed in tqdm(seeds, disable=None if sys.stderr else True)])
    try:
        say(f"{config.evaluate}: {text}")
        if config.video:
            with or_warn("video"):
                film([(policy, None, None)], task, seeds[0], video)
                say(f"filmed one episode: {video}")
    except OSError as error:  # a full disk
        raise RunError(first_line(error)) from None


def plot_learning_curve(path, tables, title, reward_threshold):
    """Draws a run's returns with their spread beside its losses and mean Q, from the rows of its tables."""
    if "ipykernel" not in sys.modules:  # in a notebook's `!command` its backend is set, but may be missing
        os.environ.pop("MPLBACKEND", None)
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 4), layout="constrained")
    returns, losses, values = figure.subplots(1, 3)
    points = [(row["step"], row["average_return"], row["std_return"]) for row in tables["eval"]]
    steps, mean, spread = np.reshape(points, (-1, 3)).T
    returns.plot(steps, mean, marker=".", label="deterministic policy, mean ± std")
    returns.fill_between(steps, mean - spread, mean + spread, alpha=0.2)
    for row in tables["random"]:
        returns.axhline(row["average_return"], color="gray", linestyle=":", label="random policy")
    if reward_threshold is not None:
        returns.axhline(reward_threshold, color="green", linestyle="--", label="the task's threshold")
    returns.set(title=title, xlabel="gradient updates", ylabel="return")
    returns.legend(fontsize="small")
    for axes, name, title in ((losses, "loss", "loss"), (losses, "critic_loss", "loss"), (values, "mean_q", "mean Q")):
        points = [(row["step"], row[name]) for row in tables["train"] if name in row]
        axes.plot(*np.reshape(points, (-1, 2)).T)
        axes.set(title=title, xlabel="gradient updates")
    losses.set_yscale("log")
    write_atomically(path, lambda file: figure.savefig(file, format="png", dpi=100))


def film(clips, task, seed, path, seconds=math.inf, max_fps=50):
    """Films the first `seconds` of an episode in real time, for each of `clips`, at most `max_fps` frames a second.

    A clip is a policy (None: random actions), its weights (None: those that it has), and a caption or None.
    """
    import imageio
    from PIL import Image, ImageDraw

    os.environ.setdefault("SDL_VIDEODRIVER", "dummy")  # pygame draws into memory and needs no display
    if sys.platform == "linux" and "DISPLAY" not in os.environ:
        os.environ.setdefault("MUJOCO_GL", "egl")  # nor does MuJoCo then

    def frame(caption):
        image = Image.fromarray(env.render())
        if caption:
            ImageDraw.Draw(image).text((8, 8), caption, "black", font_size=20, stroke_width=2, stroke_fill="white")
        return np.asarray(image)

    def write(file):
        rate = env.metadata.get("render_fps") or 30
        skip = math.ceil(rate / max_fps)
        options = {"fps": rate / skip, "macro_block_size": 2, "ffmpeg_log_level": "quiet"}
        with contextlib.closing(imageio.get_writer(file.name, **options)) as video:
            for policy, weights, caption in clips:
                if weights:
                    policy.load_state_dict(weights)
                env.action_space.seed(seed)
                observation, _ = env.reset(seed=seed)
                done, step = False, 0
                while not done and step < seconds * rate:
                    if step % skip == 0:
                        video.append_data(frame(caption))
                    action = policy.act(observation) if policy else env.action_space.sample()
                    observation, _, terminated, truncated, _ = env.step(action)
                    done, step = terminated or truncated, step + 1
                video.append_data(frame(caption))
        imageio.get_reader(file.name).close()  # raises where the disk was full, of which the writer says nothing

    with gym.make(task, render_mode="rgb_array") as env:
        write_atomically(path, write)
