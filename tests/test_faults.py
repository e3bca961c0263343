"""Damaged and hostile files, full disks, dead workers, odd consoles, losses that are not numbers: one line."""

import importlib
import io
import math
import multiprocessing
import os
import pickle
import resource
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
import zipfile
from functools import partial
from multiprocessing.process import BaseProcess
from pathlib import Path
from types import ModuleType, SimpleNamespace
from unittest import mock

import gymnasium as gym
import imageio
import numpy as np
import pytest
import torch
from matplotlib.figure import Figure

import common
import dqn_cartpole
from runs import ROOT, SCRIPTS, Process, assert_same, assert_same_run, before_call, before_update, checkpoint, die
from runs import finish, flags, interrupt, load_policy, read_command_line, read_csv, rows, session, wait_until


def assert_one_line(run, status, *words):
    assert run.wait() == status, (run.stdout, run.stderr)
    lines = run.stderr.strip().split("\n")
    assert len(lines) == 1 and lines[0].startswith("error: "), run.stderr
    assert all(word in lines[0] for word in words), lines[0]


def refusal(script, *arguments):
    """The one line that refuses this command line."""
    with pytest.raises(common.InputError, match="^[^\n]*$") as error:
        read_command_line(script, *arguments)
    return str(error.value)


class CreatesFile:
    """Its pickle creates a file where it is loaded."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return open, (str(self.path), "w")


def saved(value):
    torch.save(value, buffer := io.BytesIO())
    return buffer.getvalue()


def flip_a_byte(path):
    """In the largest record's data, which no parser looks at."""
    with zipfile.ZipFile(path) as archive:
        info = max(archive.infolist(), key=lambda info: info.file_size)
    data = bytearray(path.read_bytes())
    data[info.header_offset + 200 + info.file_size // 2] ^= 1
    path.write_bytes(data)


def change(path, **values):
    torch.save(torch.load(path, weights_only=True) | values, path)


DAMAGES = {
    "truncated": lambda path: path.write_bytes(path.read_bytes()[: path.stat().st_size // 2]),
    "a flipped bit": flip_a_byte,
    "empty": lambda path: path.write_bytes(b""),
    "text": lambda path: path.write_text("a shopping list\n"),
    "a pickle": lambda path: path.write_bytes(pickle.dumps({"format": 1})),
    "another archive": lambda path: path.write_bytes(saved({"weights": torch.zeros(3)})),
    "a list": lambda path: path.write_bytes(saved([1, 2])),
    "another script's": partial(change, script="td3_ant"),
    "another format": partial(change, format=0),
    "another kind": partial(change, kind="video"),
    "missing": Path.unlink,
}


@pytest.fixture
def copy(reference, tmp_path):
    """A finished run, to be damaged."""
    return shutil.copytree(reference, tmp_path / "run")


@pytest.mark.parametrize("name", ["checkpoint.pt", "policy.pt"])
def test_damaged_or_foreign_file(script, copy, tmp_path, name):
    whole, created = (copy / name).read_bytes(), tmp_path / "created"
    hostile = {
        "a hostile value": lambda path: path.write_bytes(saved({"format": CreatesFile(created)})),
        "a hostile pickle": lambda path: path.write_bytes(pickle.dumps(CreatesFile(created))),
    }
    arguments = ["--resume", copy] if name == "checkpoint.pt" else ["--evaluate", copy / name]
    for what, damage in (DAMAGES | hostile).items():
        (copy / name).write_bytes(whole)
        damage(copy / name)
        assert str(copy / name) in refusal(script, *arguments), what
        assert not created.exists(), what
    assert_one_line(Process(script, arguments, tmp_path / "output"), 2, name)


def test_checkpoint_of_another_version(script, copy):
    """It has a field more or one less: nobody knows its value. One that may differ on resume has its default.

    The policy of another version is evaluated all the same.
    """
    module, config = importlib.import_module(script), checkpoint(copy)["config"]
    older = {name: value for name, value in config.items() if name != "gamma"}
    for changed, field in ((older, "gamma"), (config | {"wings": 2}, "wings")):
        change(copy / "checkpoint.pt", config=changed)
        message = refusal(script, "--resume", copy)
        assert "another version" in message and field in message
        everything = vars(module.Config()) | {"resume": copy}  # as dataclasses.replace gives it
        with pytest.raises(common.InputError, match=f"another version .*{field}"):
            module.Config(**everything)
    change(copy / "policy.pt", config=older | {"wings": 2})
    assert finish(script, ["--evaluate", copy / "policy.pt", "--no-video"], copy / "output").status == 0
    change(copy / "checkpoint.pt", config={name: value for name, value in config.items() if name != "num_threads"})
    finish(script, ["--resume", copy], copy / "continued")
    change(copy / "checkpoint.pt", config=config | {"gamma": 2.0})
    assert "no good" in (message := refusal(script, "--resume", copy)) and "gamma" in message


def test_what_resume_and_evaluate_do_not_take(script, reference):
    resume, evaluate = ["--resume", reference], ["--evaluate", reference / "policy.pt"]
    assert "give one of them" in refusal(script, *resume, *evaluate)
    module = importlib.import_module(script)
    with pytest.raises(common.InputError, match="train does not evaluate"):
        module.train(module.Config(evaluate=reference / "policy.pt"))
    other = SCRIPTS[1 - SCRIPTS.index(script)]
    assert f"is a checkpoint of {script}" in refusal(other, *resume)
    assert f"is a policy of {script}" in refusal(other, *evaluate)
    for flag, path in (("--evaluate", ""), ("--resume", "checkpoint.pt"), ("--evaluate", "policy.pt2")):
        assert "--resume takes a run's directory, --evaluate its policy.pt" in refusal(script, flag, reference / path)


def test_a_fork_that_was_changed_since(script, copy, tmp_path):
    """Its network is larger now, it has one more optimizer or one of another kind, or the parameters have groups."""
    saved = checkpoint(copy)
    larger = {name: torch.stack((value, value)) for name, value in saved["agent"].items()}
    first, *others = saved["optimizers"]
    grouped = first | {"param_groups": 2 * first["param_groups"]}
    (sgd,) = torch.optim.SGD([torch.zeros(1)]).state_dict()["param_groups"]
    of_another_kind = {"state": {}, "param_groups": [sgd | {"params": g["params"]} for g in first["param_groups"]]}
    optimizers = others, [grouped, *others], [of_another_kind, *others]
    for number, values in enumerate([{"agent": larger}, *({"optimizers": each} for each in optimizers)]):
        change(copy / "checkpoint.pt", **saved | values)
        run = Process(script, ["--resume", copy], tmp_path / f"output {number}")
        assert_one_line(run, 2, f"{copy} does not fit")


def test_policy_is_evaluated_as_the_run_was(script, reference, tmp_path):
    """Its file says on what task and on which episodes. Other episodes may be chosen."""
    evaluations = read_csv(reference / "eval.csv")
    best = max(evaluations, key=lambda row: row["average_return"])
    for name, row in (("policy.pt", evaluations[-1]), ("best_policy.pt", best)):
        run = finish(script, ["--evaluate", reference / name, "--no-video"], tmp_path / name)
        spread, length = (row[f"std_{of}"] for of in ("return", "episode_length"))
        assert run.stdout.splitlines()[-1] == (
            f"{reference / name}: AverageReturn = {row['average_return']:.6f} +/- {spread:.6f}, "
            f"AverageEpisodeLength = {row['average_episode_length']:.6f} +/- {length:.6f}"
        )
    other_task = ["--evaluate", reference / "policy.pt", "--no-video", "--env-id"]
    other_task.append("MountainCar-v0" if script == "dqn_cartpole" else "MountainCarContinuous-v0")
    assert_one_line(Process(script, other_task, tmp_path / "other"), 2, "policy.pt", "does not fit MountainCar")
    more = ["--num-eval-episodes", 1, "--seed", 9]
    run = finish(script, ["--evaluate", reference / "best_policy.pt", "--no-video", *more], tmp_path / "one")
    assert "+/- 0.000000, Average" in run.stdout


def test_a_forks_dropout_acts_in_no_evaluation(script, tmp_path):
    """Not in the run's own, not by --evaluate, not exported."""
    few = "--num-iterations", 40, "--eval-interval", 40
    finish(script, flags(script, run := tmp_path / "run", *few), tmp_path / "trained", with_dropout)
    evaluate = ["--evaluate", run / "policy.pt", "--no-video"]
    output = finish(script, evaluate, tmp_path / "evaluated", with_dropout).stdout
    assert f"AverageReturn = {read_csv(run / 'eval.csv')[-1]['average_return']:.6f}" in output
    policy = torch.export.load(run / "policy.pt2").module()
    batch = torch.randn(100, 4 if script == "dqn_cartpole" else 3)
    assert torch.equal(policy(batch), policy(batch))


def with_dropout(module):
    init = module.Policy.__init__

    def init_with_dropout(self, *arguments):
        init(self, *arguments)
        (self.q_network if module is dqn_cartpole else self.actor).net.insert(1, torch.nn.Dropout())

    module.Policy.__init__ = init_with_dropout


def test_exported_policies_run_without_this_project(script, reference, tmp_path):
    batches = [torch.randn(size, 4 if script == "dqn_cartpole" else 3) for size in (1, 2, 300)]
    torch.save(batches, tmp_path / "batches.pt")
    code = """
import sys, torch
for name in ("policy", "best_policy"):
    policy = torch.export.load(f"{sys.argv[1]}/{name}.pt2").module()
    torch.save([policy(batch) for batch in torch.load("batches.pt")], f"{name}.pt")
assert not {"sac_minitaur", "dqn_cartpole", "common", "gymnasium"} & set(sys.modules)
"""
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    command = [sys.executable, "-c", code, reference]
    process = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert process.returncode == 0, process.stderr
    for name in ("policy.pt", "best_policy.pt"):
        policy = load_policy(reference / name)
        for batch, actions in zip(batches, torch.load(tmp_path / name), strict=True):
            torch.testing.assert_close(actions, policy(batch).detach(), rtol=1e-6, atol=1e-6)
        assert len(actions) == 300 and len(actions.unique()) == (2 if script == "dqn_cartpole" else 300)
    weights = load_policy(reference / "policy.pt").state_dict()
    trained = checkpoint(reference)["agent"]
    assert_same(dict(weights), {name: trained[f"policy.{name}"] for name in weights})


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


def test_full_disk(script, small_disk, reference, tmp_path):
    """The run says so and stops. With room again it continues, to the same end."""
    hook = partial(before_update, count=110, action=partial(fill, small_disk / "other people's"))
    run = Process(script, flags(script, small_disk / "run", "--num-envs", 2), tmp_path / "output", hook)
    assert_one_line(run, 1, "No space left on device; to continue from the last checkpoint: python ", " --resume ")
    assert 0 < checkpoint(small_disk / "run")["step"] < 300
    for path in (small_disk / "run").glob("*.csv"):
        rows(path)
    (small_disk / "other people's").unlink()
    finish(script, ["--resume", small_disk / "run"], tmp_path / "resumed")
    assert_same_run(small_disk / "run", reference)


def test_full_disk_at_the_end(small_disk, tmp_path):
    """Only what is written then is missing."""
    hook = partial(before_export, action=partial(fill, small_disk / "other people's"))
    run = finish("dqn_cartpole", flags("dqn_cartpole", small_disk / "run"), tmp_path / "output", hook)
    assert "warning: no exported policy" in run.stdout and not run.stderr
    assert checkpoint(small_disk / "run")["step"] == 300 and not list((small_disk / "run").glob("*.pt2"))


def before_export(module, action):
    before_call(common, "export_policy", 1, action)


def test_full_disk_from_the_start(small_disk, tmp_path):
    fill(small_disk / "other people's")
    run = Process("dqn_cartpole", flags("dqn_cartpole", small_disk / "run"), tmp_path / "output")
    assert_one_line(run, 1, "No space left on device; there is no checkpoint yet")


def test_a_table_that_another_program_has_open(tmp_path):
    """As Excel on Windows: the file cannot be replaced for a while. Later it has all rows."""
    run = finish("dqn_cartpole", flags("dqn_cartpole", tmp_path / "run"), tmp_path / "output", hold_a_table)
    assert not run.stderr and "refused" in run.stdout
    assert [row["step"] for row in read_csv(tmp_path / "run" / "train.csv")] == [*range(20, 301, 20)]


def hold_a_table(module):
    replace, refusals = os.replace, iter([True, True])

    def refuse(source, target):
        if target.name == "train.csv" and next(refusals, False):
            print("refused")
            raise PermissionError(13, "Permission denied")
        replace(source, target)

    os.replace = refuse


def test_files_are_whole_or_not_there(tmp_path):
    """A write that the disk has room for in part only, also one by PyTorch, which raises an error of its own."""
    path = tmp_path / "train.csv"
    common.write_atomically(path, lambda file: file.write(b"step,loss\n1,2\n"))
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20, limits[1]))
    try:
        for write in (lambda file: file.write(bytes(100)), partial(torch.save, torch.zeros(9))):
            with pytest.raises(OSError):
                common.write_atomically(path, write)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert path.read_bytes() == b"step,loss\n1,2\n" and list(tmp_path.iterdir()) == [path]


def new_run():
    return common.Run(dqn_cartpole.Config(device="cpu"), "dqn_cartpole", None, None)


def test_runs_that_start_at_once_have_directories_of_their_own():
    runs = [new_run() for _ in range(2)]
    assert runs[0].path != runs[1].path and runs[0].path.parent == runs[1].path.parent == Path("runs")


def test_one_process_trains_one_agent_at_a_time():
    for _ in range(2):
        with new_run(), pytest.raises(common.InputError, match="this process trains already"):
            new_run().__enter__()


def test_a_run_that_cannot_start_leaves_the_process_as_it_was(monkeypatch):
    before = [signal.getsignal(number) for number in common.STOP_SIGNALS]
    with monkeypatch.context() as disk:
        disk.setattr(tempfile, "tempdir", "/none")
        with pytest.raises(common.RunError, match="No such file or directory.*; there is no checkpoint yet"):
            new_run().__enter__()
    assert [signal.getsignal(number) for number in common.STOP_SIGNALS] == before
    with new_run():
        pass


def test_a_process_that_a_task_forks_can_be_ended_at_once():
    """A signal that comes before its Python runs is not lost."""
    with new_run():
        for _ in range(20):
            process = multiprocessing.get_context("fork").Process(target=time.sleep, args=(60,))
            process.start()
            process.terminate()
            process.join()
            assert process.exitcode == -signal.SIGTERM
    assert not signal.pthread_sigmask(signal.SIG_BLOCK, [])


@pytest.mark.parametrize("daemon", [False, True])
def test_what_a_task_forks_and_does_not_end_ends_with_the_run(daemon):
    """A daemon, as a Pool's worker is, ends with the program: killed, it may hold a lock that Python waits for."""
    process = multiprocessing.get_context("fork").Process(target=time.sleep, args=(60,), daemon=daemon)

    def make():
        process.start()
        return gym.make("CartPole-v1")

    with new_run() as run:
        common.Environments(make, run, in_workers=False)
        assert process.is_alive()
    process.join(0.5 if daemon else None)
    assert process.exitcode == (None if daemon else -signal.SIGKILL)
    process.kill()


@pytest.mark.parametrize(
    "error, status", [(common.InputError("bad"), 2), (common.RunError("bad"), 1), (KeyboardInterrupt(), 130)]
)
def test_a_command_that_fails_in_a_notebook_leaves_the_kernel(error, status, monkeypatch):
    """As with %run: what ends is the command, not the process."""
    monkeypatch.setattr(threading, "excepthook", threading.excepthook)
    with pytest.raises(SystemExit) as exit:
        common.run_main(mock.Mock(side_effect=error))
    assert exit.value.code == status


def test_an_error_in_a_tasks_own_thread_is_shown(monkeypatch):
    monkeypatch.setattr(threading, "excepthook", shown := mock.Mock())
    thread = threading.Thread(target=open, args=("nowhere",))
    common.run_main(lambda: (thread.start(), thread.join()))
    assert isinstance(shown.call_args[0][0].exc_value, FileNotFoundError)


def test_one_directory_for_two_runs_that_start_at_once(tmp_path):
    (tmp_path / "ready").mkdir()
    hook = partial(wait_for_the_other, path=tmp_path / "ready")
    arguments = flags("dqn_cartpole", tmp_path / "run", "--num-iterations", 20)
    runs = [Process("dqn_cartpole", arguments, tmp_path / f"{i}", hook) for i in range(2)]
    refused, trained = sorted(runs, key=lambda run: -run.wait())
    assert_one_line(refused, 2, f"--run-dir {tmp_path}/run cannot be used")
    assert trained.status == 0 and checkpoint(tmp_path / "run")["step"] == 20


def test_a_run_that_is_continued_while_it_runs(script, tmp_path):
    """The older of the two processes stops. Each file is whole."""
    older = Process(script, flags(script, tmp_path / "run", "--num-iterations", 10**6), tmp_path / "older")
    wait_until((tmp_path / "run" / "eval.csv").exists)
    newer = Process(script, ["--resume", tmp_path / "run"], tmp_path / "newer")
    assert_one_line(older, 1, f"another process continues the run in {tmp_path}/run, ")
    step = checkpoint(tmp_path / "run")["step"]
    wait_until(lambda: checkpoint(tmp_path / "run")["step"] > step)
    newer.kill(signal.SIGINT)
    assert newer.wait() == 0, newer.stderr


def wait_for_the_other(module, path):
    def wait():
        (path / str(os.getpid())).touch()
        wait_until(lambda: len(list(path.iterdir())) == 2)

    before_call(common.Run, "_start_files", 1, wait)


@pytest.mark.parametrize("evaluates", [False, True])
def test_console_on_a_full_disk(script, evaluates, copy, tmp_path):
    arguments = ["--evaluate", copy / "policy.pt"] if evaluates else flags(script, tmp_path / "new")
    assert_one_line(Process(script, arguments, tmp_path / "output", print_to_a_full_disk), 1, "No space left")


def print_to_a_full_disk(module):
    os.dup2(os.open("/dev/full", os.O_WRONLY), 1)


def have_no_reader(module):
    """As before `| true`."""
    reader, writer = os.pipe()
    os.dup2(writer, 1)
    os.close(reader)


def lose_the_reader(module):
    """As before `| head`, in the midst of it. A fork prints then, too."""
    before_update(module, 50, partial(have_no_reader, module))
    before_update(module, 100, partial(print, "a line"))


def close_the_stream(module):
    before_update(module, 50, sys.stdout.close)


def close_stderr(module):
    before_call(common, "find_task", 1, sys.stderr.close)


def replace_stderr(module):
    sys.stderr = SimpleNamespace(write=len, flush=lambda: None)


def have_no_streams(module):
    """As pythonw."""
    os.close(1)
    os.close(2)
    sys.stdout = sys.stderr = None


def ignore_hangup(module):
    """As nohup, and then the terminal is closed."""
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    before_update(module, 50, lambda: os.kill(os.getpid(), signal.SIGHUP))


HOOKS = [lose_the_reader, close_the_stream, close_stderr, replace_stderr, have_no_streams, ignore_hangup]


@pytest.mark.parametrize("hook", HOOKS)
def test_trains_on_without_a_console(tmp_path, hook):
    run = finish("dqn_cartpole", flags("dqn_cartpole", tmp_path / "run"), tmp_path / "output", hook)
    assert not run.stderr and checkpoint(tmp_path / "run")["step"] == 300
    assert (tmp_path / "run" / "best_policy.pt2").exists() or hook is close_the_stream  # torch.export needs a stream


@pytest.mark.parametrize("hook", [have_no_reader, replace_stderr, have_no_streams])
def test_evaluates_without_a_console(script, copy, tmp_path, hook):
    assert not finish(script, ["--evaluate", copy / "policy.pt"], tmp_path / "output", hook).stderr
    assert (copy / "policy.mp4").exists()


def test_stops_without_a_console(tmp_path):
    """The message about it goes to no file that has taken the closed console's number."""
    finish("dqn_cartpole", flags("dqn_cartpole", tmp_path / "run"), tmp_path / "output", have_no_streams_and_stop)
    assert checkpoint(tmp_path / "run")["step"] == 50
    assert not any(b"Ctrl-C" in path.read_bytes() for path in tmp_path.rglob("*") if path.is_file())


def have_no_streams_and_stop(module):
    have_no_streams(module)

    def reuse_their_numbers_and_stop():
        while os.open(Path(sys.argv[-1]) / "notes", os.O_WRONLY | os.O_CREAT) < 2:
            pass
        interrupt()

    before_update(module, 50, reuse_their_numbers_and_stop)


def test_the_command_from_a_shell(script):
    """In a new interpreter, before a console that lacks letters. A refusal has status 2 and names no address."""
    command = [sys.executable, ROOT / f"{script}.py"]
    environ = os.environ | {"PYTHONUTF8": "0", "PYTHONIOENCODING": "cp437"}
    result = subprocess.run([*command, "--help"], env=environ, capture_output=True)
    assert result.returncode == 0 and not result.stderr, result.stderr
    assert b"--num-iterations" in result.stdout and b"ours (theirs" in result.stdout
    unread = shlex.join(map(str, [*command, "--help"])) + " | true"
    assert not subprocess.run(unread, shell=True, capture_output=True).stderr
    result = subprocess.run([*command, "--env-id", "NoSuchTask-v0"], capture_output=True, text=True)
    assert result.returncode == 2 and not result.stdout
    assert result.stderr.startswith("error: --env-id NoSuchTask-v0") and result.stderr.count("\n") == 1
    result = subprocess.run([*command, "--gamma", "2"], capture_output=True, text=True)
    assert result.returncode == 2 and not result.stdout
    assert "less than or equal to 1" in result.stderr and "https" not in result.stderr


@pytest.mark.parametrize("program", ["my dqn.py", "../my dqn.py"])
def test_a_fork_of_the_script_in_a_notebooks_environment(program, tmp_path):
    """The hint after a stop names it and quotes the path. A notebook's backend and console do not matter."""
    (here := tmp_path / "here").mkdir()
    shutil.copy(ROOT / "dqn_cartpole.py", here / program)
    if program != "my dqn.py":
        (here / "my dqn.py").write_text("another file of this name")
    environ = os.environ | {
        "PYTHONPATH": str(ROOT), "PYTHONUTF8": "0", "PYTHONIOENCODING": "cp437",
        "MPLBACKEND": "module://matplotlib_inline.backend_inline",
    }  # fmt: skip
    arguments = flags("dqn_cartpole", "a run", "--num-iterations", 10**6)
    command = [sys.executable, program, *arguments]
    process = subprocess.Popen(command, env=environ, cwd=here, stdout=subprocess.PIPE, text=True)
    wait_until((here / "a run" / "train.csv").exists)
    process.send_signal(signal.SIGINT)
    output, _ = process.communicate(timeout=600)
    assert process.returncode == 0 and "warning" not in output
    assert (here / "a run" / "learning_curve.png").stat().st_size > 0
    hint = output.splitlines()[-1].partition("checkpoint: ")[2]
    assert shlex.split(hint) == ["python", program, "--resume", "a run"]


def test_the_hint_of_a_program_that_calls_train(script, reference, monkeypatch):
    """The script's own command would not know what the program registered or changed. A notebook's cells have none."""
    config = importlib.import_module(script).Config(resume=reference)
    hint = f"to continue from the last checkpoint: train(Config(resume='{reference}'))"
    assert common.Run(config, script, None, None)._how_to_continue() == hint
    monkeypatch.setattr(type(config), "__module__", "__main__")
    monkeypatch.setitem(sys.modules, "__main__", ModuleType("__main__"))
    assert common.Run(config, script, None, None)._how_to_continue() == hint


def test_dead_environment_worker(tmp_path):
    arguments = flags("sac_minitaur", tmp_path / "run", "--num-envs", 2)
    run = Process("sac_minitaur", arguments, tmp_path / "output", partial(before_step, action=die))
    assert_one_line(run, 1, "worker process died", "--resume")
    assert checkpoint(tmp_path / "run")["step"] == 0


def before_step(module, action):
    before_call(common.SeededEpisodes, "step", 30, action)


def test_an_error_of_the_task_is_shown_once(script, tmp_path):
    run = Process(script, flags(script, tmp_path / "run", "--num-envs", 2), tmp_path / "output", lose_the_server)
    assert run.wait() == 1 and "--resume" in run.stdout
    assert run.stderr.startswith("error: the task failed: no server\nTraceback")
    assert run.stderr.strip().endswith("\nConnectionError: no server") and run.stderr.count("Traceback") == 1


def lose_the_server(module):
    def lose():
        raise ConnectionError("no server")

    before_call(common.SeededEpisodes, "_checked", 30, lose)


def test_dead_evaluation_worker(script, tmp_path):
    """With a network larger than a pipe: what is queued for the dead one must not hold up the end."""
    large = ["--layers" if script == "dqn_cartpole" else "--actor-layers", 256, 256, "--num-eval-episodes", 20]
    run = Process(script, flags(script, tmp_path / "run", *large), tmp_path / "output", partial(acting, action=die))
    assert_one_line(run, 1, "worker process died; to continue from the last checkpoint: ")


def test_workers_end_with_the_main_process(script, tmp_path):
    """Which is killed in the midst of everything, while its workers work."""
    run = Process(script, flags(script, tmp_path / "run", "--num-iterations", 10**6), tmp_path / "output")
    wait_until((tmp_path / "run" / "train.csv").exists)
    assert len(session(run.pid)) > 1
    run.kill()
    assert run.wait() == -signal.SIGKILL


@pytest.mark.parametrize("interrupts, factor", [(1, 0.01), (2, 1000)])
def test_a_task_that_does_not_close_is_waited_for_until_a_deadline_or_a_second_interrupt(interrupts, factor, tmp_path):
    arguments = flags("sac_minitaur", tmp_path / "run", "--num-iterations", 10**6)
    run = Process("sac_minitaur", arguments, tmp_path / "output", partial(never_close, factor=factor))
    wait_until((tmp_path / "run" / "train.csv").exists)
    run.kill(signal.SIGINT)
    wait_until(lambda: "waiting for a worker" in run.stdout)
    if interrupts == 2:
        run.kill(signal.SIGINT)
    assert run.wait() == (130 if interrupts == 2 else 0) and "Traceback" not in run.stderr


def never_close(module, factor):
    """Once an episode has begun: gymnasium closes one environment before. Deadlines are multiplied by the factor."""
    common.SeededEpisodes.close = lambda env: time.sleep(10**6 * hasattr(env, "total"))
    join = BaseProcess.join

    def tell_and_join(process, timeout=None):
        print("waiting for a worker", flush=True)
        join(process, timeout and factor * timeout)

    BaseProcess.join = tell_and_join


def test_a_second_interrupt_does_not_wait_for_a_task_that_is_being_made(tmp_path):
    hook = partial(never_made, begun=tmp_path / "begun")
    run = Process("sac_minitaur", flags("sac_minitaur", tmp_path / "run"), tmp_path / "output", hook)
    wait_until((tmp_path / "begun").exists)
    run.kill(signal.SIGINT)
    wait_until(lambda: "stopping" in run.stderr)
    run.kill(signal.SIGINT)
    assert run.wait() == 130 and "Traceback" not in run.stderr


def never_made(module, begun):
    """In a worker: gymnasium makes one environment before."""
    init = common.SeededEpisodes.__init__

    def wait(env, *arguments):
        if multiprocessing.parent_process():
            begun.touch()
            time.sleep(10**6)
        init(env, *arguments)

    common.SeededEpisodes.__init__ = wait


def test_interrupted_evaluation_of_a_policy(script, copy, tmp_path):
    run = Process(script, ["--evaluate", copy / "policy.pt"], tmp_path / "output", partial(acting, action=interrupt))
    assert run.wait() == 130 and not run.stderr


def acting(module, action):
    before_call(module.Policy, "act", 3, action)


def test_evaluations_take_the_cores_they_may_use(monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: {0})
    with new_run():
        assert len(multiprocessing.active_children()) == 1


def test_processes_that_cannot_train(script, tmp_path):
    run = Process(script, [], tmp_path / "pool", train_in_a_pool)
    assert_one_line(run, 2, "use multiprocessing.Process")
    for rank, wrong in (("0", "MASTER_ADDR"), ("abc", "abc")):
        variables = dict(RANK=rank, WORLD_SIZE="2", LOCAL_RANK="0")
        run = Process(script, flags(script, tmp_path / "run"), tmp_path / f"rank{rank}", **variables)
        assert_one_line(run, 2, "RANK is set but", wrong, "torchrun")
    assert not (tmp_path / "run").exists()


def train_in_a_pool(module):
    config = module.Config(env_id="Pendulum-v1" if module.__name__ == "sac_minitaur" else "CartPole-v1")

    def main():
        with multiprocessing.Pool(1) as pool:  # a pool that nobody ends may print a traceback of its own at exit
            pool.map(module.train, [config])

    module.main = main


def test_films_without_a_display(tmp_path):
    arguments = flags("dqn_cartpole", tmp_path / "run", "--video", "--num-iterations", 20)
    run = Process("dqn_cartpole", arguments, tmp_path / "output", XDG_RUNTIME_DIR="")
    assert run.wait() == 0 and not run.stderr, run.stderr
    for name in ("trained_agent.mp4", "random_agent.mp4", "learning.mp4"):
        with imageio.get_reader(tmp_path / "run" / name) as video:
            frames = [np.asarray(frame) for frame in video]
        assert len(frames) > 5 and np.abs(np.subtract(*np.float32([frames[0], frames[-1]]))).max() > 100


class Blinking(gym.Env):
    """Thirty steps at 120 a second."""

    metadata = {"render_fps": 120, "render_modes": ["rgb_array"]}
    action_space, observation_space = gym.spaces.Discrete(2), gym.spaces.Discrete(2)
    closed = 0

    def __init__(self, render_mode, failing=False):
        self.render_mode, self.failing = render_mode, failing

    def reset(self, *, seed=None, options=None):
        self.steps = 0
        return 0, {}

    def step(self, action):
        self.steps += 1
        return 0, 0.0, self.steps == 30, False, {}

    def render(self):
        if self.failing and self.steps > 5:
            raise ValueError
        return np.full((16, 16, 3), 8 * self.steps, np.uint8)

    def close(self):
        Blinking.closed += 1


def film(path, *more, clips=((None, None, None),), **arguments):
    task = gym.envs.registration.EnvSpec("Blinking-v0", Blinking, disable_env_checker=True, kwargs=arguments)
    common.film(clips, task, 0, path, *more)


def test_films_in_real_time_at_50_frames_a_second_or_fewer(tmp_path):
    film(tmp_path / "film.mp4")
    with imageio.get_reader(tmp_path / "film.mp4") as video:
        brightness = [frame.mean() for frame in video]
        assert video.get_meta_data()["fps"] == 40
    assert brightness == pytest.approx([24 * i for i in range(11)], abs=3)  # every third step, and the last
    assert [path.name for path in tmp_path.iterdir()] == ["film.mp4"]
    film(tmp_path / "film.mp4", 0.1, 30)
    with imageio.get_reader(tmp_path / "film.mp4") as video:
        assert [frame.mean() for frame in video] == pytest.approx([32 * i for i in range(4)], abs=3)  # of 12 steps


def test_a_film_has_a_part_with_a_caption_for_each_policy(tmp_path):
    policy, played = mock.Mock(), []
    policy.act = lambda observation: played.append(policy.load_state_dict.call_args[0][0]) or 0
    clips = [(policy, "first weights", "1"), (policy, "more", "7 updates"), (None, None, None)]
    film(tmp_path / "film.mp4", clips=clips)
    assert played == 30 * ["first weights"] + 30 * ["more"]
    with imageio.get_reader(tmp_path / "film.mp4") as video:
        first, second, third = np.float32([frame for frame in video]).reshape(3, 11, 16 * 16 * 3)
    assert (abs(first - third).max(1) > 50).all() and (abs(second - first).max(1) > 50).all()


def test_a_film_that_fails_leaves_nothing(tmp_path):
    closed = Blinking.closed
    with pytest.raises(ValueError):
        film(tmp_path / "film.mp4", failing=True)
    assert Blinking.closed == closed + 1 and not any(tmp_path.iterdir())


def test_a_film_that_the_disk_has_no_room_for_leaves_nothing(small_disk, monkeypatch):
    noise = np.random.default_rng(0).integers(256, size=(256, 256, 3), dtype=np.uint8)
    monkeypatch.setattr(Blinking, "render", lambda self: noise)
    fill(small_disk / "other people's")
    os.truncate(small_disk / "other people's", (small_disk / "other people's").stat().st_size - 4096)
    with pytest.raises(Exception):
        film(small_disk / "film.mp4")
    assert [path.name for path in small_disk.iterdir()] == ["other people's"]


def test_failing_film_costs_a_line_only(tmp_path):
    arguments = flags("dqn_cartpole", tmp_path / "run", "--video", "--num-iterations", 20)
    run = finish("dqn_cartpole", arguments, tmp_path / "output", die_filming)
    assert "warning: no trained_agent.mp4" in run.stdout and not run.stderr
    assert (tmp_path / "run" / "policy.pt2").exists()


def die_filming(module):
    before_call(imageio, "get_writer", 1, die)


def test_the_curve_shows_the_tables(reference, monkeypatch, tmp_path):
    figures = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, *_, **__: figures.append(figure))
    common.plot_learning_curve(tmp_path / "curve.png", tables := checkpoint(reference)["tables"], "title", 195.0)
    returns, losses, values = ([line.get_xydata().T.tolist() for line in axes.lines] for axes in figures[0].axes)
    loss = "loss" if "loss" in tables["train"][0] else "critic_loss"
    drawn = (returns, "eval", "average_return"), (losses, "train", loss), (values, "train", "mean_q")
    for lines, table, name in drawn:
        assert [[row["step"] for row in tables[table]], [row[name] for row in tables[table]]] in lines
    assert [y for _, y in returns[1:]] == [2 * [tables["random"][0]["average_return"]], [195.0, 195.0]]


def with_nan_rewards(module):
    """From the fourth update on."""
    sample, calls = module.ReplayBuffer.sample, iter(range(10**9))

    def sample_nan(self, batch_size):
        batch = sample(self, batch_size)
        return batch if next(calls) < 3 else (*batch[:2], batch[2] * math.nan, *batch[3:])

    module.ReplayBuffer.sample = sample_nan


@pytest.mark.parametrize("log_interval, name", [(1, "loss is nan"), (10**6, "is not finite")])
def test_loss_that_is_not_a_number(script, tmp_path, log_interval, name):
    """Stops the run when it is logged or saved, with the step and the part, and no checkpoint has taken it in."""
    few = ["--initial-collect-steps", 26, "--checkpoint-interval", 1, "--eval-interval", 10**6]
    arguments = flags(script, tmp_path / "run", *few, "--log-interval", log_interval)
    run = Process(script, arguments, tmp_path / "output", with_nan_rewards)
    assert_one_line(run, 1, f"{name} at step ", "the last good checkpoint is kept")
    state = checkpoint(tmp_path / "run")
    assert 0 < state["step"] == int(run.stderr.split("at step ")[1].split(";")[0]) - 1
    assert all(tensor.isfinite().all() for tensor in state["agent"].values())
