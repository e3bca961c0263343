"""What both scripts need besides their algorithms: the command line, files, workers, and a run's tables and films.

One class belongs to the learning itself: `ObservationScaling`, a part of both policies.
"""

import atexit
import contextlib
import copy
import csv
import dataclasses
import functools
import gc
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
from concurrent import futures
from datetime import datetime
from pathlib import Path
from typing import Annotated

import cloudpickle
import gymnasium as gym
import numpy as np
import torch
import torch.distributed as dist
import tyro
from pydantic import ConfigDict, Field
from tqdm import tqdm

FILE_FORMAT = 5  # of checkpoints and policies
MAY_CHANGE_ON_RESUME = ("num_iterations", "device", "num_threads", "cuda_graph", "video")

# The types of the scripts' options
CONFIG = ConfigDict(extra="forbid", allow_inf_nan=False, hide_input_in_errors=True)
Fraction = Annotated[float, Field(ge=0, le=1)]
Below1 = Annotated[float, Field(ge=0, lt=1)]
Seed = Annotated[int, Field(ge=0, lt=2**63)]
Task = Annotated[str, Field(pattern=r"^(\w[\w.]*:)?[^:]+$")]  # CartPole-v1, or my_module:MyTask-v0
Device = Annotated[str, Field(pattern=r"^(auto|cpu|mps|cuda(:[1-9]?\d)?)$")]
Count = Annotated[int, Field(ge=1, le=1024)]  # of environments, of threads
Layers = tuple[Annotated[int, Field(ge=1, le=10_000)], ...]


class InputError(Exception):
    """Something the user gave cannot be used. The message is one line: what is wrong and what would be right."""


def run_main(main):
    """Calls `main` as a script does: an InputError becomes one line and exit status 2, Ctrl-C exit status 130."""
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):  # a notebook's lack it
            stream.reconfigure(errors="replace")  # a console without an α shows a question mark
    os.environ.setdefault("PYDANTIC_ERRORS_INCLUDE_URL", "0")  # a message says enough
    atexit.register(gc.freeze)  # saves a second at exit: no search for garbage among all that was imported
    try:
        main()
        return
    except InputError as error:
        print(f"error: {error}", file=sys.stderr, flush=True)
        status = 2
    except KeyboardInterrupt:
        status = 130
    if dist.is_initialized():
        os._exit(status)  # torchrun's other processes are not waited for: they may be gone
    sys.exit(status)


def say(line):
    """Prints a line at once, above the progress bar."""
    tqdm.write(line)
    sys.stdout.flush()


def one_line(error):
    """An exception's message in one line, or its type where it has none."""
    return " ".join(str(error).split())[:200] or type(error).__name__


# The command line


@dataclasses.dataclass
class Source:
    """Where the defaults of the other flags come from: `Config`, or one of these."""

    tutorial: bool = False  # set every value marked "ours" back to the tutorials'; other flags override it
    resume: Path | None = None  # directory of a run to continue from its last checkpoint
    evaluate: Path | None = None  # a run's policy.pt to evaluate and film instead of training


def read_command_line(script, config_class, tutorial, description):
    """The config, --resume's directory or None, and --evaluate's file or None. Raises InputError.

    The command line is read twice. The first reading finds the `Source` alone. It decides the defaults of the second:
    those of `config_class`, with the dict `tutorial` over them for --tutorial, or the config of a saved run or policy.
    """
    given, _ = tyro.cli(Source, return_unknown_args=True, add_help=False)
    if sum(bool(value) for value in vars(given).values()) > 1:
        raise InputError("--tutorial, --resume and --evaluate exclude each other: give one of them")
    if given.resume is not None:
        _, default = read_file(given.resume / "checkpoint.pt", "checkpoint", script, config_class)
    elif given.evaluate is not None:
        _, saved = read_file(given.evaluate, "policy", script, config_class)
        default = dataclasses.replace(saved, video=True)  # a run without films can be filmed here
    else:
        default = config_class(**tutorial) if given.tutorial else config_class()

    @dataclasses.dataclass
    class Command(Source):
        config: tyro.conf.OmitArgPrefixes[config_class] = default

    command = tyro.cli(Command, description=description)
    return command.config, command.resume, command.evaluate


def continued(config, resume, script):
    """The config to train with, and the checkpoint of the run in the directory `resume`; for a new run it is None.

    A run that continues takes `MAY_CHANGE_ON_RESUME` from `config`, and all else from its checkpoint. Raises InputError
    where another value differs from both the run's and the default.
    """
    if resume is None:
        return config, None
    checkpoint, saved = read_file(Path(resume) / "checkpoint.pt", "checkpoint", script, type(config))
    saved = dataclasses.replace(saved, run_dir=Path(resume))  # where it lies now
    if config.num_iterations < saved.num_iterations:
        raise InputError(f"--num-iterations {config.num_iterations} is less than the run's {saved.num_iterations}")
    changes = {}
    for field in dataclasses.fields(config):
        new = getattr(config, field.name)
        old = getattr(saved, field.name)
        if field.name in MAY_CHANGE_ON_RESUME:
            changes[field.name] = new
        elif new not in (old, field.default):  # from Python a default may mean that nothing was given
            flag = "--" + field.name.replace("_", "-")
            raise InputError(f"{flag} {new} differs from the {old} of the run to resume: leave it out")
    return dataclasses.replace(saved, **changes), checkpoint


# Files


@contextlib.contextmanager
def whole_file(path):
    """Opens a temporary file, and renames it when it is written: a kill leaves the old file or the new one."""
    temporary = path.with_name(f".tmp-{path.name}")
    try:
        with open(temporary, "wb") as file:
            yield file
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def read_file(path, kind, script, config_class):
    """What `Run` saved in a "checkpoint" or "policy" of this script, on the CPU, and its config.

    Nothing in the file is executed. Raises InputError when it is missing, torn or foreign.
    """
    needed = f"a {kind} of {script}, format {FILE_FORMAT}"
    try:
        with zipfile.ZipFile(path):  # torch.load would also try the formats from before 2020
            state = torch.load(path, map_location="cpu", weights_only=True)
        found = f"a {state['kind']} of {state['script']}, format {state['format']}"
        if found != needed:
            raise ValueError(f"it is {found}")
        return state, config_class(**state["config"])
    except Exception as error:  # whatever a torn or hostile file provokes
        hint = "--resume takes a run's directory, --evaluate its policy.pt"
        raise InputError(f"{path} cannot be used as {needed} ({one_line(error)}): {hint}") from None


def export_policy(path, policy, observation_shape):
    """Writes `policy`, for any batch size, so that `torch.export.load(path).module()` needs none of our code."""
    batch = torch.zeros((2, *observation_shape))
    program = torch.export.export(policy, (batch,), dynamic_shapes=({0: torch.export.Dim("batch")},))
    with whole_file(path) as file:
        torch.export.save(program, file)


# Tasks, seeds, devices


def draw_without_display():
    """Lets pygame and MuJoCo draw into memory. It must come before they are imported."""
    os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
    if sys.platform == "linux" and "DISPLAY" not in os.environ:
        os.environ.setdefault("MUJOCO_GL", "egl")


def find_task(config, needed, training=True):
    """The gymnasium spec of --env-id, with a time limit, and its observation and action spaces.

    Raises InputError when the task is unknown, or its action space is not what is `needed`, `gym.spaces.Discrete` or
    `Box`; for `training` also when no episode can reach the task's time limit between two checkpoints.
    """
    draw_without_display()
    name = f"--env-id {config.env_id}"
    try:
        env = gym.make(config.env_id, max_episode_steps=config.max_episode_steps)
    except gym.error.Error as error:
        hint = "a package's task is written package:Task-v0, as highway_env:highway-v0"
        raise InputError(f"{name} cannot be made: {one_line(error)} ({hint})") from None
    except ImportError as error:
        raise InputError(f"{name} cannot be made: {one_line(error)}") from None
    with env:
        require_spaces(name, env.observation_space, env.action_space, needed)
        for wrapper in ("NormalizeObservation", "NormalizeReward"):
            if wrapper in str(env):  # which names all wrappers
                say(f"warning: evaluations have their own {wrapper}: it cannot know the statistics of training")
        limit = env.spec.max_episode_steps  # the flag's, if there is one
        task = gym.spec(env.unwrapped.spec.id)  # not env.spec: gym.make may refuse the wrappers in it
    if training and limit and limit > config.checkpoint_interval * config.collect_steps_per_iteration:
        what = f"--checkpoint-interval {config.checkpoint_interval} cuts each episode of {limit} steps"
        raise InputError(f"{what} before its end: use a larger one, or a smaller --max-episode-steps")
    task = dataclasses.replace(task, max_episode_steps=limit or 1_000)
    return task, env.observation_space, env.action_space


def require_spaces(name, observations, actions, needed):
    """Raises InputError unless a task's spaces are a Box, and a Discrete from 0 for DQN or a Box of floats for SAC."""
    if not isinstance(observations, gym.spaces.Box) or not observations.shape:
        hint = "gymnasium.wrappers.FlattenObservation makes one of most others"
        raise InputError(f"{name} has the observation space {observations}: a Box of some dimension is needed ({hint})")
    if needed is gym.spaces.Discrete:
        fits = isinstance(actions, gym.spaces.Discrete) and actions.start == 0
    else:
        floats = isinstance(actions, gym.spaces.Box) and np.issubdtype(actions.dtype, np.floating)
        fits = floats and actions.shape and actions.is_bounded()
    if not fits:
        what = "dqn_cartpole.py needs a Discrete from 0, sac_minitaur.py a Box of floats with bounds"
        hint = "gymnasium.wrappers.TransformAction can map others"
        raise InputError(f"{name} has the action space {actions}: {what} ({hint})")


class ObservationScaling(torch.nn.Module):
    """Brings flat observations (…, O) near [-1, 1], number by number. It is a part of the policy.

    What has bounds in the task's space is mapped from them. `fit` corrects this by data. All else stays as it is.
    """

    def __init__(self, space):
        super().__init__()
        low = torch.from_numpy(np.float32(space.low)).flatten()
        high = torch.from_numpy(np.float32(space.high)).flatten()
        half_range = (high - low) / 2
        bounded = half_range.isfinite() & (half_range > 0)
        self.register_buffer("bounded", bounded)
        self.register_buffer("center", torch.where(bounded, low + half_range, 0.0))
        self.register_buffer("half_range", torch.where(bounded, half_range, 1.0))

    def fit(self, observations):
        """Corrects the scales by observations (N, O) of random actions.

        Bounds over 130 times wider than the data are dropped: scaled by them, all observations would come near one
        number. A number without bounds is centred and scaled by its data if these lie beyond ±10. They then fill half
        of [-1, 1], since what a better policy sees lies farther out.
        """
        low = observations.amin(0)
        high = observations.amax(0)
        average([low, high])  # in place: the processes' mean extremes, so that all have the same scales
        spread = torch.where(high > low, (high - low) / 2, 1.0)  # half the range of the data; 1 for a constant
        self.bounded &= self.half_range <= 130 * spread  # the ratio: CartPole's is at most 84, a constant uint8's 127.5
        self.center[~self.bounded] = 0.0
        self.half_range[~self.bounded] = 1.0
        large = ~self.bounded & (torch.maximum(low.abs(), high.abs()) > 10)
        self.center.copy_(torch.where(large, (low + high) / 2, self.center))
        self.half_range.copy_(torch.where(large, 2 * spread, self.half_range))

    def forward(self, observation):
        return (observation - self.center) / self.half_range


def derive_seed(seed, *key):
    """A 32-bit seed from a run's seed and a key: numbers of the environment, process, update or episode."""
    return int(np.random.SeedSequence(seed, spawn_key=key).generate_state(1)[0])


def evaluation_seeds(config):
    """The seeds of every evaluation's episodes. Training has none of them: its keys begin with small numbers."""
    return [derive_seed(config.seed, 2**32 - 1, i) for i in range(config.num_eval_episodes)]


def select_device(name):
    """The `torch.device` for --device: each of torchrun's processes has its own GPU. Raises InputError if not there."""
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    if name == "cuda":
        name = "cuda:" + os.environ.get("LOCAL_RANK", "0")
    try:
        return torch.empty(1, device=name).device
    except (AssertionError, RuntimeError) as error:
        raise InputError(f"--device {name} cannot be used ({one_line(error)}): use --device cpu") from None


# Processes


def join_processes():
    """This process's rank among those that torchrun started, and their number."""
    if os.environ.get("WORLD_SIZE", "1") == "1":
        return 0, 1
    if not dist.is_initialized():
        dist.init_process_group("cpu:gloo,cuda:nccl" if torch.cuda.is_available() else "gloo")
    return dist.get_rank(), dist.get_world_size()


def average(tensors):
    """Replaces each tensor by its mean over torchrun's processes, in one message for all of them."""
    if not dist.is_initialized():
        return
    tensors = list(tensors)
    flat = torch.cat([tensor.flatten() for tensor in tensors])
    dist.all_reduce(flat)
    sizes = [tensor.numel() for tensor in tensors]
    for tensor, total in zip(tensors, flat.split(sizes)):
        tensor.copy_(total.view_as(tensor) / dist.get_world_size())


def start_method(env_id):
    """How to start workers: "fork" is the quickest, but a forked process lacks the main process's threads and CUDA.

    With a package (package:Task-v0) or JAX, a fork may wait for ever for threads that it lacks: workers start clean.
    """
    if sys.platform != "linux":
        return "spawn"
    if ":" not in env_id and "jax" not in sys.modules:
        return "fork"
    multiprocessing.set_forkserver_preload(["torch", "gymnasium", "tyro", "pydantic"])  # imported once for all workers
    return "forkserver"


@contextlib.contextmanager
def worker_pool(size, method):
    """A pool of `size` processes. At the end it kills each process started since then, SAC's environments, too."""
    children_before = set(multiprocessing.active_children())
    pool = futures.ProcessPoolExecutor(size, multiprocessing.get_context(method), prepare_worker)
    handler = signal.signal(signal.SIGINT, signal.SIG_IGN)  # new processes inherit it
    for _ in range(size):
        pool.submit(int)  # so that all processes start now
    signal.signal(signal.SIGINT, handler)
    try:
        yield pool
    finally:
        started = set(multiprocessing.active_children()) - children_before
        for process in started:
            process.kill()
        pool.shutdown(cancel_futures=True)
        for process in started:
            process.join()


def prepare_worker():
    """Makes a worker ignore Ctrl-C, which the main process handles, and end with that process, even if it is killed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    draw_without_display()
    if hasattr(os, "nice"):  # not on Windows
        os.nice(5)  # the main process goes first: SAC's environments, workers too, wait for its update
    torch.set_num_threads(1)
    np.random.seed()  # forked workers have equal generators, which a task may use
    torch.seed()

    def end_with_main_process():
        multiprocessing.parent_process().join()
        os._exit(1)

    threading.Thread(target=end_with_main_process, daemon=True).start()


@functools.cache
def worker_environment(task):
    """The environment of this worker, made once: a simulator may take long to start. `task` is pickled, to be a key."""
    return gym.make(pickle.loads(task))


def evaluate_in_worker(evaluate, policy, task, seed):
    """What `evaluate(policy, environment, seed)` returns, for a pickled policy and a pickled task."""
    return evaluate(pickle.loads(policy), worker_environment(task), seed)


# Evaluation, films, the curve


def summarize(results):
    """The metrics of evaluation episodes, from a list of (return, length), and a line that tells them."""
    returns, lengths = np.array(results, np.float64).T
    row = {
        "average_return": float(returns.mean()),  # float: a checkpoint may not hold numpy's own numbers
        "std_return": float(returns.std()),
        "min_return": float(returns.min()),
        "max_return": float(returns.max()),
        "average_episode_length": float(lengths.mean()),
        "std_episode_length": float(lengths.std()),
    }
    text = "AverageReturn = {average_return:.6f} +/- {std_return:.6f}, "
    text += "AverageEpisodeLength = {average_episode_length:.6f} +/- {std_episode_length:.6f}"
    return row, text.format_map(row)


def evaluate_file(path, script, config, policy_class, needed, evaluate):
    """What --evaluate PATH does: plays the episodes that its run was evaluated with, tells the returns, films one.

    `needed` is the kind of action space: see `find_task`. Raises InputError for a file that does not fit.
    """
    state, _ = read_file(path, "policy", script, type(config))
    task, observation_space, action_space = find_task(config, needed, training=False)
    policy = policy_class(config, observation_space, action_space)
    try:
        policy.load_state_dict(state["weights"])
    except RuntimeError:
        raise InputError(f"{path} does not fit {config.env_id} and this script's network") from None
    policy.eval()
    torch.set_num_threads(1)  # as in a run's evaluation: the same digits
    seeds = evaluation_seeds(config)
    with gym.make(task) as env:
        _, text = summarize([evaluate(policy, env, seed) for seed in tqdm(seeds, disable=None)])
    say(f"{path}: {text}")
    if config.video:
        video = path.with_suffix(".mp4")
        with or_warn("film"):
            film(video, task, seeds[0], [(policy, "")])
            say(f"filmed one episode: {video}")


@contextlib.contextmanager
def or_warn(what):
    """Turns an exception into a printed warning."""
    try:
        yield
    except Exception as error:
        say(f"warning: no {what} ({one_line(error)})")


def film(path, task, seed, clips, seconds=math.inf):
    """Films the first `seconds` of an episode, in real time, for each of `clips`: a policy or None, and a caption."""
    import imageio  # here: it takes a moment

    with gym.make(task, render_mode="rgb_array") as env, whole_file(path) as file:
        rate = env.metadata.get("render_fps") or 30
        skip = math.ceil(rate / 50)  # at most 50 frames a second
        options = {"fps": rate / skip, "macro_block_size": 2, "ffmpeg_log_level": "quiet"}
        with imageio.get_writer(file.name, **options) as video:  # ffmpeg opens it by its name
            for policy, caption in clips:
                for frame in frames(env, policy, seed, skip, seconds * rate):
                    video.append_data(with_caption(frame, caption))


def frames(env, policy, seed, skip, max_steps):
    """The pictures of one episode: one of every `skip` steps, and the last. `policy` None: random actions."""
    observation, _ = env.reset(seed=seed)
    env.action_space.seed(seed)
    step = 0
    done = False
    while not done and step < max_steps:
        if step % skip == 0:
            yield env.render()
        action = policy.act(observation) if policy else env.action_space.sample()
        observation, _, terminated, truncated, _ = env.step(action)
        done = terminated or truncated
        step += 1
    yield env.render()


def with_caption(frame, caption):
    """The frame (height, width, 3), uint8, with a line of text in its corner."""
    from PIL import Image, ImageDraw

    if not isinstance(frame, np.ndarray) or frame.dtype != np.uint8 or frame.ndim != 3:
        found = f"{frame.dtype} {frame.shape}" if isinstance(frame, np.ndarray) else type(frame).__name__
        raise ValueError(f"the task's render returned {found}; needed: an array of uint8, (height, width, 3)")
    image = Image.fromarray(frame)
    ImageDraw.Draw(image).text((8, 8), caption, "black", font_size=20, stroke_width=2, stroke_fill="white")
    return np.asarray(image)


def plot_learning_curve(path, tables, title, reward_threshold):
    """Draws a run's returns with their spread beside its losses and mean Q, from the rows of its tables."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 4), layout="constrained")
    returns, losses, values = figure.subplots(1, 3)
    steps = [row["step"] for row in tables["eval"]]
    mean = [row["average_return"] for row in tables["eval"]]
    spread = [row["std_return"] for row in tables["eval"]]
    returns.plot(steps, mean, marker=".", label="deterministic policy, mean ± std")
    returns.fill_between(steps, np.subtract(mean, spread), np.add(mean, spread), alpha=0.2)
    for row in tables["random"]:
        returns.axhline(row["average_return"], color="gray", linestyle=":", label="random policy")
    if reward_threshold is not None:
        returns.axhline(reward_threshold, color="green", linestyle="--", label="the task's threshold")
    returns.set(title=title, xlabel="gradient updates", ylabel="return")
    returns.legend(fontsize="small")
    for axes, name in ((losses, "loss"), (losses, "critic_loss"), (values, "mean_q")):
        rows = [row for row in tables["train"] if name in row]
        axes.plot([row["step"] for row in rows], [row[name] for row in rows])
    losses.set(title="loss", xlabel="gradient updates", yscale="log")
    values.set(title="mean Q", xlabel="gradient updates")
    with whole_file(path) as file:
        figure.savefig(file, format="png", dpi=100)


# A training run


def cpu_copy(policy, weights=None):
    """A copy of the policy for the CPU, with other weights if they are given."""
    policy = copy.deepcopy(policy).cpu().eval()
    if weights is not None:
        policy.load_state_dict(weights)
    return policy


def replay_tensors(buffer):
    """The tensors of a script's `ReplayBuffer`, by name: each has a row, (capacity, …), for a transition."""
    return {name: value for name, value in vars(buffer).items() if torch.is_tensor(value)}


def process_state(buffer, device):
    """What a checkpoint keeps of each process: the rows of its replay, on the CPU, and its random numbers' state."""
    state = {"size": buffer.size, "position": buffer.position, "random": torch.get_rng_state(), "replay": {}}
    for name, rows in replay_tensors(buffer).items():
        state["replay"][name] = rows[: buffer.size].to("cpu", copy=True)  # a slice would save all rows
    if device.type == "cuda":
        state["cuda_random"] = torch.cuda.get_rng_state(device)
    return state


def restore_process(state, buffer, device):
    """Sets what `process_state` has returned. Raises RuntimeError or ValueError for another script's replay."""
    replay = replay_tensors(buffer)
    if replay.keys() != state["replay"].keys():
        raise ValueError(f"the replay has {', '.join(replay)}, the checkpoint {', '.join(state['replay'])}")
    for name, rows in state["replay"].items():
        replay[name][: len(rows)] = rows
    buffer.size = state["size"]
    buffer.position = state["position"]
    torch.set_rng_state(state["random"])
    if device.type == "cuda" and "cuda_random" in state:
        torch.cuda.set_rng_state(state["cuda_random"], device)


def require_finite(values, step):
    """Raises FloatingPointError, naming the first of `values`, a dict of tensors or numbers, that is not finite."""
    for name, value in values.items():
        if not torch.as_tensor(value).isfinite().all():
            raise FloatingPointError(f"{name} is not finite at step {step}; the last good checkpoint is kept")


@contextlib.contextmanager
def stop_signals():
    """Yields an event that Ctrl-C and SIGTERM set. A second Ctrl-C raises KeyboardInterrupt at once."""
    requested = threading.Event()

    def request_stop(*_):
        requested.set()
        signal.signal(signal.SIGINT, signal.default_int_handler)
        # Not print: the signal may have interrupted one.
        os.write(2, b"\nstopping: saving a checkpoint first (Ctrl-C again stops at once)\n")

    on_interrupt = signal.signal(signal.SIGINT, request_stop)
    on_terminate = signal.signal(signal.SIGTERM, request_stop)
    try:
        yield requested
    finally:
        signal.signal(signal.SIGINT, on_interrupt)
        signal.signal(signal.SIGTERM, on_terminate)


class TableWriter:
    """Shows a run's tables, lists of rows, in CSVs and TensorBoard. A row is a dict of numbers."""

    def __init__(self, path, tables):
        from torch.utils.tensorboard import SummaryWriter  # here: it takes a second

        for events in path.glob("events.out.tfevents.*"):
            events.unlink()  # left before a resume: they may have rows from after the checkpoint
        self.path = path
        self.tables = tables  # the run's own lists: `add` extends them
        self.board = SummaryWriter(path)
        for table, rows in tables.items():
            for row in rows:
                self._show(table, row)

    def add(self, table, row):
        """Adds a row. A CSV has the columns of its first row: later columns go to TensorBoard alone."""
        rows = self.tables[table]
        rows.append(row)
        self._show(table, row)
        text = io.StringIO()
        columns = list(rows[0])
        writer = csv.DictWriter(text, columns, extrasaction="ignore", lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
        with whole_file(self.path / f"{table}.csv") as file:
            file.write(text.getvalue().encode())

    def _show(self, table, row):
        for column, value in row.items():
            if column != "step" and math.isfinite(value):
                self.board.add_scalar(f"{table}/{column}", value, row["step"])


class Run:
    """One training run: its workers, tables, checkpoints, evaluations, and the files at its end.

    `evaluate(policy, env, seed)` plays one episode in a worker. The loop counts `env_steps`, the environment steps of
    all environments and processes. Of torchrun's processes, number 0 alone evaluates, writes and prints.
    """

    SAVED = ("env_steps", "finished", "metrics", "best", "snapshots", "tables")  # by `save`, for `_restore`

    def __init__(self, script, config, evaluate, rank=0, world_size=1):
        """Raises InputError for a config that cannot be used. Nothing is written yet."""
        self.script = script
        self.config = config
        self.play_episode = evaluate
        self.rank = rank
        self.world_size = world_size
        self.device = select_device(config.device)
        if config.batch_size % self.world_size:
            raise InputError(f"--batch-size {config.batch_size} cannot be shared by {self.world_size} processes")
        name = f"{script}-{datetime.now():%Y%m%d-%H%M%S-%f}-seed{config.seed}"  # %f: runs may start at once
        self.path = Path(config.run_dir or Path("runs") / name)
        # The config as a dict, for files. The directory is not in it: a run may be moved.
        self.plain_config = dataclasses.asdict(config) | {"run_dir": None}
        self.env_steps = 0
        self.finished = []  # returns and lengths of the last ten training episodes that ended
        self.metrics = {}  # the latest of each: an update may not return all
        self.best = (-math.inf, None)  # return and weights of the best policy
        self.snapshots = []  # step, return and weights of some policies, for the film of how it learned
        self.tables = {"train": [], "eval": [], "random": []}
        self.started = time.perf_counter()
        self.stack = contextlib.ExitStack()  # what to end and to undo at the end, the last first

    def __enter__(self):
        self.signals = self.stack.enter_context(contextlib.ExitStack())
        self.stop_request = self.signals.enter_context(stop_signals())
        if self.rank == 0:
            size = min(os.cpu_count(), self.config.num_eval_episodes)
            self.pool = self.stack.enter_context(worker_pool(size, start_method(self.config.env_id)))
        self.stack.callback(torch.set_num_threads, torch.get_num_threads())
        torch.set_num_threads(self.config.num_threads)
        return self

    def __exit__(self, *_):
        self.stack.close()

    def begin(self, task, agent, buffer, checkpoint):
        """Restores the checkpoint, begins the files, evaluates random actions once. Returns the updates done."""
        self.task = task
        self.pickled_task = cloudpickle.dumps(task)
        self.agent = agent
        self.buffer = buffer
        step = self._restore(checkpoint) if checkpoint else 0
        self.last_logged = (step, time.perf_counter())
        hidden = True if self.rank else None  # None: shown only on a terminal
        self.progress = tqdm(total=self.config.num_iterations, initial=step, unit="step", disable=hidden)
        self.stack.callback(self.progress.close)
        if self.rank == 0:
            self._begin_files(new=checkpoint is None)
            limit = task.max_episode_steps
            config = self.config
            say(f"{config.env_id}, seed {config.seed}, episodes of at most {limit} steps, on {self.device}")
            say(f"run directory {self.path}")
        if not checkpoint:
            self.save(step)  # from here on --resume continues the run
        self.evaluate(0, policy=None)
        return step

    def _restore(self, saved):
        if len(saved["processes"]) != self.world_size:
            raise InputError(f"{self.path} was saved by {len(saved['processes'])} processes: continue it with as many")
        try:
            self.agent.load_state_dict(saved["agent"])
            for optimizer, state in zip(self.agent.optimizers, saved["optimizers"], strict=True):
                optimizer.load_state_dict(state)
            restore_process(saved["processes"][self.rank], self.buffer, self.device)
        except (RuntimeError, ValueError) as error:
            what = f"does not fit this script's networks, optimizers and replay ({one_line(error)})"
            raise InputError(f"{self.path} {what}: continue it with the script that saved it") from None
        for name in self.SAVED:
            setattr(self, name, saved[name])
        self.started = time.perf_counter() - saved["seconds"]
        return saved["step"]

    def _begin_files(self, new):
        if new:
            try:
                self.path.mkdir(parents=True)
            except (OSError, ValueError) as error:
                what = f"--run-dir {self.path} cannot be made ({one_line(error)})"
                raise InputError(f"{what}: name a new directory") from None
        with whole_file(self.path / "config.json") as file:
            file.write(json.dumps(self.plain_config, indent=2).encode())
        if self.best[1] is not None:  # after a resume: the file may have weights from after the checkpoint
            self._write("best_policy.pt", "policy", {"weights": self.best[1]})
        self.writer = TableWriter(self.path, self.tables)
        self.stack.callback(self.writer.board.close)

    def save(self, step):
        """Saves a checkpoint, and the policy for --evaluate. Raises FloatingPointError for bad weights."""
        own = process_state(self.buffer, self.device)
        processes = [own] * self.world_size if self.rank == 0 else None
        if self.world_size > 1:
            dist.gather_object(own, processes)  # fills process 0's list
        if self.rank:
            return
        agent = self.agent.state_dict()
        require_finite(agent, step)
        state = {name: getattr(self, name) for name in self.SAVED}
        state |= {"step": step, "seconds": time.perf_counter() - self.started, "processes": processes}
        state |= {"agent": agent, "optimizers": [each.state_dict() for each in self.agent.optimizers]}
        self._write("policy.pt", "policy", {"weights": cpu_copy(self.agent.policy).state_dict()})
        self._write("checkpoint.pt", "checkpoint", state)

    def _write(self, name, kind, state):
        head = {"kind": kind, "script": self.script, "format": FILE_FORMAT, "config": self.plain_config}
        with whole_file(self.path / name) as file:
            torch.save(head | state, file)

    def log_episode(self, episode_return, length):
        """Notes a training episode that has ended."""
        self.finished = [*self.finished, (float(episode_return), int(length))][-10:]

    def log(self, step, metrics):
        """Every `log_interval` updates: a row with the update's `metrics` (scalars), recent episodes and the speed.

        Raises FloatingPointError naming the step and the first metric that is not finite.
        """
        self.progress.update()
        self.metrics = self.metrics | metrics
        if self.rank or step % self.config.log_interval:
            return
        require_finite(self.metrics, step)
        values = {name: float(value) for name, value in self.metrics.items()}
        last_step, then = self.last_logged
        self.last_logged = (step, time.perf_counter())
        speed = (step - last_step) / (time.perf_counter() - then)  # evaluations and checkpoints included
        mean_return, mean_length = np.mean(self.finished or [(math.nan, math.nan)], axis=0).tolist()
        episodes = {"collect_return": mean_return, "collect_episode_length": mean_length}
        self._add_row("train", step, {"steps_per_second": speed} | episodes | values)
        losses = ", ".join(f"{name} = {value:.4g}" for name, value in values.items() if "loss" in name)
        say(f"step = {step}: {losses}, steps per second = {speed:.0f}")

    def _add_row(self, table, step, values):
        seconds = round(time.perf_counter() - self.started, 3)
        self.writer.add(table, {"step": step, "env_steps": self.env_steps, "seconds": seconds} | values)

    def evaluate(self, step, policy):
        """Plays the evaluation episodes with `policy` (None: random actions) and logs them, once for each step.

        The best policy so far is saved. A stop request ends this early: the run that continues does it again.
        """
        table = "eval" if policy else "random"
        rows = self.tables[table]
        if self.rank or (rows and rows[-1]["step"] == step):
            return
        if policy:
            policy = cpu_copy(policy)
        call = (evaluate_in_worker, self.play_episode, pickle.dumps(policy), self.pickled_task)
        episodes = [self.pool.submit(*call, seed) for seed in evaluation_seeds(self.config)]
        waiting = episodes
        while waiting and not self.stop_request.is_set():
            waiting = futures.wait(episodes, timeout=0.1).not_done
        if self.stop_request.is_set():
            return
        row, text = summarize([episode.result() for episode in episodes])
        self._add_row(table, step, row)
        say(f"step = {step}: {text}" if policy else f"random policy: {text}")
        if policy:
            self.progress.set_postfix_str(f"return {row['average_return']:.2f}")
            require_finite(policy.state_dict(), step)
            self._keep(step, row["average_return"], policy.state_dict())

    def _keep(self, step, average_return, weights):
        """Keeps the best weights so far, and some for a film: the first, each at 4 times the step before, the last."""
        due = 4 * self.snapshots[-1][0] if self.snapshots else 0  # most is learned at the beginning
        if step >= due or step == self.config.num_iterations:
            self.snapshots.append((step, average_return, weights))
        if average_return > self.best[0]:
            self.best = (average_return, weights)
            self._write("best_policy.pt", "policy", {"weights": weights})

    def stop_if_requested(self, step):
        """After Ctrl-C or SIGTERM: saves a checkpoint, tells how to continue, and raises KeyboardInterrupt."""
        requested = torch.tensor(float(self.stop_request.is_set()))
        average([requested])  # above 0 where any of torchrun's processes is to stop: then all do, together
        if requested == 0:
            return
        self.save(step)
        if self.rank == 0:
            self.progress.close()
            self._plot()
            how = f"--resume '{self.path}' (in Python: resume={str(self.path)!r})"
            say(f"stopped at step {step}; to continue: {how}")
        raise KeyboardInterrupt

    def finish(self, step, observation_shape):
        """Saves and evaluates once more, draws the curve, exports and films the policies, says where all lies."""
        self.save(step)  # before the evaluation, which a run that was longer from the start would not have here
        self.evaluate(step, self.agent.policy)
        self.stop_if_requested(step)
        if self.rank:
            return
        self.signals.close()  # all is saved: from here on Ctrl-C and SIGTERM do what they did before the run
        self.progress.close()
        self._plot()
        if self.config.video:
            self._film()
        with or_warn("exported policies"):
            export_policy(self.path / "policy.pt2", cpu_copy(self.agent.policy), observation_shape)
            export_policy(self.path / "best_policy.pt2", cpu_copy(self.agent.policy, self.best[1]), observation_shape)
        files = sorted(path.name for path in self.path.iterdir())
        say(f"finished; {self.path} holds {', '.join(files)}")

    def _plot(self):
        title = f"{self.config.env_id}, seed {self.config.seed}"
        plot_learning_curve(self.path / "learning_curve.png", self.tables, title, self.task.reward_threshold)

    def _film(self):
        say("filming the trained agent, a random one, and how it learned ...")
        seed = evaluation_seeds(self.config)[0]
        learning = []
        for step, average_return, weights in self.snapshots:
            learning.append((cpu_copy(self.agent.policy, weights), f"{step} updates: return {average_return:.1f}"))
        with or_warn("film"):
            film(self.path / "trained_agent.mp4", self.task, seed, [(cpu_copy(self.agent.policy), "")])
            film(self.path / "random_agent.mp4", self.task, seed, [(None, "")])
            film(self.path / "learning.mp4", self.task, seed, learning, seconds=4)
