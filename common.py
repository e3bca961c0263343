"""What both training scripts need and what can be specified without knowing the algorithm.

Devices and processes, the run directory with its metrics, plots, videos, exported policies and checkpoint files.
No network, loss or replay buffer is defined here.
"""

import contextlib
import copy
import csv
import ctypes
import dataclasses
import errno
import functools
import io
import json
import math
import multiprocessing
import os
import pickle
import signal
import sys
import threading
import time
import zipfile
from collections import deque
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from datetime import datetime
from pathlib import Path

import gymnasium as gym
import numpy as np
import torch
import torch.distributed as dist
from tqdm import tqdm

CHECKPOINT_FORMAT = 1
# Sets the seeds of evaluation episodes apart from those of training, whose second number counts environments.
EVALUATION_KEY = 2**32 - 1
# Workers are forked where that is safe: they start at once and share the memory of the imported libraries. They never
# touch a GPU and run on one thread, the two things that do not survive a fork.
START_METHOD = "fork" if sys.platform == "linux" else "spawn"


class InputError(Exception):
    """Something the user gave cannot be used. Its message is the one line that they see; the exit status is 2."""

    exit_status = 2


class RunError(Exception):
    """Something failed while running (a full disk, a dead worker, a loss that is not finite). The exit status is 1."""

    exit_status = 1


def require_range(config, least, most, *names):
    """Raises InputError naming the first of these fields of `config` that is not finite and from `least` to `most`.

    A field that holds several numbers needs it of each.
    """
    for name in names:
        value = getattr(config, name)
        numbers = value if isinstance(value, tuple) else (value,)
        if not all(least <= number <= most and abs(number) < math.inf for number in numbers):
            if most < math.inf:
                allowed = f"from {least} to {most}"
            else:
                allowed = f"of {least} or more" if least > -math.inf else "that is finite"
            raise InputError(f"--{name.replace('_', '-')} {value} cannot be used: it takes a number {allowed}")


def require_batch(config, held_back=0):
    """Raises InputError for a batch that the processes cannot share, or that the first random data do not fill.

    Of these, every process has yet to store its last `held_back` steps.
    """
    processes = num_processes()
    if config.batch_size % processes:
        raise InputError(f"--batch-size {config.batch_size} cannot be shared by {processes} processes")
    own = min(config.initial_collect_steps // processes - held_back, config.replay_buffer_capacity)
    stored = max(0, processes * own)
    if config.batch_size > stored:
        raise InputError(f"--batch-size {config.batch_size} is more than the {stored} transitions collected first")


def run_main(main):
    """Calls `main` and turns an `InputError` or a `RunError` into one line on stderr and an exit status."""
    try:
        main()
    except (InputError, RunError) as error:
        if int(os.environ.get("RANK", 0)) > 0:
            time.sleep(1)  # rank 0 mostly fails for the same reason: torchrun then ends this one, and one line is printed
        print(f"error: {error}", file=sys.stderr, flush=True)
        # Ranks that wait for each other in a collective would keep an orderly exit from ending.
        sys.stdout.flush()
        os._exit(error.exit_status) if dist.is_initialized() else sys.exit(error.exit_status)
    except KeyboardInterrupt:
        sys.exit(130)


# Devices, randomness and memory


def select_device(name, local_rank=0):
    """The `torch.device` for `--device`; `auto` takes CUDA, then MPS, then the CPU, and rank i of a machine GPU i.

    Raises InputError when the name is unknown or the device is not there.
    """
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "mps" if torch.backends.mps.is_available() else "cpu"
    try:
        device = torch.device(name)
    except RuntimeError:
        device = None
    if device is None or device.type not in ("cpu", "cuda", "mps") or (device.index and device.type != "cuda"):
        raise InputError(f"--device {name} is not a device: use auto, cpu, cuda, cuda:N or mps")
    if device.type == "cuda":
        index = local_rank if device.index is None else device.index
        if index >= torch.cuda.device_count():
            raise InputError(f"--device {name}: CUDA GPU {index} is not there ({torch.cuda.device_count()} found)")
        device = torch.device("cuda", index)
    if device.type == "mps" and not torch.backends.mps.is_available():
        raise InputError("--device mps: there is no MPS device here; use auto or cpu")
    return device


def keep_freed_memory():
    """Tells glibc to keep what is freed (mallopt's M_MMAP_THRESHOLD and M_TRIM_THRESHOLD, 256 MB).

    A training step allocates and frees the same few hundred kilobytes over and over. By default every such tensor is
    mapped in afresh from the system, page fault by page fault. Elsewhere than on glibc this does nothing.
    """
    with contextlib.suppress(OSError, AttributeError, TypeError):
        libc = ctypes.CDLL("libc.so.6")
        libc.mallopt(-3, 256 << 20)
        libc.mallopt(-1, 256 << 20)


def empty_replay(capacity, columns, device):
    """An uninitialized float32 tensor (capacity, columns). Raises InputError when the device has not that much memory."""
    try:
        return torch.empty(capacity, columns, device=device)
    except (RuntimeError, TypeError):  # the latter for a number beyond 64 bits
        size = f"{capacity * columns * 4 / 1e9:.1f} GB"
        raise InputError(f"--replay-buffer-capacity {capacity} takes {size}, more than is free: use less") from None


def random_state():
    """The state of torch's generators, CPU and current GPU: a dict of byte tensors."""
    return {"cpu": torch.get_rng_state()} | ({"cuda": torch.cuda.get_rng_state()} if torch.cuda.is_initialized() else {})


def set_random_state(state):
    """Puts back what `random_state` returned."""
    torch.set_rng_state(state["cpu"])
    if "cuda" in state and torch.cuda.is_available():
        torch.cuda.set_rng_state(state["cuda"])


def episode_seed(*key):
    """A 32-bit seed for one episode from a tuple of integers such as (seed, env index, episode number)."""
    return int(np.random.SeedSequence(key).generate_state(1)[0])


# Several processes training together


def num_processes():
    """How many processes torchrun started, this one among them; 1 without torchrun."""
    return int(os.environ.get("WORLD_SIZE", 1)) if "RANK" in os.environ else 1


class _Mean(torch.autograd.Function):
    """The mean over the ranks. What it passes back is the same mean, of the ranks' gradients."""

    @staticmethod
    def forward(ctx, tensor):
        dist.all_reduce(tensor := tensor.clone())
        return tensor / dist.get_world_size()

    backward = forward


@dataclasses.dataclass(frozen=True)
class Ranks:
    """This process among those that `torchrun` started; a single process is rank 0 of 1 and talks to nobody."""

    rank: int = 0
    world_size: int = 1
    local_rank: int = 0

    @classmethod
    def join(cls):
        """Joins the process group that torchrun's environment variables describe."""
        if num_processes() == 1:
            return cls()
        if not dist.is_initialized():
            dist.init_process_group("cpu:gloo,cuda:nccl" if torch.cuda.is_available() else "gloo")
        return cls(dist.get_rank(), dist.get_world_size(), int(os.environ.get("LOCAL_RANK", 0)))

    def average_gradients(self, parameters):
        """Replaces every gradient by its mean over the ranks, in one collective.

        The mean over the ranks of the mean over batch/N is the mean over the batch.
        """
        if self.world_size == 1:
            return
        gradients = [parameter.grad for parameter in parameters]
        flat = torch.cat([gradient.flatten() for gradient in gradients])
        dist.all_reduce(flat)
        flat /= self.world_size
        for gradient, mean in zip(gradients, flat.split([gradient.numel() for gradient in gradients])):
            gradient.copy_(mean.view_as(gradient))

    def mean(self, tensor):
        """The mean over the ranks of a tensor, the same on each. Gradients flow to all of them."""
        return _Mean.apply(tensor) if self.world_size > 1 else tensor

    def any(self, flag):
        """Whether `flag` is true on any rank."""
        if self.world_size == 1:
            return flag
        flags = torch.tensor(float(flag))
        dist.all_reduce(flags, dist.ReduceOp.MAX)
        return bool(flags)

    def gather(self, value):
        """The list of every rank's value on rank 0, None on the others."""
        if self.world_size == 1:
            return [value]
        values = [None] * self.world_size if self.rank == 0 else None
        dist.gather_object(value, values)
        return values

    def broadcast(self, value):
        """Rank 0's value, on every rank."""
        if self.world_size > 1:
            values = [value]
            dist.broadcast_object_list(values)
            return values[0]
        return value


# Environments and worker processes


def die_with_parent():
    """For a worker process: leaves Ctrl-C and SIGTERM, which a whole group is often sent, to the main process.

    It exits as soon as that process is gone.
    """
    if multiprocessing.parent_process() is not None:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        threading.Thread(
            target=lambda: (multiprocessing.parent_process().join(), os._exit(1)), daemon=True
        ).start()


class SeededEpisodes(gym.Wrapper):
    """Seeds every episode by (seed, env index, episode number) and can start in the middle of one.

    No simulator saves all its caches in mid-episode, but an episode is a function of its seed and its actions: played
    again from the reset, it comes to the same state to the last bit. `actions` are those to play at the first reset.
    """

    def __init__(self, env, seed, index, episode=0, actions=()):
        super().__init__(env)
        self.key, self.episode, self.actions = (seed, index), episode, actions

    def reset(self, *, seed=None, options=None):
        observation, info = self.env.reset(seed=episode_seed(*self.key, self.episode), options=options)
        self.episode += 1
        for action in self.actions:
            observation, *_ = self.env.step(action)
        self.actions = ()
        return observation, info


class Episodes:
    """Where the running episode of each of K environments stands, and how the last 10 to end did.

    `number[i]` counts the episodes of environment i that have ended.
    """

    def __init__(self, num_envs, seed, first_index=0, state=None):
        self.seed, self.first_index = seed, first_index
        self.number = [0] * num_envs
        self.actions = [[] for _ in range(num_envs)]
        self.returns = [0.0] * num_envs
        self.finished = deque(maxlen=10)
        if state:
            self.number, self.returns = list(state["number"]), list(state["returns"])
            self.actions = [list(actions.numpy()) for actions in state["actions"]]
            self.finished.extend(state["finished"])

    @contextlib.contextmanager
    def open_envs(self, make_env, in_workers):
        """The K environments as one vector env, each to be brought to where its episode stands by `reset()`.

        An episode that ends is reset within the step, its true last observation in `infos["final_obs"]`. With
        `in_workers` each environment has a process of its own, so that `step_async` returns at once.
        """

        def make(i):
            die_with_parent()
            return SeededEpisodes(make_env(), self.seed, self.first_index + i, self.number[i], self.actions[i])

        makers = [functools.partial(make, i) for i in range(len(self.number))]
        mode = gym.vector.AutoresetMode.SAME_STEP
        if not in_workers:
            yield gym.vector.SyncVectorEnv(makers, autoreset_mode=mode)
            return
        envs = gym.vector.AsyncVectorEnv(makers, autoreset_mode=mode, context=START_METHOD)
        try:
            yield envs
        finally:
            for process in envs.processes:
                process.kill()  # between two steps or within one, there is nothing in a worker to save
            envs.closed = True

    def record(self, actions, rewards, done):
        """Notes one step of every environment: actions (K, …), rewards (K,), done (K,)."""
        for i, (action, reward) in enumerate(zip(actions, rewards)):
            self.actions[i].append(action)
            self.returns[i] += float(reward)
            if done[i]:
                self.finished.append((self.returns[i], len(self.actions[i])))
                self.number[i] += 1
                self.actions[i], self.returns[i] = [], 0.0

    def state(self):
        """Everything needed to come back to this point, for a checkpoint."""
        actions = [torch.from_numpy(np.array(actions)) for actions in self.actions]
        return {"number": self.number, "actions": actions, "returns": self.returns, "finished": list(self.finished)}

    def recent(self):
        """The mean return and length of the last 10 episodes that ended (nan before the first)."""
        returns, lengths = zip(*self.finished) if self.finished else ([math.nan], [math.nan])
        return {"collect_return": float(np.mean(returns)), "collect_episode_length": float(np.mean(lengths))}


def last_observations(next_observations, infos):
    """`next_observations` (K, …) with the true last observation where an episode has ended and was reset."""
    if "final_obs" not in infos:
        return next_observations
    last = next_observations.copy()
    for i in infos["_final_obs"].nonzero()[0]:
        last[i] = infos["final_obs"][i]
    return last


class Evaluations:
    """Evaluations in a pool of worker processes beside training, each reported under the step whose weights it used.

    `evaluate(policy, env_id, seed) -> (return, length)` plays one episode; it and the policy must be picklable. Every
    evaluation plays the same `seeds`, of which each rank takes its share. They are reported in the order they were
    started, and what is still running is in `state()`, so that a checkpoint loses none.
    """

    def __init__(self, evaluate, env_id, seeds, ranks):
        self.evaluate, self.env_id, self.seeds, self.ranks = evaluate, env_id, seeds, ranks
        self.pending = deque()
        # The cores that this process may use: on a cluster's node they are not all of them.
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
        self.pool = ProcessPoolExecutor(
            min(cores, math.ceil(len(seeds) / ranks.world_size)),
            multiprocessing.get_context(START_METHOD),
            initializer=_start_pool_worker,
        )
        # The first call forks the workers: now, before anything has used a GPU or started threads.
        self.pool.submit(int).result()
        for worker in self.pool._processes.values():
            worker.terminate = worker.kill  # when one has died the pool ends the others, which ignore SIGTERM

    def start(self, header, policy):
        """Starts evaluating a copy of `policy` (None: random actions), to be reported with `header`, a dict."""
        policy = policy and copy_to_cpu(policy)
        share = self.seeds[self.ranks.rank :: self.ranks.world_size]
        futures = [self.submit(self.evaluate, policy, self.env_id, seed) for seed in share]
        self.pending.append((header, policy, futures))

    def submit(self, function, policy, *args):
        """A future of `function(policy, *args)` in a worker, for a policy on the CPU or None."""
        # Pickled here, by value: the pool's queue would send tensors as handles of shared memory.
        return self.pool.submit(_call_with_policy, function, pickle.dumps(policy), *args)

    def finished(self):
        """Yields (header, policy, returns, lengths) of those that are done.

        Returns and lengths are rank 0's; elsewhere they are None. Raises BrokenProcessPool when a worker died.
        """
        while self.pending:
            header, policy, futures = self.pending[0]
            if self.ranks.any(not all(future.done() for future in futures)):
                return
            gathered = self.ranks.gather([future.result() for future in futures])
            self.pending.popleft()
            if gathered is None:
                yield header, policy, None, None
            else:
                episodes = [gathered[i % len(gathered)][i // len(gathered)] for i in range(len(self.seeds))]
                yield header, policy, *map(list, zip(*episodes))

    def state(self):
        """The evaluations still running, as (header, policy weights) pairs for a checkpoint."""
        return [(header, policy and policy.state_dict()) for header, policy, _ in self.pending]

    def close(self):
        """Ends the workers without waiting for what they still do."""
        for worker in self.pool._processes.values():
            worker.kill()
        # Python 3.10 would wait for ever for the dead to read what was being sent to them.
        self.pool._call_queue._reader.close()
        self.pool.shutdown(cancel_futures=True)


def _start_pool_worker():
    die_with_parent()
    torch.set_num_threads(1)
    if hasattr(os, "nice"):
        os.nice(5)  # training waits for its own physics, nothing waits for an evaluation


def _call_with_policy(function, policy, *args):
    return function(pickle.loads(policy), *args)


def copy_to_cpu(module):
    """A copy of a module that shares nothing with it."""
    return copy.deepcopy(module).cpu()


class StopRequest:
    """Turns the first Ctrl-C or SIGTERM into a flag that the training loop looks at; a second Ctrl-C ends at once."""

    def __init__(self):
        self.requested = False

    def __enter__(self):
        self.previous = {}
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                self.previous[number] = signal.signal(number, self._handle)
        return self

    def __exit__(self, *_):
        for number, handler in self.previous.items():
            signal.signal(number, handler)

    def _handle(self, number, _):
        if self.requested and number == signal.SIGINT:
            os._exit(130)  # the workers notice and follow
        self.requested = True
        os.write(2, b"\nstopping: saving a checkpoint first (Ctrl-C again stops at once)\n")


# The run directory


@contextlib.contextmanager
def replacing(path):
    """Gives the name of a temporary file, renamed to `path` at the end; an error removes it and leaves `path` alone."""
    path = Path(path)
    temporary = path.with_name(f".tmp-{path.name}")
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)  # what an error has left


def write_atomically(path, write):
    """Lets `write(file)` fill a temporary file, then renames it to `path`: a kill leaves the old file or the new one.

    Raises RunError, leaving the old file whole, when the disk is full or not writable.
    """
    try:
        with replacing(path) as temporary, open(temporary, "wb") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
    except (OSError, RuntimeError) as error:  # torch.save reports a failed write as a RuntimeError
        raise RunError(f"cannot write {path} ({_reason(error)}); the last good checkpoint is kept") from error


def _reason(error):
    while error.__context__ is not None and not isinstance(error, OSError):
        error = error.__context__
    return getattr(error, "strerror", None) or first_line(error)


class Run:
    """One training run: its processes, device, files and evaluations, and the checkpoint that it continues from.

    The directory holds `config.json`, a CSV per table of metrics (`train`, `eval`, `random`), TensorBoard's events,
    the checkpoint, the policies, the curve and the videos. The rows are kept in memory too and go into the checkpoint:
    on resume the files are written anew from them, so what the interrupted run wrote after its checkpoint is replaced.
    Only rank 0 writes and prints.
    """

    def __init__(self, config, script, evaluate):
        self.config, self.script = config, script
        self.ranks = Ranks.join()
        self.writes = self.ranks.rank == 0
        if self.ranks.world_size > 1 and ":" in config.device:
            raise InputError(f"--device {config.device}: several processes take a GPU each; use --device cuda")
        self.device = select_device(config.device, self.ranks.local_rank)
        if config.resume is not None:
            self.path = Path(config.resume)
            shared, own = load_checkpoint(self.path / "checkpoint.pt", script, self.ranks)
            self.checkpoint = shared | own
            require_same_run(config, shared["config"])
        else:
            # To the microsecond, for runs that are started at once.
            default = Path("runs") / f"{script}-{datetime.now():%Y%m%d-%H%M%S-%f}-seed{config.seed}"
            self.path = Path(self.ranks.broadcast(config.run_dir or default))
            self.checkpoint = {}
            if self.writes:
                self._make_directory()
        self.tables = self.checkpoint.get("tables", {})
        self.best_return = self.checkpoint.get("best_return", -math.inf)
        self.best_weights = self.checkpoint.get("best_weights")
        self.started = time.monotonic() - self.checkpoint.get("seconds", 0.0)
        self.last_logged = (time.monotonic(), self.checkpoint.get("step", 0))
        self.summary_writer = None
        # The workers are forked here, before anything has used a GPU.
        seeds = [episode_seed(config.seed, EVALUATION_KEY, i) for i in range(config.num_eval_episodes)]
        self.evaluations = Evaluations(evaluate, config.env_id, seeds, self.ranks)
        self.stop = StopRequest()
        self.stack = contextlib.ExitStack()
        keep_freed_memory()
        torch.set_num_threads(config.num_threads)

    def __enter__(self):
        if self.device.type == "cuda":
            torch.cuda.set_device(self.device)
        self.stack.callback(self.evaluations.close)
        self.enter(self.stop)
        self.progress = self.enter(
            tqdm(
                total=self.config.num_iterations,
                initial=self.checkpoint.get("step", 0),
                unit="step",
                disable=not (self.writes and sys.stderr.isatty()),
            )
        )
        return self

    def enter(self, context):
        """Enters a context that ends with the run."""
        return self.stack.enter_context(context)

    def __exit__(self, kind, error, trace):
        self.stack.close()
        if isinstance(error, (EOFError, ConnectionError, BrokenProcessPool)):
            raise RunError(f"a worker process died; --resume {self.path} continues from the last checkpoint") from error
        if isinstance(error, RuntimeError) and self.ranks.world_size > 1 and "gloo" in str(error):
            raise RunError(f"lost another process of this run ({first_line(error)})") from error

    def _make_directory(self):
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            used = any(self.path.iterdir())
        except OSError as error:
            raise InputError(f"--run-dir {self.path} cannot be used: {error.strerror}") from None
        if used:
            raise InputError(f"--run-dir {self.path} is not empty: name a new one, or continue it with --resume")

    def _save_config(self):
        config = dataclasses.replace(self.config, run_dir=str(self.path), resume=None)
        text = json.dumps(dataclasses.asdict(config), indent=2) + "\n"
        write_atomically(self.path / "config.json", lambda file: file.write(text.encode()))

    def _rewrite_tables(self):
        later = [self.path / f"{name}.csv" for name in ("train", "eval", "random") if name not in self.tables]
        for path in [*later, *self.path.glob("events.out.tfevents.*")]:
            path.unlink(missing_ok=True)
        for name, rows in self.tables.items():
            text = "".join(map(_csv_line, [rows[0].keys(), *(row.values() for row in rows)]))
            write_atomically(self.path / f"{name}.csv", lambda file, text=text: file.write(text.encode()))
            for row in rows:
                self._write_summary(name, row)

    def start(self, observation_space, action_space, buffer_bytes):
        """Begins the files anew, with what the checkpoint has of them, and says what is trained, on what, and where.

        Called when all that the user gave has been found usable: until then a new directory is left empty.
        """
        if self.writes:
            self._rewrite_tables()
            self._save_config()
        config = self.config
        processes = f", process 0 of {self.ranks.world_size}" if self.ranks.world_size > 1 else ""
        with np.printoptions(precision=2, threshold=8, edgeitems=2):
            self.print(f"task {config.env_id}: observations {observation_space}, actions {action_space}")
        self.print(f"device {self.device}, {config.num_threads} CPU thread(s){processes}, seed {config.seed}")
        self.print(f"replay buffer of {buffer_bytes / 1e6:.0f} MB when full; run directory {self.path}")

    def print(self, line):
        """Prints a line, above the progress bar where there is one. Stops the run when nobody reads on (`| head`)."""
        if not self.writes:
            return
        try:
            tqdm.write(line)
            sys.stdout.flush()
        except OSError as error:
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            if not isinstance(error, BrokenPipeError):
                raise RunError(f"cannot print ({error.strerror}); the last good checkpoint is kept") from error
            self.stop.requested = True

    def log(self, table, row):
        """Appends a row, a dict that starts with `step`, to a table: to its CSV and to TensorBoard."""
        if not self.writes:
            return
        rows = self.tables.setdefault(table, [])
        lines = _csv_line(row.values()) if rows else _csv_line(row.keys()) + _csv_line(row.values())
        rows.append(row)
        try:
            append_whole(self.path / f"{table}.csv", lines.encode())
            self._write_summary(table, row)
        except OSError as error:
            raise RunError(f"cannot write to {self.path} ({error.strerror}); the last good checkpoint is kept") from error

    def _write_summary(self, table, row):
        if self.summary_writer is None:
            self.summary_writer = self.enter(_tensorboard(self.path))
        for name, value in row.items():
            if name != "step" and math.isfinite(value):
                self.summary_writer.add_scalar(f"{table}/{name}", value, row["step"])

    def header(self, step, env_steps):
        """The columns that every row starts with."""
        return {"step": step, "env_steps": env_steps, "seconds": round(time.monotonic() - self.started, 3)}

    def log_training(self, step, env_steps, episodes, metrics):
        """Logs one update's `metrics`, scalar tensors, the recent episodes collected, and the speed since the last row."""
        now, (then, last_step) = time.monotonic(), self.last_logged
        self.last_logged = now, step
        speed = (step - last_step) / (now - then)
        values = {name: float(value) for name, value in metrics.items()}
        self.log("train", self.header(step, env_steps) | {"steps_per_second": speed} | episodes.recent() | values)
        losses = ", ".join(f"{name} = {value:.4g}" for name, value in values.items() if "loss" in name)
        self.print(f"step = {step}: {losses}, steps per second = {speed:.0f}")

    def start_evaluation(self, step, env_steps, policy):
        """Evaluates `policy` (None: random actions) beside training, to be reported under this step."""
        self.evaluations.start(self.header(step, env_steps), policy)

    def restart_evaluations(self, policy, policy_file):
        """Starts the evaluations again that were under way at the checkpoint; `policy` is lent for their weights.

        The best policy is written again too: the file's may be of an evaluation that came after the checkpoint.
        """
        policy = copy_to_cpu(policy)
        if self.best_weights is not None and self.writes:
            policy.load_state_dict(self.best_weights)
            policy_file.save(self.path / "best_policy.pt2", policy)
        for header, weights in self.checkpoint["evaluations"]:
            if weights is not None:
                policy.load_state_dict(weights)
            self.evaluations.start(header, policy if weights is not None else None)

    def report_evaluations(self, policy_file):
        """Logs the evaluations that are done; the policy of the best so far is saved with `policy_file`."""
        for header, policy, returns, lengths in self.evaluations.finished():
            if not self.writes:
                continue
            row = header | {
                "average_return": float(np.mean(returns)),
                "std_return": float(np.std(returns)),
                "min_return": min(returns),
                "max_return": max(returns),
                "average_episode_length": float(np.mean(lengths)),
                "std_episode_length": float(np.std(lengths)),
            }
            self.log("eval" if policy else "random", row)
            self.print(
                f"{'step = ' + str(row['step']) if policy else 'random policy'}: "
                f"AverageReturn = {row['average_return']:.6f} ± {row['std_return']:.6f}, "
                f"AverageEpisodeLength = {row['average_episode_length']:.6f} ± {row['std_episode_length']:.6f}"
            )
            if policy:
                self.progress.set_postfix_str(f"return {row['average_return']:.2f}")
            if policy and row["average_return"] > self.best_return:
                self.best_return, self.best_weights = row["average_return"], policy.state_dict()
                policy_file.save(self.path / "best_policy.pt2", policy)

    def stop_requested(self):
        """Whether any rank was asked to stop (Ctrl-C or SIGTERM)."""
        return self.ranks.any(self.stop.requested)

    def finish(self, step, policy_file, policy, film, reward_threshold):
        """Waits for the evaluations, draws the curve, films, and says where everything lies.

        After a stop nothing is waited for or filmed: the checkpoint has what is open. `film(policy, env_id, seed,
        path)` films one episode, or is None. A video or a curve that fails costs a line, not the run.
        """
        stopped = self.stop_requested()
        if self.evaluations.pending and not stopped:
            self.print("waiting for the last evaluations …")
        while self.evaluations.pending and not stopped:
            self.report_evaluations(policy_file)
            stopped = self.stop_requested()
            time.sleep(0.05)
        if not self.writes:
            return
        self.progress.close()
        if film and not stopped:
            self.print("filming one episode of the trained and one of the random agent …")
            seed = self.evaluations.seeds[0]
            videos = [
                self.evaluations.submit(film, agent, self.config.env_id, seed, self.path / name)
                for agent, name in ((copy_to_cpu(policy), "trained_agent.mp4"), (None, "random_agent.mp4"))
            ]
            for video in videos:
                while not video.done() and not self.stop.requested:
                    time.sleep(0.05)
                if video.done() and video.exception():
                    self.print(f"warning: no video ({first_line(video.exception())})")
            stopped = self.stop.requested
        try:
            random_return = self.tables["random"][0]["average_return"] if "random" in self.tables else None
            title = f"{self.config.env_id}, seed {self.config.seed}"
            plot_learning_curve(self.path / "learning_curve.png", self.tables, title, reward_threshold, random_return)
        except Exception as error:
            self.print(f"warning: no learning curve ({first_line(error)})")
        if stopped:
            ranks = self.ranks.world_size
            python = "python" if ranks == 1 else f"torchrun --nproc-per-node {ranks}"
            self.print(f"stopped at step {step}; to continue: {python} {self.script}.py --resume {self.path}")
        else:
            files = ", ".join(sorted(path.name for path in self.path.iterdir() if not path.name.startswith(".")))
            self.print(f"finished; {self.path} holds {files}")

    def save_checkpoint(self, shared, own):
        """Saves the training state that all ranks share, rank by rank their own, and the run's."""
        shared = shared | {
            "config": dataclasses.asdict(self.config),
            "tables": self.tables,
            "best_return": self.best_return,
            "best_weights": self.best_weights,
            "seconds": time.monotonic() - self.started,
            "evaluations": self.evaluations.state(),
        }
        save_checkpoint(self.path / "checkpoint.pt", self.script, shared, own, self.ranks)


@contextlib.contextmanager
def _tensorboard(path):
    from torch.utils.tensorboard import SummaryWriter

    writer = SummaryWriter(path)
    # Its thread would print what it meets on a full disk, and raises it at the next row anyway.
    others = threading.excepthook
    threading.excepthook = lambda thread: isinstance(thread.exc_value, OSError) or others(thread)
    try:
        yield writer
    finally:
        with contextlib.suppress(OSError):  # the same once more; the CSVs have said so already
            writer.close()
        threading.excepthook = others


def append_whole(path, data):
    """Appends bytes to a file, or on a full disk nothing of them: what is in the file stays whole lines."""
    with open(path, "ab", buffering=0) as file:
        length = file.tell()
        if file.write(data) != len(data):
            file.truncate(length)
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def _csv_line(values):
    line = io.StringIO()
    csv.writer(line, lineterminator="\n").writerow(values)
    return line.getvalue()


# Checkpoints and exported policies


def save_checkpoint(path, script, shared, own, ranks):
    """Writes the state that all ranks share and every rank's own to one file (rank 0 does): tensors and plain values."""
    own = ranks.gather(own)
    if ranks.rank == 0:
        state = {"format": CHECKPOINT_FORMAT, "script": script, "shared": shared, "ranks": own}
        write_atomically(path, functools.partial(torch.save, state))


def _require_whole(archive):
    """Raises ValueError when a record's checksum is wrong, at which torch.load does not look."""
    if damaged := archive.testzip():
        raise ValueError(f"{damaged} is damaged")


def load_checkpoint(path, script, ranks):
    """Reads back (shared, own) as this rank saved them, on the CPU. Nothing in the file is executed.

    Raises InputError, in one line, when the file is missing, damaged, foreign, of another script or format, or of
    another number of processes.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            _require_whole(archive)
        state = torch.load(path, map_location="cpu", weights_only=True)
        format_, found, shared, own = (state[key] for key in ("format", "script", "shared", "ranks"))
    except FileNotFoundError:
        raise InputError(f"{path} does not exist: --resume takes the directory of a run that saved a checkpoint") from None
    except Exception as error:  # whatever a damaged or hostile file provokes
        raise InputError(f"{path} is not a whole checkpoint of this project ({first_line(error)})") from None
    if found != script or format_ != CHECKPOINT_FORMAT:
        raise InputError(f"{path} is a checkpoint of {found}, format {format_}; needed: {script}, format {CHECKPOINT_FORMAT}")
    if len(own) != ranks.world_size:
        raise InputError(f"{path} was saved by {len(own)} processes; continue it with as many, not {ranks.world_size}")
    return shared, own[ranks.rank]


def first_line(error):
    return (str(error).splitlines() or [type(error).__name__])[0][:150]


def resumed_config(config, script):
    """`config` with the values saved in the checkpoint that it resumes, for the command line to be read over.

    Raises InputError when there is none, or one of another version of the script: its defaults need not be today's.
    """
    path = Path(config.resume) / "checkpoint.pt"
    shared, _ = load_checkpoint(path, script, Ranks.join())
    if others := dataclasses.asdict(config).keys() ^ shared["config"].keys():
        raise InputError(f"{path} was saved by another version of {script}.py, which differs in the field {min(others)}")
    return dataclasses.replace(config, **shared["config"] | {"resume": config.resume})


def require_same_run(config, saved):
    """Raises InputError naming the first field of `config` that keeps it from continuing the one `saved`, a dict."""
    if config.num_iterations < saved["num_iterations"]:
        less = f"{config.num_iterations} is less than the {saved['num_iterations']} of the run to resume"
        raise InputError(f"--num-iterations {less}: it may only be raised")
    # All but the iterations decide what is done besides, not what is learned.
    may_differ = {"num_iterations", "resume", "evaluate", "video", "checkpoint_interval"}
    if config.run_dir in (None, config.resume):  # no other directory is asked for
        may_differ.add("run_dir")
    for name, new in dataclasses.asdict(config).items():
        if name not in may_differ and new != (old := saved.get(name)):
            flag = "--" + name.replace("_", "-")
            raise InputError(f"{flag} {new} differs from the {old} of the run to resume: leave it out")


class PolicyFile:
    """A deterministic policy traced once with `torch.export`, for any batch size, to be saved with any weights."""

    def __init__(self, policy, observation_shape):
        self.policy = copy_to_cpu(policy)
        example = torch.zeros((2, *observation_shape))
        self.program = torch.export.export(
            self.policy, (example,), dynamic_shapes=({0: torch.export.Dim("batch")},)
        )

    def save(self, path, policy):
        """Writes `policy` with its weights of now, loadable by `torch.export.load(path).module()` with none of our code."""
        self.policy.load_state_dict(policy.state_dict())  # the program refers to these very tensors
        archive = io.BytesIO()  # torch.export.save into a file on a full disk ends the process
        torch.export.save(self.program, archive)
        write_atomically(path, lambda file: file.write(archive.getvalue()))


def load_weights(path):
    """The weights in a file of `PolicyFile`, name → float32 tensor. Nothing in the file is executed.

    `torch.export.load`, which would return the whole program, unpickles and evaluates what it finds. Raises InputError
    when the file is missing, damaged or foreign.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            _require_whole(archive)
            folder = f"{archive.namelist()[0].partition('/')[0]}/data/weights"
            weights = {}
            for name, entry in json.loads(archive.read(f"{folder}/model_weights_config.json"))["config"].items():
                values = torch.frombuffer(bytearray(archive.read(f"{folder}/{entry['path_name']}")), dtype=torch.float32)
                weights[name] = values.view([size["as_int"] for size in entry["tensor_meta"]["sizes"]])
            return weights
    except FileNotFoundError:
        raise InputError(f"{path} does not exist: --evaluate takes a policy.pt2 file") from None
    except Exception as error:  # whatever a damaged or hostile file provokes
        raise InputError(f"{path} is not a whole exported policy ({first_line(error)})") from None


# What a person looks at


def plot_learning_curve(path, tables, title, reward_threshold=None, random_return=None):
    """Draws a run's returns with their spread beside its losses and mean Q, from the rows of `train` and `eval`."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 4), layout="constrained")
    returns, losses, values = figure.subplots(1, 3)
    rows = tables.get("eval", [])
    steps, mean, spread = (np.array([row[key] for row in rows]) for key in ("step", "average_return", "std_return"))
    returns.plot(steps, mean, marker=".", label="deterministic policy, mean ± std")
    returns.fill_between(steps, mean - spread, mean + spread, alpha=0.2)
    if random_return is not None:
        returns.axhline(random_return, color="gray", linestyle=":", label="random policy")
    if reward_threshold is not None:
        returns.axhline(reward_threshold, color="green", linestyle="--", label="the task's threshold")
    returns.set(title=title, xlabel="gradient updates", ylabel="return")
    returns.legend(fontsize="small")
    rows = tables.get("train", [])
    for axes, keys, label in ((losses, ("loss", "critic_loss"), "loss"), (values, ("mean_q",), "mean Q")):
        for key in keys:
            if rows and key in rows[0]:
                axes.plot([row["step"] for row in rows], [row[key] for row in rows])
        axes.set(title=label, xlabel="gradient updates")
    losses.set_yscale("log")
    write_atomically(path, lambda file: figure.savefig(file, format="png", dpi=100))


def record_video(path, env, act, seed):
    """Films one episode in real time, at 50 frames a second or fewer.

    `env` renders `rgb_array`; `act(observation)` returns an action. The environment is closed afterwards, and the file
    is whole or not there.
    """
    import imageio

    os.environ.setdefault("SDL_VIDEODRIVER", "dummy")  # pygame draws into memory and needs no display
    frames_per_second = env.metadata["render_fps"]
    skip = math.ceil(frames_per_second / 50)
    with contextlib.closing(env), replacing(path) as temporary:
        writer = imageio.get_writer(temporary, fps=frames_per_second / skip, macro_block_size=2)
        with contextlib.closing(writer) as video:  # its own context leaves it open after an error
            observation, _ = env.reset(seed=seed)
            done, step = False, 0
            while not done:
                if step % skip == 0:
                    video.append_data(env.render())
                observation, _, terminated, truncated, _ = env.step(act(observation))
                done, step = terminated or truncated, step + 1
            video.append_data(env.render())


def require_finite(step, metrics):
    """Raises RunError naming the step and the first of `metrics`, a dict of scalar tensors, that is not finite."""
    if not metrics:
        return
    values = torch.stack(list(metrics.values())).tolist()  # one wait for a GPU instead of one for each
    for name, value in zip(metrics, values):
        if not math.isfinite(value):
            raise RunError(f"{name} is {value} at step {step}; the last good checkpoint is kept")


def evaluate_policy_file(config, make_env, make_policy, evaluate, film):
    """What `--evaluate PATH` does: plays the exported policy's episodes, prints their returns and films one.

    `make_policy(weights, observation_space, action_space)` returns the script's own policy with these weights.
    """
    weights = load_weights(config.evaluate)
    with make_env(config.env_id) as env:
        try:
            policy = make_policy(weights, env.observation_space, env.action_space)
        except (KeyError, ValueError, RuntimeError):  # no layers, or others
            raise InputError(f"{config.evaluate} is not a policy for {config.env_id}: name its task with --env-id") from None
    seeds = [episode_seed(config.seed, EVALUATION_KEY, i) for i in range(config.num_eval_episodes)]
    returns, lengths = zip(*(evaluate(policy, config.env_id, seed) for seed in tqdm(seeds, disable=None)))
    print(
        f"{config.evaluate}: AverageReturn = {np.mean(returns):.6f} ± {np.std(returns):.6f}, "
        f"AverageEpisodeLength = {np.mean(lengths):.6f} ± {np.std(lengths):.6f}"
    )
    if config.video:
        path = Path(config.evaluate).with_suffix(".mp4")
        try:
            film(policy, config.env_id, seeds[0], path)
            print(f"filmed one episode: {path}")
        except Exception as error:
            print(f"warning: no video ({first_line(error)})")
