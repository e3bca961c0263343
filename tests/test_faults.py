"""Damaged and hostile files, full disks, dead workers, losses that are not numbers: one line, and nothing is lost."""

import contextlib
import importlib
import io
import json
import os
import pickle
import resource
import shutil
import signal
import subprocess
import zipfile
from functools import partial
from pathlib import Path
from unittest import mock

import gymnasium as gym
import imageio
import numpy as np
import pytest
import torch

import common
from runs import SCRIPTS, TASK, Process, checkpoint, flags, rows, session, wait_until
from test_resume import assert_same_run, before_call, before_update, die, finish, interrupt
from test_resume import reference, script  # noqa: F401 (fixtures)


def assert_one_line(run, status, *words):
    assert run.wait() == status, (run.stdout, run.stderr)
    lines = run.stderr.strip().split("\n")
    assert len(lines) == 1 and lines[0].startswith("error: "), run.stderr
    assert all(word in lines[0] for word in words), lines[0]


# Files


def rewrite(source, target, records):
    """Copies a zip archive with the records given replaced or added."""
    with zipfile.ZipFile(source) as archive, zipfile.ZipFile(target, "w") as copy:
        root = archive.namelist()[0].partition("/")[0]
        records = {f"{root}/{name}": data for name, data in records.items()}
        for name in archive.namelist():
            if name not in records:
                copy.writestr(name, archive.read(name))
        for name, data in records.items():
            copy.writestr(name, data)


def read(path, name):
    with zipfile.ZipFile(path) as archive:
        return archive.read(f"{archive.namelist()[0].partition('/')[0]}/{name}")


class CreatesFile:
    """Its pickle creates a file where it is loaded."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return open, (str(self.path), "w")


def saved(*objects):
    torch.save(objects if len(objects) > 1 else objects[0], buffer := io.BytesIO())
    return buffer.getvalue()


def flip_a_byte(path):
    """In the largest record's data, which no parser looks at."""
    with zipfile.ZipFile(path) as archive:
        info = max(archive.infolist(), key=lambda info: info.file_size)
    data = bytearray(path.read_bytes())
    data[info.header_offset + 200 + info.file_size // 2] ^= 1
    path.write_bytes(data)


def truncate(path):
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


DAMAGES = {
    "truncated": truncate,
    "a flipped bit": flip_a_byte,
    "empty": lambda path: path.write_bytes(b""),
    "text": lambda path: path.write_text("a shopping list\n"),
    "a pickle": lambda path: path.write_bytes(pickle.dumps({"format": 1})),
    "another archive": lambda path: path.write_bytes(saved({"weights": torch.zeros(3)})),
    "a list": lambda path: path.write_bytes(saved([1, 2])),
}


def change(path, **values):
    torch.save(torch.load(path, weights_only=True) | values, path)


@pytest.fixture
def copy(reference, tmp_path):  # noqa: F811
    """A finished run, to be damaged."""
    return shutil.copytree(reference, tmp_path / "run")


def test_damaged_or_foreign_checkpoint(script, copy, tmp_path):  # noqa: F811
    whole = (copy / "checkpoint.pt").read_bytes()
    foreign = {"script": partial(change, script="td3_ant"), "format": partial(change, format=0)}
    for name, damage in (DAMAGES | foreign | {"missing": Path.unlink}).items():
        (copy / "checkpoint.pt").write_bytes(whole)
        damage(copy / "checkpoint.pt")
        with pytest.raises(common.InputError, match="checkpoint.pt") as error:
            common.load_checkpoint(copy / "checkpoint.pt", script, common.Ranks())
        assert "\n" not in str(error.value), name
    assert_one_line(Process(script, ["--resume", copy], tmp_path / "missing"), 2, "checkpoint.pt")


def test_checkpoint_of_another_version(script, copy, tmp_path):  # noqa: F811
    """It has a field more or one less: what that would have to be, nobody knows."""
    path = copy / "checkpoint.pt"
    state = torch.load(path, weights_only=True)
    config = state["shared"]["config"]
    older = {name: value for name, value in config.items() if name != "observation_scaling"}
    for changed, field in ((older, "observation_scaling"), (config | {"wings": 2}, "wings")):
        torch.save(state | {"shared": state["shared"] | {"config": changed}}, path)
        assert_one_line(Process(script, ["--resume", copy], tmp_path / field), 2, "checkpoint.pt", "version", field)


def test_one_script_does_not_continue_the_other(script, reference, tmp_path):  # noqa: F811
    other = SCRIPTS[1 - SCRIPTS.index(script)]
    assert_one_line(Process(other, ["--resume", reference], tmp_path / "resume"), 2, f"checkpoint of {script}")
    run = Process(other, ["--evaluate", reference / "policy.pt2", "--no-video", *TASK[other]], tmp_path / "evaluate")
    assert_one_line(run, 2, "policy.pt2", "--env-id")


def test_damaged_or_foreign_policy(script, copy, tmp_path):  # noqa: F811
    path = copy / "policy.pt2"
    whole = path.read_bytes()
    cases = DAMAGES | {"a checkpoint": lambda path: shutil.copy(copy / "checkpoint.pt", path)}
    for name, damage in cases.items():
        path.write_bytes(whole)
        damage(path)
        with pytest.raises(common.InputError, match="policy.pt2") as error:
            common.load_weights(path)
        assert "\n" not in str(error.value), name
    assert_one_line(Process(script, ["--evaluate", path], tmp_path / "evaluate"), 2, "policy.pt2")
    with pytest.raises(common.InputError, match="no.pt2 does not exist"):
        common.load_weights(tmp_path / "no.pt2")


def test_whole_policy_is_evaluated(script, reference, tmp_path):  # noqa: F811
    arguments = ["--evaluate", reference / "policy.pt2", "--no-video", "--num-eval-episodes", 1, *TASK[script]]
    assert "AverageReturn = " in finish(script, arguments, tmp_path / "output").stdout
    module = importlib.import_module(script)
    weights = common.load_weights(reference / "policy.pt2")
    with module.make_env(checkpoint(reference)["shared"]["config"]["env_id"]) as env:
        policy = module.make_policy(weights, env.observation_space, env.action_space)
        observations = torch.randn(50, *env.observation_space.shape)
    assert torch.equal(policy(observations), torch.export.load(reference / "policy.pt2").module()(observations))


def test_hostile_checkpoint_is_not_executed(reference, tmp_path):  # noqa: F811
    created = tmp_path / "created"
    state = torch.load(reference / "checkpoint.pt", weights_only=True)
    for data in (saved(state | {"format": CreatesFile(created)}), pickle.dumps(CreatesFile(created))):
        (tmp_path / "checkpoint.pt").write_bytes(data)
        with pytest.raises(common.InputError):
            common.load_checkpoint(tmp_path / "checkpoint.pt", "sac_minitaur", common.Ranks())
        assert not created.exists()


def hostile_policies(path, created):
    """(name, bytes) of policies that would create a file when PyTorch loads and calls them."""
    evil, python = CreatesFile(created), f"__import__('os').open({str(created)!r}, 64)"
    graph = json.loads(read(path, "models/model.json"))
    weights = json.loads(read(path, "data/weights/model_weights_config.json"))
    next(iter(weights["config"].values()))["use_pickle"] = True
    records = {
        "sample inputs": {"data/sample_inputs/model.pt": saved((evil,))},
        "guard": {"models/model.json": json.dumps(graph | {"guards_code": [python]})},
        "pickled weight": {
            "data/weights/model_weights_config.json": json.dumps(weights),
            "data/weights/weight_0": saved(evil),
        },
        "weights of an old format": {"data/weights/model.pt": saved(evil)},
        "constants of an old format": {"data/constants/model.pt": saved(evil)},
    }
    for name, replaced in records.items():
        rewrite(path, target := path.with_name("hostile.pt2"), replaced)
        yield name, target.read_bytes()
    with zipfile.ZipFile(buffer := io.BytesIO(), "w") as archive:  # the format before PyTorch 2.8
        archive.writestr("version", f"{graph['schema_version']['major']}.{graph['schema_version']['minor']}")
        archive.writestr("serialized_exported_program.json", json.dumps(graph))
        for part in ("state_dict", "constants", "example_inputs"):
            archive.writestr(f"serialized_{part}.pt", saved(evil))
    yield "old format", buffer.getvalue()


@pytest.mark.filterwarnings("ignore")
def test_hostile_policy_is_not_executed(script, reference, tmp_path):  # noqa: F811
    """PyTorch's own loader shows that each of the files does create one."""
    observations = torch.zeros(2, 3 if script == "sac_minitaur" else 4)
    path, created = tmp_path / "policy.pt2", tmp_path / "created"
    for name, data in hostile_policies(shutil.copy(reference / "policy.pt2", path), created):
        (tmp_path / "hostile.pt2").write_bytes(data)
        with contextlib.suppress(common.InputError):  # or only its weights were looked at
            common.load_weights(tmp_path / "hostile.pt2")
        assert not created.exists(), name
        with contextlib.suppress(Exception):
            torch.export.load(tmp_path / "hostile.pt2").module()(observations)
        assert created.exists(), name
        created.unlink()
    path.write_bytes(pickle.dumps(CreatesFile(created)))
    with pytest.raises(common.InputError):
        common.load_weights(path)
    assert not created.exists()


# Disks


@pytest.fixture
def small_disk(tmp_path):
    """A file system of 4 MB."""
    path = tmp_path / "disk"
    path.mkdir()
    mount = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=4m", "tmpfs", path], capture_output=True, text=True)
    if mount.returncode:
        pytest.skip(f"mounting a small disk is not permitted here: {mount.stderr.strip()}")
    yield path
    subprocess.run(["umount", path], check=True)


def fill(path):
    with open(path, "wb", buffering=0) as file:
        try:
            while file.write(bytes(4096)):
                pass
        except OSError:
            pass


def test_full_disk(script, small_disk, reference, tmp_path):  # noqa: F811
    """The run says so and stops. With room again it continues, to the same end."""
    hook = partial(fill_disk, path=small_disk / "other people's")
    run = Process(script, flags(script, small_disk / "run", "--num-envs", 2), tmp_path / "output", hook)
    assert_one_line(run, 1, "No space left on device", "checkpoint is kept")
    state = checkpoint(small_disk / "run")
    assert 0 < state["shared"]["step"] < 300
    for path in (small_disk / "run").glob("*.csv"):
        rows(path)
    (small_disk / "other people's").unlink()
    finish(script, ["--resume", small_disk / "run"], tmp_path / "resumed")
    assert_same_run(small_disk / "run", reference)


def fill_disk(module, path):
    before_update(module, 110, lambda: fill(path))


def test_full_disk_from_the_start(script, small_disk, tmp_path):  # noqa: F811
    fill(small_disk / "other people's")
    run = Process(script, flags(script, small_disk / "run"), tmp_path / "output")
    run.wait()
    assert run.status and len(run.stderr.strip().split("\n")) == 1, run.stderr


def test_console_on_a_full_disk(script, tmp_path):  # noqa: F811
    run = Process(script, flags(script, tmp_path / "run"), tmp_path / "output", print_to_a_full_disk)
    assert_one_line(run, 1, "No space left")


def print_to_a_full_disk(module):
    os.dup2(os.open("/dev/full", os.O_WRONLY), 1)


def test_rows_are_whole_or_not_there(tmp_path):
    """A write that the disk has room for in part only."""
    path = tmp_path / "train.csv"
    common.append_whole(path, b"step,loss\n1,2\n")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20, limits[1]))
    try:
        with pytest.raises(OSError):
            common.append_whole(path, b"2," + b"3" * 100 + b"\n")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert path.read_bytes() == b"step,loss\n1,2\n"


# Processes. `Process.wait` asserts each time that nothing of the run has outlived it.


def test_dead_environment_worker(tmp_path):
    arguments = flags("sac_minitaur", tmp_path / "run", "--num-envs", 2)
    run = Process("sac_minitaur", arguments, tmp_path / "output", kill_environment)
    assert_one_line(run, 1, "worker process died", "--resume")
    assert checkpoint(tmp_path / "run")["shared"]["step"] == 0


def kill_environment(module):
    step = gym.vector.AsyncVectorEnv.step_async
    calls = iter(range(100))

    def step_async(self, actions):
        step(self, actions)
        if next(calls) == 30:
            os.kill(self.processes[1].pid, signal.SIGKILL)

    gym.vector.AsyncVectorEnv.step_async = step_async


def test_dead_evaluation_worker(script, tmp_path):  # noqa: F811
    # Networks larger than a pipe: what is queued for the dead worker must not hold up the end.
    large = ["--layers" if script == "dqn_cartpole" else "--actor-layers", 256, 256, "--num-eval-episodes", 20]
    run = Process(script, flags(script, tmp_path / "run", *large), tmp_path / "output", die_evaluating)
    assert_one_line(run, 1, "worker process died", "--resume")


def die_evaluating(module):
    before_call(module, "act", 3, die)


def test_films_both_agents_without_a_display(script, tmp_path):  # noqa: F811
    arguments = flags(script, tmp_path / "run", "--video", "--num-iterations", 20)
    run = Process(script, arguments, tmp_path / "output", XDG_RUNTIME_DIR="")
    assert run.wait() == 0 and not run.stderr, run.stderr
    for name in ("trained_agent.mp4", "random_agent.mp4"):
        with imageio.get_reader(tmp_path / "run" / name) as video:
            frames = [np.asarray(frame) for frame in video]
        assert len(frames) > 5 and frames[0].std() > 0 and (frames[0] != frames[-1]).any()


class Blinking(gym.Env):
    """Thirty steps at 120 a second."""

    metadata = {"render_fps": 120}

    def reset(self, *, seed=None, options=None):
        self.steps = 0
        return 0, {}

    def step(self, action):
        self.steps += 1
        return 0, 0.0, self.steps == 30, False, {}

    def render(self):
        return np.full((16, 16, 3), 8 * self.steps, np.uint8)


def test_films_in_real_time_at_50_frames_a_second_or_fewer(tmp_path):
    common.record_video(tmp_path / "film.mp4", Blinking(), lambda observation: 0, seed=0)
    with imageio.get_reader(tmp_path / "film.mp4") as video:
        brightness = [frame.mean() for frame in video]
        assert video.get_meta_data()["fps"] == 40
    assert brightness == pytest.approx([24 * i for i in range(11)], abs=3)  # every third step, and the last
    assert [path.name for path in tmp_path.iterdir()] == ["film.mp4"]


def test_a_video_that_fails_leaves_nothing(tmp_path):
    env = Blinking()
    env.close = mock.Mock()
    with mock.patch.object(env, "render", side_effect=[np.zeros((16, 16, 3), np.uint8), ValueError]):
        with pytest.raises(ValueError):
            common.record_video(tmp_path / "film.mp4", env, lambda observation: 0, seed=0)
    env.close.assert_called_once_with()
    assert not any(tmp_path.iterdir())


def test_failing_video_costs_a_line_only(script, tmp_path):  # noqa: F811
    arguments = flags(script, tmp_path / "run", "--video", "--num-iterations", 20)
    run = finish(script, arguments, tmp_path / "output", die_filming)
    assert "warning: no video" in run.stdout and not run.stderr
    assert (tmp_path / "run" / "learning_curve.png").exists()


def die_filming(module):
    before_call(common, "record_video", 1, die)


def test_workers_end_with_the_main_process(script, tmp_path):  # noqa: F811
    """Which is killed in the midst of everything, while its workers work."""
    run = Process(script, flags(script, tmp_path / "run", "--num-iterations", 10**6), tmp_path / "output")
    wait_until((tmp_path / "run" / "train.csv").exists, seconds=600)
    assert len(session(run.pid)) > 1
    run.kill()
    assert run.wait() == -signal.SIGKILL


def test_interrupted_evaluation_of_a_policy(script, reference, tmp_path):  # noqa: F811
    arguments = ["--evaluate", reference / "policy.pt2", *TASK[script]]
    run = Process(script, arguments, tmp_path / "output", interrupt_acting)
    assert run.wait() == 130 and not run.stderr


def interrupt_acting(module):
    before_call(module, "act", 3, interrupt)


def test_runs_that_start_at_once_have_directories_of_their_own(script, tmp_path, monkeypatch):  # noqa: F811
    monkeypatch.chdir(tmp_path)
    config = importlib.import_module(script).Config(device="cpu", num_eval_episodes=1)
    runs = [common.Run(config, script, len) for _ in range(2)]
    for run in runs:
        run.evaluations.close()
    assert runs[0].path != runs[1].path and runs[0].path.parent == runs[1].path.parent == Path("runs")


def test_evaluations_take_the_cores_they_may_use():
    allowed = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(allowed)})
    try:
        evaluations = common.Evaluations(len, "", range(8), common.Ranks())
    finally:
        os.sched_setaffinity(0, allowed)
    workers = len(evaluations.pool._processes)
    evaluations.close()
    assert workers == 1


# Losses


class NanReward(gym.RewardWrapper):
    """Gives rewards that are not numbers from its 30th step on."""

    left = 30

    def reward(self, reward):
        self.left -= 1
        return reward if self.left > 0 else np.nan


def with_nan_rewards(module):
    make_training_env = module.make_training_env
    module.make_training_env = lambda *args: NanReward(make_training_env(*args))


def test_loss_that_is_not_a_number(script, tmp_path):  # noqa: F811
    """Stops the run at once, with the step and the part, and no checkpoint has taken it in."""
    few = ["--initial-collect-steps", 26, "--checkpoint-interval", 1, "--eval-interval", 10**6]
    run = Process(script, flags(script, tmp_path / "run", *few), tmp_path / "output", with_nan_rewards)
    assert_one_line(run, 1, "loss is nan at step ", "checkpoint is kept")
    step = int(run.stderr.split("at step ")[1].split(";")[0])
    state = checkpoint(tmp_path / "run")["shared"]
    assert state["step"] == step - 1
    assert all(tensor.isfinite().all() for tensor in tensors(state["agent"]) if tensor.dim())


def tensors(tree):
    if isinstance(tree, torch.Tensor):
        yield tree
    elif isinstance(tree, (dict, list, tuple)):
        for value in tree.values() if isinstance(tree, dict) else tree:
            yield from tensors(value)
