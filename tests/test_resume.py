"""A run that was stopped or killed continues as if nothing had happened, whatever the moment."""

import dataclasses
import io
import json
import math
import os
import signal
from functools import partial
from unittest import mock

import numpy as np
import pytest
import torch

import common
import dqn_cartpole
import sac_minitaur
from runs import AGENTS, MODULES, ROOT, Process, assert_same_run, before_call, checkpoint, die, flags
from runs import interrupt, read_command_line, read_csv, rows, run_python, session, terminate, wait_until


def test_reference_is_worth_comparing_with(script, reference):
    """Its replay is full, episodes ended in it, it was evaluated three times, and all its files are there."""
    state = checkpoint(reference)
    num_envs = 2 if script == "sac_minitaur" else 1
    assert state["step"] == 300 and state["env_steps"] == 96 + 300 * num_envs
    own = state["processes"][0]
    assert own["size"] == len(own["replay"]["rewards"]) == 250 and own["replay"]["observations"].dim() == 2
    names = {path.name for path in reference.iterdir() if "events" not in path.name}
    assert names == {
        "config.json", "train.csv", "eval.csv", "random.csv", "learning_curve.png", "checkpoint.pt", "policy.pt",
        "best_policy.pt", "policy.pt2", "best_policy.pt2",
    }  # fmt: skip
    assert (reference / "learning_curve.png").read_bytes().startswith(b"\x89PNG")
    last = read_csv(reference / "train.csv")[-1]
    finished = state["finished"]
    assert len(finished) == 10
    shown = [last["collect_return"], last["collect_episode_length"]]
    assert shown == pytest.approx(list(np.mean(finished, axis=0)))
    evaluations = read_csv(reference / "eval.csv")
    assert [row["step"] for row in evaluations] == [0, 100, 200, 300]
    if script == "dqn_cartpole":  # one script with another best policy than the last is enough
        assert max(evaluations, key=lambda row: row["average_return"]) is not evaluations[-1]
    assert list(evaluations[0]) == [
        "step", "env_steps", "seconds", "average_return", "std_return", "min_return", "max_return",
        "average_episode_length", "std_episode_length",
    ]  # fmt: skip
    name, unfitted = {"sac_minitaur": ("reward_scale", 0.5), "dqn_cartpole": ("value_scale", 1)}[script]
    assert state["agent"][name].item() != unfitted
    assert_tensorboard_once(reference)


def assert_tensorboard_once(run_dir):
    """TensorBoard has each finite number of the CSVs once."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(run_dir), size_guidance={"scalars": 0}).Reload()
    shown = [((tag, event.step), event.value) for tag in events.Tags()["scalars"] for event in events.Scalars(tag)]
    expected = {}
    for table in ("train", "eval", "random"):
        for row in read_csv(run_dir / f"{table}.csv"):
            for name, value in row.items():
                if name != "step" and math.isfinite(value):
                    expected[f"{table}/{name}", row["step"]] = value
    assert len(shown) == len(expected) and dict(shown) == pytest.approx(expected)


def test_the_same_seed_gives_the_same_bits(script, reference, tmp_path, monkeypatch):
    """Called from Python, with workers that are spawned, as on macOS and Windows. Another seed gives other bits."""
    module = MODULES[script]
    config = module.Config(**json.loads((reference / "config.json").read_text()) | {"run_dir": tmp_path / "same"})
    torch.set_num_threads(2)
    handler = signal.getsignal(signal.SIGINT)
    rename = mock.Mock(wraps=os.replace)
    with monkeypatch.context() as patch:
        patch.setattr(common, "start_method", lambda env_id: "spawn")
        patch.setattr(os, "replace", rename)
        assert module.train(config) == tmp_path / "same"
    assert torch.get_num_threads() == 2 and signal.getsignal(signal.SIGINT) is handler
    assert_same_run(tmp_path / "same", reference)
    renamed = {call.args[1] for call in rename.call_args_list}  # a file that is written beside its place is whole
    assert {path for path in (tmp_path / "same").iterdir() if "events" not in path.name} <= renamed
    other = module.train(dataclasses.replace(config, run_dir=tmp_path / "other", seed=1, num_iterations=1))
    mine, other = checkpoint(reference), checkpoint(other)
    first_layers = [name for name in mine["agent"] if name.endswith("net.0.weight")]
    assert first_layers and not any(torch.equal(mine["agent"][name], other["agent"][name]) for name in first_layers)
    assert mine["tables"]["random"][0]["average_return"] != other["tables"]["random"][0]["average_return"]


def die_in_the_second_checkpoint(module):
    """With half of it written."""
    save, calls = torch.save, iter((1, 2))

    def save_half(state, file):
        if state["kind"] != "checkpoint" or next(calls) == 1:
            return save(state, file)
        save(state, whole := io.BytesIO())
        file.write(whole.getvalue()[: whole.tell() // 2])
        file.flush()
        die()

    torch.save = save_half


def test_stopped_killed_and_raised_at_every_moment(script, reference, tmp_path):
    """The bits are those of a run left alone. An evaluation that is stopped is done again."""
    run_dir = tmp_path / "run α"
    resume = ["--resume", run_dir, "--device", "auto"]
    killed = -signal.SIGKILL
    random_step = partial(before_call, common.Run, "stop_if_requested", 20)
    evaluation = partial(before_call, common.Run, "evaluate")  # call 1 is the random policy's, which is there
    curve = partial(before_call, common.Run, "_plot", 1)
    update = partial(before_call, AGENTS[script], "update", 5)
    stages = (
        ("random steps", flags(script, run_dir, "--num-iterations", 150), partial(random_step, die), killed),
        ("evaluation at 0", resume, partial(evaluation, 2, die), killed),
        ("evaluation at 100", resume, partial(evaluation, 3, interrupt), 130),
        ("end at 150", resume, partial(curve, die), killed),
        ("raised", [*resume, "--num-iterations", 300], partial(update, die), killed),
        ("checkpoint at 200", resume, die_in_the_second_checkpoint, killed),
        ("evaluation at 300", resume, partial(evaluation, 3, interrupt), 130),
        ("film", [*resume, "--video"], partial(before_call, common.Run, "_film", 1, die), killed),
        ("film stopped", [*resume, "--video"], partial(before_call, common.Run, "_film", 1, interrupt), 130),
        ("film ended", [*resume, "--video"], partial(before_call, common.Run, "_film", 1, terminate), -signal.SIGTERM),
    )
    for name, arguments, hook, status in stages:
        run = Process(script, arguments, tmp_path / name, hook)
        assert run.wait() == status, (name, run.stdout, run.stderr)
        for path in run_dir.glob("*.csv"):
            rows(path)
        if "evaluation" in name and status == 130:
            assert f"stopped at step {name.split()[-1]}" in run.stdout
    assert not list(run_dir.glob("*.mp4"))
    (run_dir / "notes.csv").write_text("a student's own\n")
    (run_dir / ".tmp-checkpoint.pt").write_text("left by a kill")
    (run_dir / "best_policy.pt").write_bytes((run_dir / "policy.pt").read_bytes())  # of after the checkpoint
    # The real command, in a new interpreter, from another directory. The run knows that it was raised.
    run_python(tmp_path, ROOT / f"{script}.py", *resume)
    assert_same_run(run_dir, reference)
    assert_tensorboard_once(run_dir)
    assert json.loads((run_dir / "config.json").read_text())["num_iterations"] == 300
    assert len(list(run_dir.glob("*.mp4"))) == 3
    assert (run_dir / "notes.csv").exists() and not list(run_dir.glob(".tmp-*"))
    seconds = [row["seconds"] for row in read_csv(run_dir / "train.csv")]
    assert seconds == sorted(seconds)


def test_the_film_of_a_raised_run_is_that_of_a_longer_one(tmp_path):
    """The policies in it do not depend on how many updates are wanted, but for the last."""
    for num_iterations, expected in ((1000, [0, 10, 40, 160]), (200, [0, 10, 40, 160, 200])):
        config = dqn_cartpole.Config(run_dir=tmp_path, device="cpu", num_iterations=num_iterations)
        run = common.Run("dqn_cartpole", config, None)
        for step in range(0, 201, 10):
            run._keep(step, -math.inf, {})
        assert [step for step, *_ in run.snapshots] == expected


def test_what_may_change(script, reference):
    """From Python a config needs no more than the changes."""
    module = MODULES[script]
    for changes, said in (
        ({"num_iterations": 299}, "--num-iterations 299 is less than the run's 300"),
        ({"gamma": 0.5}, "--gamma 0.5 differs from the 0.99 of the run .* leave it out"),
        ({"run_dir": "elsewhere"}, "--run-dir elsewhere differs from"),
    ):
        with pytest.raises(common.InputError, match=said):
            common.continued(module.Config(**{"num_iterations": 300} | changes), reference, script)
    changed = module.Config(num_iterations=310, num_threads=2, device="cuda", run_dir=reference)
    config, state = common.continued(changed, reference, script)
    saved = module.Config(**state["config"])
    changes = {"num_iterations": 310, "num_threads": 2, "device": "cuda", "video": True, "run_dir": reference}
    assert config == dataclasses.replace(saved, **changes) and config.batch_size == 24


def test_a_csv_keeps_its_columns(tmp_path):
    """A metric that appears later goes to TensorBoard alone."""
    writer = common.TableWriter(tmp_path, {"train": []})
    shown = []
    writer.board.add_scalar = lambda *scalar: shown.append(scalar)
    writer.add("train", {"step": 20, "loss": 1.5})
    writer.add("train", {"step": 40, "loss": math.nan, "one": 1.0})
    assert rows(tmp_path / "train.csv") == [["step", "loss"], ["20", "1.5"], ["40", "nan"]]
    assert shown == [("train/loss", 1.5, 20), ("train/one", 1.0, 40)]


@pytest.mark.parametrize("number, status", [(signal.SIGINT, 130), (signal.SIGTERM, 130), (signal.SIGKILL, -9)])
def test_a_signal_ends_the_run_and_all_its_processes(script, number, status, tmp_path):
    """A terminal sends Ctrl-C to all processes. The run saves a checkpoint and says how to continue."""
    run_dir = tmp_path / "a run"
    endless = ("--num-iterations", 10**6, "--log-interval", 10, "--eval-interval", 10**6)
    run = Process(script, flags(script, run_dir, *endless), tmp_path / "output")
    wait_until((run_dir / "train.csv").exists)
    # The main process, two workers of evaluation, SAC's two environments
    assert len(session(run.pid)) >= (5 if script == "sac_minitaur" else 3)
    if number == signal.SIGINT:
        os.killpg(run.pid, number)
    else:
        os.kill(run.pid, number)
    assert run.wait() == status, run.stderr  # and no process of its session is left
    if number == signal.SIGKILL:
        return
    assert run.stderr.strip() == "stopping: saving a checkpoint first (Ctrl-C again stops at once)"
    state = checkpoint(run_dir)
    said = f"stopped at step {state['step']}; to continue: --resume '{run_dir}'"
    assert state["step"] >= 10 and run.stdout.splitlines()[-1].startswith(said)
    assert (run_dir / "learning_curve.png").exists() and not list(run_dir.glob("*.pt2"))
    sixth_update = partial(before_call, AGENTS[script], "update", 6, interrupt)
    again = Process(script, ["--resume", run_dir], tmp_path / "again", sixth_update)
    assert again.wait() == 130, again.stderr
    assert checkpoint(run_dir)["step"] == state["step"] + 6  # it went on from there


def test_a_second_ctrl_c_stops_at_once(script, tmp_path):
    """Also while random actions are evaluated, before the first update."""
    run = Process(script, flags(script, tmp_path / "run", "--num-eval-episodes", 10**5), tmp_path / "output")
    wait_until((tmp_path / "run" / "checkpoint.pt").exists)
    os.kill(run.pid, signal.SIGINT)
    wait_until(lambda: "stopping" in run.stderr)
    os.kill(run.pid, signal.SIGINT)
    assert run.wait(60) == 130, run.stderr
    assert "stopped at step" not in run.stdout


def test_minitaur_resumes_exactly(tmp_path):
    """With what only the critics see in its replay."""
    pytest.importorskip("pybullet")
    minitaur = "--env-id MinitaurBulletEnv-v0 --num-iterations 75 --num-eval-episodes 1".split()
    config, _, _ = read_command_line("sac_minitaur", *flags("sac_minitaur", tmp_path / "whole", *minitaur))
    whole = sac_minitaur.train(config)
    hook = partial(before_call, sac_minitaur.SACAgent, "update", 60, die)
    run = Process("sac_minitaur", flags("sac_minitaur", tmp_path / "run", *minitaur), tmp_path / "output", hook)
    assert run.wait() == -signal.SIGKILL
    state = checkpoint(tmp_path / "run")
    assert state["step"] == 50
    assert state["processes"][0]["replay"]["observations"].shape[1] == 28 + 7
    run_dir = sac_minitaur.train(sac_minitaur.Config(num_iterations=75, device="cpu"), resume=tmp_path / "run")
    assert_same_run(run_dir, whole)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA GPU")
def test_a_run_on_a_gpu_continues_exactly(script, reference, tmp_path):
    """And on the CPU. SAC's updates are replayed as a CUDA graph: they are those of the run without one."""
    module = MODULES[script]
    config = module.Config(**json.loads((reference / "config.json").read_text()) | {"device": "cuda"})
    with_graph = {"cuda_graph": True} if script == "sac_minitaur" else {}
    whole = module.train(dataclasses.replace(config, run_dir=tmp_path / "whole"))
    module.train(dataclasses.replace(config, run_dir=tmp_path / "run", num_iterations=150, **with_graph))
    run = module.train(config, resume=tmp_path / "run")
    assert_same_run(run, whole)
    module.train(dataclasses.replace(config, device="cpu", num_iterations=310), resume=run)
    assert checkpoint(run)["step"] == 310
