"""A run that was stopped or killed continues as if nothing had happened, whatever the moment.

`SOAK_CYCLES=30 pytest tests/test_resume.py -k soak` kills each script's run 30 times.
"""

import csv
import dataclasses
import importlib
import io
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time
import zipfile
from functools import partial

import gymnasium as gym
import pytest
import torch

import common
from runs import AGENTS, ROOT, SCRIPTS, Process, assert_same, checkpoint, flags, rows

CYCLES = int(os.environ.get("SOAK_CYCLES", 3))


def die():
    os.kill(os.getpid(), signal.SIGKILL)


def interrupt():
    os.kill(os.getpid(), signal.SIGINT)


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


# Hooks: the moments at which a run is killed.


def collecting(module):
    before_call(getattr(module, AGENTS[module.__name__]), "random_actions", 40, die)


def updating(module):
    before_update(module, 75, die)


def evaluating(module):
    """In the untrained policy's evaluation, which other processes do, once one of them has done 12 steps of it."""
    main = os.getpid()
    before_call(module, "act", 12, lambda: os.kill(main, signal.SIGKILL))


def writing_a_checkpoint(module):
    """With half of it written."""
    save, calls = torch.save, iter(range(1, 10**9))

    def save_half(state, file, **kwargs):
        if "ranks" not in state or next(calls) < 2:
            return save(state, file, **kwargs)
        save(state, whole := io.BytesIO())
        file.write(whole.getvalue()[: whole.tell() // 2])
        file.flush()
        die()

    torch.save = save_half


def between_policy_and_checkpoint(module):
    before_call(common, "save_checkpoint", 2, die)


def filming(module):
    main, make_env = os.getpid(), module.make_env

    class Killer(gym.Wrapper):
        def render(self):
            os.kill(main, signal.SIGKILL)

    module.make_env = lambda env_id, **kwargs: (Killer if kwargs else lambda env: env)(make_env(env_id, **kwargs))


MOMENTS = (collecting, evaluating, updating, writing_a_checkpoint, between_policy_and_checkpoint, filming)


def finish(script, arguments, output, hook=None):
    run = Process(script, arguments, output, hook)
    assert run.wait() == 0, run.stderr
    return run


@pytest.fixture(scope="module", params=SCRIPTS)
def script(request):
    return request.param


@pytest.fixture(scope="module")
def reference(script, tmp_path_factory):
    """An uninterrupted run with two environments; its directory."""
    path = tmp_path_factory.mktemp(script)
    finish(script, flags(script, path / "run", "--num-envs", 2), path / "output")
    return path / "run"


def assert_same_run(run_dir, reference):
    for name in ("train.csv", "eval.csv", "random.csv"):
        assert rows(run_dir / name) == rows(reference / name), name
    # Which evaluations are still under way at a checkpoint is a matter of time; their rows are not, see above.
    mine, other = checkpoint(run_dir), checkpoint(reference)
    for state in (mine, other):
        for name in ("config", "seconds", "tables", "evaluations", "best_return", "best_weights"):
            del state["shared"][name]
    assert_same(mine, other)
    for name in ("policy.pt2", "best_policy.pt2"):
        with zipfile.ZipFile(run_dir / name) as ours, zipfile.ZipFile(reference / name) as theirs:
            weights = [name for name in ours.namelist() if "/weights/" in name]
            assert weights == [name for name in theirs.namelist() if "/weights/" in name]
            assert all(ours.read(name) == theirs.read(name) for name in weights), name


def test_reference_is_worth_comparing_with(script, reference):
    """It learned, its episodes end at other steps than its checkpoints, and its replay has wrapped around."""
    state = checkpoint(reference)
    own = state["ranks"][0]
    assert state["shared"]["step"] == 300 and len(own["buffer"]["rows"]) == 250
    assert any(len(actions) > 0 for actions in own["episodes"]["actions"])
    assert [row[0] for row in rows(reference / "eval.csv")] == ["step", "0", "100", "200", "300"]
    assert [row[0] for row in rows(reference / "train.csv")] == ["step", *map(str, range(20, 301, 20))]
    # The speed is that of the updates since the last row: the start took longer than all of them.
    last = list(csv.DictReader((reference / "train.csv").open()))[-1]
    assert float(last["steps_per_second"]) > 1.3 * 300 / float(last["seconds"])


def test_killed_at_every_moment_and_resumed(script, reference, tmp_path):
    arguments = flags(script, tmp_path / "run", "--num-envs", 2)
    pending = 0
    for moment in MOMENTS:
        film = ["--video"] if moment is filming else []
        run = Process(script, arguments + film, tmp_path / moment.__name__, moment)
        assert run.wait() == -signal.SIGKILL, (moment.__name__, run.stdout, run.stderr)
        for path in (tmp_path / "run").glob("*.csv"):
            rows(path)
        pending += len(checkpoint(tmp_path / "run")["shared"]["evaluations"])
        arguments = ["--resume", tmp_path / "run"]
    assert pending > 0  # some evaluations were under way at a checkpoint
    assert not list((tmp_path / "run").glob("*.mp4"))
    (tmp_path / "run" / "notes.csv").write_text("a student's own\n")
    finish(script, [*arguments, "--no-video"], tmp_path / "last")
    assert_same_run(tmp_path / "run", reference)
    assert_tensorboard_once(tmp_path / "run")
    assert (tmp_path / "run" / "notes.csv").exists()


def assert_tensorboard_once(run_dir):
    """TensorBoard has each finite number of the CSVs once."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(run_dir), size_guidance={"scalars": 0}).Reload()
    shown = sorted((tag, event.step) for tag in events.Tags()["scalars"] for event in events.Scalars(tag))
    expected = []
    for table in ("train", "eval", "random"):
        with open(run_dir / f"{table}.csv") as file:
            for row in csv.DictReader(file):
                expected += [(f"{table}/{k}", int(row["step"])) for k, v in row.items() if k != "step" and v != "nan"]
    assert shown == sorted(expected)


def test_raised_run_equals_a_longer_one(script, reference, tmp_path):
    """Also when the shorter one ended with an evaluation of its own, and when the longer one is killed at once."""
    shorter = flags(script, tmp_path / "run", "--num-envs", 2, "--num-iterations", 190)
    finish(script, shorter, tmp_path / "shorter")
    assert rows(tmp_path / "run" / "eval.csv")[-1][0] == "190"
    raised = ["--resume", tmp_path / "run", "--num-iterations", 300]
    assert Process(script, raised, tmp_path / "raised", updating_a_little).wait() == -signal.SIGKILL
    # The real command, in a new interpreter.
    command = [sys.executable, ROOT / f"{script}.py", "--resume", tmp_path / "run"]
    result = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert_same_run(tmp_path / "run", reference)


def updating_a_little(module):
    before_update(module, 5, die)


def test_the_best_policy_is_the_checkpoints_again(script, reference, tmp_path):
    """Where its file was written after the checkpoint, and no evaluation to come is as good."""
    shutil.copytree(reference, tmp_path / "run")
    state = checkpoint(tmp_path / "run")
    state["shared"]["best_return"], best = 1e9, state["shared"]["best_weights"]
    torch.save(state, tmp_path / "run" / "checkpoint.pt")
    (tmp_path / "run" / "best_policy.pt2").write_bytes(b"of an evaluation to come")
    finish(script, ["--resume", tmp_path / "run"], tmp_path / "output")
    exported = common.load_weights(tmp_path / "run" / "best_policy.pt2")
    assert exported and all(torch.equal(value, best[name]) for name, value in exported.items())


def test_stop_and_continue(script, reference, tmp_path):
    """Ctrl-C or SIGTERM: a checkpoint, the curve, a line with the command that continues, which is then followed.

    Within 100 environment steps, counted over the environments.
    """
    run = finish(script, flags(script, tmp_path / "run", "--num-envs", 2), tmp_path / "output", signal_itself)
    last = run.stdout.splitlines()[-1]
    step = checkpoint(tmp_path / "run")["shared"]["step"]
    assert 110 <= step <= 210 and f"stopped at step {step}" in last
    assert run.stderr.strip() == "stopping: saving a checkpoint first (Ctrl-C again stops at once)"
    assert (tmp_path / "run" / "learning_curve.png").stat().st_size > 0
    finish(script, re.search(rf"python {script}\.py (--resume .+)$", last)[1].split(), tmp_path / "last")
    assert_same_run(tmp_path / "run", reference)


def signal_itself(module):
    number = signal.SIGTERM if module.__name__ == "sac_minitaur" else signal.SIGINT
    # To the whole process group, as a terminal and torchrun do.
    before_update(module, 110, lambda: os.killpg(0, number))


def test_a_stop_at_the_last_update_is_a_stop(script, tmp_path):
    """Also with no evaluation under way. The last one comes when the run is continued."""
    arguments = flags(script, tmp_path / "run", "--initial-collect-steps", 100, "--eval-interval", 200)
    run = finish(script, arguments, tmp_path / "output", signal_itself_at_the_end)
    assert "stopped at step 300" in run.stdout.splitlines()[-1]
    finish(script, ["--resume", tmp_path / "run"], tmp_path / "last")
    assert [row[0] for row in rows(tmp_path / "run" / "eval.csv")] == ["step", "0", "200", "300"]


def signal_itself_at_the_end(module):
    def wait_and_signal():
        time.sleep(2)  # the evaluations have ended by then
        interrupt()

    before_update(module, 300, wait_and_signal)


def test_stops_when_nobody_reads_on(script, tmp_path):
    """As after `| head`: with a checkpoint, not with a broken pipe."""
    run = finish(script, flags(script, tmp_path / "run"), tmp_path / "output", lose_the_reader_at_update_50)
    assert not run.stderr and 50 < checkpoint(tmp_path / "run")["shared"]["step"] < 300


def lose_the_reader_at_update_50(module):
    def lose_it():
        reader, writer = os.pipe()
        os.dup2(writer, 1)
        os.close(reader)

    before_update(module, 50, lose_it)


def test_second_interrupt_stops_at_once(script, tmp_path):
    run = Process(script, flags(script, tmp_path / "run"), tmp_path / "output", interrupt_twice)
    assert run.wait() == 130
    assert checkpoint(tmp_path / "run")["shared"]["step"] == 0  # the second came before a checkpoint was written


def interrupt_twice(module):
    before_update(module, 20, interrupt)
    before_call(common, "save_checkpoint", 2, interrupt)


def test_every_other_change_is_refused(script, reference):
    """In one line that names the field."""
    module = importlib.import_module(script)
    config = common.resumed_config(module.Config(resume=str(reference)), script)
    saved = checkpoint(reference)["shared"]["config"]
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if isinstance(value, bool):
            changed = not value
        elif isinstance(value, tuple):
            changed = (*value, 8)
        else:
            changed = f"{value}x" if isinstance(value, str | None) else value + 1
        continued = dataclasses.replace(config, **{field.name: changed})
        if field.name in ("resume", "evaluate", "video", "checkpoint_interval", "num_iterations"):
            common.require_same_run(continued, saved)
        else:
            with pytest.raises(common.InputError) as error:
                common.require_same_run(continued, saved)
            assert f"--{field.name.replace('_', '-')} " in str(error.value) and "\n" not in str(error.value)
    with pytest.raises(common.InputError, match="--num-iterations 299 is less than the 300"):
        module.train(dataclasses.replace(config, num_iterations=299))


def test_refusal_at_the_command_line(script, reference, tmp_path):
    for arguments, word in (([reference, "--seed", 1], "--seed"), ([tmp_path / "none"], "does not exist")):
        run = Process(script, ["--resume", *arguments], tmp_path / word)
        assert run.wait() == 2
        assert run.stderr.count("\n") == 1 and run.stderr.startswith("error: ") and word in run.stderr


def test_minitaur_resumes_exactly(tmp_path):
    pytest.importorskip("pybullet")
    arguments = (
        "--device cpu --no-video --num-iterations 60 --initial-collect-steps 200 --batch-size 32 --log-interval 5 "
        "--eval-interval 60 --num-eval-episodes 1 --checkpoint-interval 20 --actor-layers 32 32 --critic-layers 32 32"
    ).split()
    finish("sac_minitaur", [*arguments, "--run-dir", tmp_path / "whole"], tmp_path / "1")
    run = Process("sac_minitaur", [*arguments, "--run-dir", tmp_path / "run"], tmp_path / "2", at_update_50)
    assert run.wait() == -signal.SIGKILL
    state = checkpoint(tmp_path / "run")
    assert state["shared"]["step"] == 40 and len(state["ranks"][0]["episodes"]["actions"][0]) > 0  # in mid-episode
    assert state["shared"]["agent"]["critics"]["q1.1.weight"].shape[1] == 28 + 7 + 8  # what only they see among it
    finish("sac_minitaur", ["--resume", tmp_path / "run"], tmp_path / "3")
    assert_same_run(tmp_path / "run", tmp_path / "whole")


def at_update_50(module):
    before_call(module.SACAgent, "update", 50, die)


def test_soak(script, tmp_path):
    """Cycles of killing and resuming, at moments drawn at random, end in the bits of an uninterrupted run."""
    per_cycle = 20
    size = ["--num-iterations", per_cycle * CYCLES + 100, "--checkpoint-interval", 9, "--num-eval-episodes", 1]
    finish(script, flags(script, tmp_path / "whole", *size), tmp_path / "output")
    draw = random.Random(0)
    arguments = flags(script, tmp_path / "run", *size)
    for cycle in range(CYCLES):
        done = checkpoint(tmp_path / "run")["shared"]["step"] if cycle else 0
        # Now and then from the start on: at its imports, at its first files, at the replay of its episode.
        first = 0 if cycle and draw.random() < 0.3 else draw.randint(1, per_cycle) + cycle * per_cycle - done
        hook = partial(kill_after, updates=first, events=draw.randint(1, 300_000 if first <= 0 else 4_000))
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

    start = partial(sys.setprofile, count)
    if updates > 0:
        before_update(module, updates, start)
    else:
        start()
