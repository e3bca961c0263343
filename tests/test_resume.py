"""A run that was stopped or killed continues as if nothing had happened, whatever the moment.

`SOAK_CYCLES=30 pytest tests/test_resume.py -k soak` kills each script's run 30 times.
"""

import dataclasses
import importlib
import io
import json
import math
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch

import common
from conftest import several
from runs import ROOT, Process, assert_same_run, before_call, before_update, checkpoint, die, finish, flags
from runs import read_csv, rows, session, wait_until

CYCLES = int(os.environ.get("SOAK_CYCLES", 3))


def collecting_random_steps(module):
    before_call(common.Run, "stop_if_requested", 20, die)


def updating(module):
    before_update(module, 75, die)


def evaluating(module):
    before_call(common.futures, "wait", 3, die)


def writing_a_checkpoint(module):
    """With half of it written."""
    save, calls = torch.save, iter(range(1, 10**9))

    def save_half(state, file, **kwargs):
        if "replay" not in str(state.get("processes")) or next(calls) < 2:
            return save(state, file, **kwargs)
        save(state, whole := io.BytesIO())
        file.write(whole.getvalue()[: whole.tell() // 2])
        file.flush()
        die()

    torch.save = save_half


def between_policy_and_checkpoint(module):
    write, calls = common.Run._write, iter(range(1, 10**9))

    def write_or_die(run, name, *more):
        if name == "checkpoint.pt" and next(calls) == 2:
            die()
        write(run, name, *more)

    common.Run._write = write_or_die


def finishing(module):
    before_call(common, "export_policy", 2, die)


MOMENTS = (collecting_random_steps, evaluating, updating, writing_a_checkpoint, between_policy_and_checkpoint, finishing)


def test_reference_is_worth_comparing_with(script, reference):
    state = checkpoint(reference)
    num_envs = 3 if script == "sac_minitaur" else 1
    assert state["step"] == 300 and state["env_steps"] == 96 + 300 * num_envs
    own = state["processes"][0]
    assert own["size"] == len(own["replay"]["rewards"]) == 250 and own["replay"]["observations"].dim() == 2
    assert own["replay"]["rewards"].untyped_storage().nbytes() == 4 * 250  # no more than what is stored
    names = {path.name for path in reference.iterdir() if "events" not in path.name}
    assert names == {
        "config.json", "train.csv", "eval.csv", "random.csv", "learning_curve.png", "checkpoint.pt", "policy.pt",
        "best_policy.pt", "policy.pt2", "best_policy.pt2",
    }  # fmt: skip
    assert (reference / "learning_curve.png").read_bytes().startswith(b"\x89PNG")
    first, *later = read_csv(reference / "train.csv")
    finished = state["finished"]
    assert len(finished) == 10
    shown = [later[-1]["collect_return"], later[-1]["collect_episode_length"]]
    assert shown == pytest.approx(list(np.mean(finished, axis=0)))
    assert [row["step"] for row in read_csv(reference / "eval.csv")] == [0, 100, 200, 300]
    assert_tensorboard_once(reference)


def test_the_same_seed_gives_the_same_bits(script, reference, tmp_path):
    """In another process, called from Python; and the process trains a second time. Another seed gives other bits."""
    module = importlib.import_module(script)
    config = module.Config(**json.loads((reference / "config.json").read_text()) | {"run_dir": tmp_path / "same"})
    torch.set_num_threads(2)
    assert module.train(config) == tmp_path / "same"
    assert torch.get_num_threads() == 2 and signal.getsignal(signal.SIGINT) is signal.default_int_handler
    assert_same_run(tmp_path / "same", reference)
    other = module.train(dataclasses.replace(config, run_dir=tmp_path / "other", seed=1, num_iterations=1))
    mine, other = checkpoint(reference), checkpoint(other)
    weights = (state["agent"] for state in (mine, other))
    differ = {name: not torch.equal(a, b) for name, a, b in zip(mine["agent"], *(w.values() for w in weights))}
    assert all(different for name, different in differ.items() if name.endswith("weight") and "0" in name)
    assert mine["tables"]["random"][0]["average_return"] != other["tables"]["random"][0]["average_return"]


def test_killed_at_every_moment_and_resumed(script, reference, tmp_path):
    arguments = [*flags(script, tmp_path / "run"), *several(script)]
    for moment in MOMENTS:
        run = Process(script, arguments, tmp_path / moment.__name__, moment)
        assert run.wait() == -signal.SIGKILL, (moment.__name__, run.stdout, run.stderr)
        for path in (tmp_path / "run").glob("*.csv"):
            rows(path)
        arguments = ["--resume", tmp_path / "run"]
    (tmp_path / "run" / "notes.csv").write_text("a student's own\n")
    (tmp_path / "run" / ".tmp-1-checkpoint.pt").write_text("left by a kill")
    finish(script, arguments, tmp_path / "last")
    assert_same_run(tmp_path / "run", reference)
    assert_tensorboard_once(tmp_path / "run")
    assert (tmp_path / "run" / "notes.csv").exists() and not list((tmp_path / "run").glob(".tmp-*"))


def assert_tensorboard_once(run_dir):
    """TensorBoard has each finite number of the CSVs once."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(run_dir), size_guidance={"scalars": 0}).Reload()
    shown = sorted((tag, event.step) for tag in events.Tags()["scalars"] for event in events.Scalars(tag))
    expected = []
    for table in ("train", "eval", "random"):
        for row in read_csv(run_dir / f"{table}.csv"):
            expected += [(f"{table}/{k}", row["step"]) for k, v in row.items() if k != "step" and math.isfinite(v)]
    assert shown == sorted(expected)


def test_a_raised_run_equals_a_longer_one(script, reference, tmp_path):
    """If it ended at a checkpoint's update. The shorter one ended with an evaluation of its own."""
    shorter = [*flags(script, tmp_path / "run", "--num-iterations", 150), *several(script)]
    finish(script, shorter, tmp_path / "shorter")
    assert rows(tmp_path / "run" / "eval.csv")[-1][0] == "150"
    hook = partial(before_update, count=5, action=die)
    raised = ["--resume", tmp_path / "run", "--num-iterations", 300]
    assert Process(script, raised, tmp_path / "raised", hook).wait() == -signal.SIGKILL
    # The real command, in a new interpreter, from another directory. The run knows that it was raised.
    command = [sys.executable, ROOT / f"{script}.py", "--resume", tmp_path / "run"]
    result = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert_same_run(tmp_path / "run", reference)
    assert json.loads((tmp_path / "run" / "config.json").read_text())["num_iterations"] == 300


def test_the_best_policy_is_the_checkpoints_again(script, reference, tmp_path):
    """Where its file was written after the checkpoint."""
    shutil.copytree(reference, tmp_path / "run")
    state = checkpoint(tmp_path / "run")
    torch.save(torch.load(tmp_path / "run" / "policy.pt") | {"weights": {}}, tmp_path / "run" / "best_policy.pt")
    finish(script, ["--resume", tmp_path / "run", "--num-iterations", 301], tmp_path / "output")
    assert checkpoint(tmp_path / "run")["best"][0] >= state["best"][0]
    assert torch.load(tmp_path / "run" / "best_policy.pt")["weights"]


def test_what_may_change(script, reference, tmp_path):
    """From Python a config needs no more than the changes. Metrics and tensors that you add are kept."""
    module = importlib.import_module(script)
    shutil.copytree(reference, tmp_path / "run")
    shorter = "--num-iterations 299 is less than the run's 300"
    for changes, said in (
        ({"num_iterations": 299}, shorter), ({"seed": 3}, "--seed 3 differs from the 0 of the run"),
        ({"gamma": 0.5}, "--gamma 0.5 differs from the 0.99 .* leave it out"),
    ):  # fmt: skip
        with pytest.raises(common.InputError, match=said):
            module.train(module.Config(**{"num_iterations": 300} | changes), resume=tmp_path / "run")
    assert module.train(module.Config(num_iterations=310, num_threads=2, device="cpu", video=False), tmp_path / "run")
    state = checkpoint(tmp_path / "run")
    assert state["step"] == 310 and state["config"]["num_threads"] == 2 and state["config"]["batch_size"] == 24


def with_more_state(module):
    """A metric that appears in mid-run, and a tensor of the replay buffer."""
    log, init = common.Run.log, module.ReplayBuffer.__init__

    def with_ages(self, *arguments):
        init(self, *arguments)
        self.ages = torch.zeros(self.capacity)
        self.ages += 7

    common.Run.log = lambda run, step, metrics: log(run, step, metrics | ({"one": 1} if step > 100 else {}))
    module.ReplayBuffer.__init__ = with_ages


def test_what_you_add_is_kept(script, tmp_path):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    run = tmp_path / "run"
    finish(script, flags(script, run, "--num-iterations", 200), tmp_path / "output", with_more_state)
    assert checkpoint(run)["processes"][0]["replay"]["ages"].eq(7).all()
    assert "one" not in rows(run / "train.csv")[0]  # a CSV keeps its columns
    events = EventAccumulator(str(run)).Reload()
    assert [event.step for event in events.Scalars("train/one")] == [120, 140, 160, 180, 200]
    finish(script, ["--resume", run, "--num-iterations", 250], tmp_path / "again", with_more_state)
    missing = Process(script, ["--resume", run, "--num-iterations", 300], tmp_path / "missing")
    assert missing.wait() == 2 and "does not fit" in missing.stderr and missing.stderr.count("\n") == 1


def start(script, *arguments, **options):
    """The real command, in a session of its own."""
    command = [sys.executable, ROOT / f"{script}.py", *arguments]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen(list(map(str, command)), start_new_session=True, **pipes, **options)


def long_flags(script, run_dir):
    return flags(script, run_dir, "--num-iterations", 10**6, "--log-interval", 10, "--eval-interval", 10**6)


def nothing_is_left(process):
    wait_until(lambda: not session(process.pid), seconds=30)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_stops_the_run_with_a_checkpoint(script, number, tmp_path):
    """A terminal sends Ctrl-C to all processes. The run says how to continue, and ends with the shell's status."""
    process = start(script, *long_flags(script, tmp_path / "a run"))
    wait_until((tmp_path / "a run" / "train.csv").exists)
    os.killpg(process.pid, number) if number == signal.SIGINT else process.send_signal(number)
    output, errors = process.communicate(timeout=60)
    assert process.returncode == 130, errors
    nothing_is_left(process)
    assert errors.strip() == "stopping: saving a checkpoint first (Ctrl-C again stops at once)"
    state = checkpoint(tmp_path / "a run")
    said = f"stopped at step {state['step']}; to continue: --resume '{tmp_path / 'a run'}'"
    assert state["step"] >= 10 and output.splitlines()[-1].startswith(said)
    assert (tmp_path / "a run" / "learning_curve.png").exists() and not list((tmp_path / "a run").glob("*.pt2"))
    hook = partial(before_update, count=5, action=die)
    assert Process(script, ["--resume", tmp_path / "a run"], tmp_path / "out", hook).wait() == -signal.SIGKILL


def test_a_second_ctrl_c_stops_at_once(script, tmp_path):
    """Also while random actions are evaluated, before the first update."""
    process = start(script, *flags(script, tmp_path / "run", "--num-eval-episodes", 10**5))
    wait_until((tmp_path / "run" / "checkpoint.pt").exists)
    os.killpg(process.pid, signal.SIGSTOP)  # so that the first one is not dealt with before the second comes
    process.send_signal(signal.SIGINT)
    os.killpg(process.pid, signal.SIGCONT)
    time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 130, errors
    nothing_is_left(process)


def test_no_process_outlives_a_killed_main_process(script, tmp_path):
    process = start(script, *long_flags(script, tmp_path / "run"))
    wait_until((tmp_path / "run" / "train.csv").exists)
    assert len(session(process.pid)) >= 3  # workers of evaluation, and the environments
    process.kill()
    process.communicate(timeout=60)
    nothing_is_left(process)


def stop_while_evaluating(step, module):
    """Most of the episodes still wait for a worker."""
    evaluate = common.Run.evaluate

    def evaluate_and_stop(run, at, policy):
        if at == step:
            common.evaluation_seeds = lambda config: range(100_000)
            run.stop_request.set()
        evaluate(run, at, policy)

    common.Run.evaluate = evaluate_and_stop


@pytest.mark.parametrize("step", (100, 300))
def test_an_evaluation_that_is_stopped_is_done_again(script, reference, step, tmp_path):
    arguments = [*flags(script, tmp_path / "run"), *several(script)]
    run = Process(script, arguments, tmp_path / "stopped", partial(stop_while_evaluating, step))
    assert run.wait() == 130 and f"stopped at step {step}" in run.stdout, run.stderr
    finish(script, ["--resume", tmp_path / "run"], tmp_path / "continued")
    assert_same_run(tmp_path / "run", reference)  # here a checkpoint's step: the same bits


def stop_while_filming(module):
    before_call(common.Run, "_film", 1, lambda: None)
    film = common.Run._film

    def film_and_stop(run, policy):
        run.stop_request.set()
        film(run, policy)

    common.Run._film = film_and_stop


def test_films_that_are_stopped_are_made_on_resume(script, reference, tmp_path):
    shutil.copytree(reference, run := tmp_path / "run")
    stopped = Process(script, ["--resume", run, "--video"], tmp_path / "stopped", stop_while_filming)
    assert stopped.wait() == 130 and "stopped while filming" in stopped.stdout.splitlines()[-1]
    assert not list(run.glob("*.mp4"))
    finish(script, ["--resume", run, "--video"], tmp_path / "continued")
    assert len(list(run.glob("*.mp4"))) == 3


def test_where_processes_are_spawned(reference, script, tmp_path):
    """As on macOS and Windows."""
    finish(script, [*flags(script, tmp_path / "run"), *several(script)], tmp_path / "output", spawn)
    assert_same_run(tmp_path / "run", reference)


def spawn(module):
    common.start_method = lambda: "spawn"


def test_minitaur_resumes_exactly(tmp_path):
    pytest.importorskip("pybullet")
    arguments = (
        "--device cpu --no-video --num-iterations 120 --initial-collect-steps 200 --batch-size 32 --log-interval 5 "
        "--max-episode-steps 50 --eval-interval 60 --num-eval-episodes 1 --checkpoint-interval 50 "
        "--actor-layers 32 32 --critic-layers 32 32"
    ).split()
    finish("sac_minitaur", [*arguments, "--run-dir", tmp_path / "whole"], tmp_path / "1")
    hook = partial(before_update, count=70, action=die)
    run = Process("sac_minitaur", [*arguments, "--run-dir", tmp_path / "run"], tmp_path / "2", hook)
    assert run.wait() == -signal.SIGKILL
    state = checkpoint(tmp_path / "run")
    assert state["step"] == 50
    assert state["processes"][0]["replay"]["observations"].shape[1] == 28 + 7  # what only the critics see among it
    finish("sac_minitaur", ["--resume", tmp_path / "run"], tmp_path / "3")
    assert_same_run(tmp_path / "run", tmp_path / "whole")


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA GPU")
def test_a_run_on_a_gpu_continues_exactly(script, reference, tmp_path):
    """And on the CPU. SAC's updates are replayed as a CUDA graph: they are those of the run without one."""
    module = importlib.import_module(script)
    config = module.Config(**json.loads((reference / "config.json").read_text()) | {"device": "cuda"})
    with_graph = {"cuda_graph": True} if script == "sac_minitaur" else {}
    whole = module.train(dataclasses.replace(config, run_dir=tmp_path / "whole"))
    module.train(dataclasses.replace(config, run_dir=tmp_path / "run", num_iterations=150, **with_graph))
    run = module.train(config, resume=tmp_path / "run")
    assert_same_run(run, whole)
    module.train(dataclasses.replace(config, device="cpu", num_iterations=310), resume=run)
    assert checkpoint(run)["step"] == 310


def test_soak(script, tmp_path):
    """Cycles of killing and resuming, at moments drawn at random, end in the bits of a run left alone."""
    per_cycle = 20
    limit = ["--max-episode-steps", 8]
    size = ["--num-iterations", per_cycle * CYCLES + 100, "--checkpoint-interval", 9, "--num-eval-episodes", 1, *limit]
    finish(script, flags(script, tmp_path / "whole", *size), tmp_path / "output")
    draw = random.Random(0)
    arguments = flags(script, tmp_path / "run", *size)
    for cycle in range(CYCLES):
        saved = Path(tmp_path / "run" / "checkpoint.pt").exists()
        done = checkpoint(tmp_path / "run")["step"] if saved else 0
        # Now and then from the start on: at its first files, in its random steps.
        first = 0 if cycle and draw.random() < 0.3 else draw.randint(1, per_cycle) + cycle * per_cycle - done
        hook = partial(kill_after, updates=first, events=draw.randint(1, 4_000))
        run = Process(script, arguments, tmp_path / f"cycle{cycle}", hook)
        assert run.wait() == -signal.SIGKILL, (cycle, run.stdout, run.stderr)
        for path in (tmp_path / "run").glob("*.csv"):
            rows(path)
        arguments = ["--resume", tmp_path / "run"]
    finish(script, arguments, tmp_path / "last")
    assert_same_run(tmp_path / "run", tmp_path / "whole")
    assert_tensorboard_once(tmp_path / "run")


def kill_after(module, updates, events):
    """Kills the run some Python calls and returns after an update, at any point of what the loop does then."""

    def count(*_):
        nonlocal events
        events -= 1
        if events == 0:
            die()

    begin = partial(sys.setprofile, count)
    if updates > 0:
        before_update(module, updates, begin)
    else:
        before_call(common.Run, "begin", 1, begin)
