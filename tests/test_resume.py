"""A run that was stopped or killed continues as if nothing had happened, whatever the moment.

`SOAK_CYCLES=30 pytest tests/test_resume.py -k soak` kills each script's run 30 times.
"""

import copy
import dataclasses
import importlib
import io
import json
import math
import multiprocessing
import os
import random
import re
import shlex
import shutil
import signal
import subprocess
import sys
import threading
import time
from functools import partial
from pathlib import Path

import imageio
import numpy as np
import pytest
import torch

import common
from runs import AGENTS, ROOT, TASK, Process, assert_same, assert_same_run, before_call, before_update, checkpoint
from runs import die, finish, flags, interrupt, read_command_line, read_csv, rows, wait_until

CYCLES = int(os.environ.get("SOAK_CYCLES", 3))


def collecting(module):
    before_random_actions(module, 40, die)


def updating(module):
    before_update(module, 75, die)


def evaluating(module):
    """In the untrained policy's evaluation, which other processes do, once one of them has done 5 steps of it."""
    main = os.getpid()
    before_call(module.Policy, "act", 5, lambda: os.kill(main, signal.SIGKILL))


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
    save = common.Run._save
    common.Run._save = lambda run, name, *more: die() if name == "checkpoint.pt" else save(run, name, *more)


def filming(module):
    main = os.getpid()
    before_call(imageio, "get_writer", 1, lambda: (os.kill(main, signal.SIGKILL), time.sleep(60)))


MOMENTS = (collecting, evaluating, updating, writing_a_checkpoint, between_policy_and_checkpoint, filming)


def test_reference_is_worth_comparing_with(script, reference):
    """It learned, its episodes end at other steps than its checkpoints, and its replay has wrapped around."""
    state = checkpoint(reference)
    own = state["ranks"][0]
    assert state["step"] == 300 and len(own["buffer"]["rows"]) == 250
    assert any(len(actions) > 0 for _, actions in own["environments"]["episodes"])
    assert [row[0] for row in rows(reference / "eval.csv")] == ["step", "0", "100", "200", "300"]
    assert [row[0] for row in rows(reference / "train.csv")] == ["step", *map(str, range(20, 301, 20))]
    files = {"config.json", "random.csv", "policy.pt", "policy.pt2", "best_policy.pt", "best_policy.pt2"}
    assert files <= {path.name for path in reference.iterdir()} and list(reference.glob("events.out.tfevents.*"))
    assert (reference / "learning_curve.png").read_bytes().startswith(b"\x89PNG")
    assert not list(reference.glob("*.mp4"))  # --no-video
    # The speed is that of the updates since the last row.
    first, *later = read_csv(reference / "train.csv")
    if finished := own["environments"]["finished"]:  # the last ten; a pendulum's first episode is not over yet
        assert len(finished) == 10 and len(set(finished)) > 1
        shown = [later[-1]["collect_return"], later[-1]["collect_episode_length"]]
        assert shown == pytest.approx(list(np.mean(finished, axis=0)))
    seconds = sum(20 / row["steps_per_second"] for row in later)
    assert seconds == pytest.approx(later[-1]["seconds"] - first["seconds"], abs=0.1)


def test_the_same_seed_gives_the_same_bits(script, reference, monkeypatch, tmp_path):
    """Another gives other networks, actions and episodes."""
    module = importlib.import_module(script)
    config = json.loads((reference / "config.json").read_text())
    assert_same_run(module.train(module.Config(**config | {"run_dir": tmp_path / "same"})), reference)
    networks, start = [], common.Run.start
    monkeypatch.setattr(common.Run, "start", lambda *args: networks.append(copy.deepcopy(args[1])) or start(*args))
    one_update, states = config | {"num_iterations": 1}, []
    for seed in range(2):
        path = module.train(module.Config(**one_update | {"run_dir": tmp_path / f"{seed}", "seed": seed}))
        states.append(checkpoint(path))
    matrices = [[p for p in agent.parameters() if p.dim() == 2 and p.unique().numel() > 1] for agent in networks]
    assert matrices[0] and not any(torch.equal(*pair) for pair in zip(*matrices))
    size = 3 if script == "sac_minitaur" else 4  # of an observation
    mine, other = (state["ranks"][0]["buffer"]["rows"] for state in states)
    assert not torch.equal(mine[:96, size], other[:96, size])  # the random actions
    assert (mine[:2, :size] != other[:2, :size]).any(1).all()  # the episodes' first observations
    mine, other = (state["tables"]["random"][0]["average_return"] for state in states)
    assert mine != other


def test_killed_at_every_moment_and_resumed(script, reference, tmp_path):
    arguments = flags(script, tmp_path / "run", "--num-envs", 2)
    for moment in MOMENTS:
        film = ["--video"] if moment is filming else []
        run = Process(script, arguments + film, tmp_path / moment.__name__, moment)
        assert run.wait() == -signal.SIGKILL, (moment.__name__, run.stdout, run.stderr)
        for path in (tmp_path / "run").glob("*.csv"):
            rows(path)
        arguments = ["--resume", tmp_path / "run"]
    assert not list((tmp_path / "run").glob("[!.]*.mp4")) and list((tmp_path / "run").glob(".tmp-*.mp4"))
    (tmp_path / "run" / "notes.csv").write_text("a student's own\n")
    finish(script, [*arguments, "--no-video"], tmp_path / "last")
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


def test_raised_run_equals_a_longer_one(script, reference, tmp_path):
    """Also when the shorter one ended with an evaluation of its own, and when the longer one is killed at once."""
    shorter = flags(script, tmp_path / "run", "--num-envs", 2, "--num-iterations", 190)
    finish(script, shorter, tmp_path / "shorter")
    assert rows(tmp_path / "run" / "eval.csv")[-1][0] == "190"
    raised = ["--resume", tmp_path / "run", "--num-iterations", 300]
    hook = partial(before_update, count=5, action=die)
    assert Process(script, raised, tmp_path / "raised", hook).wait() == -signal.SIGKILL
    # The real command, in a new interpreter. The run knows that it was raised.
    command = [sys.executable, ROOT / f"{script}.py", "--resume", tmp_path / "run"]
    result = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert_same_run(tmp_path / "run", reference)
    assert json.loads((tmp_path / "run" / "config.json").read_text())["num_iterations"] == 300


def test_the_best_policy_is_the_checkpoints_again(script, reference, tmp_path):
    """Where its file was written after the checkpoint, and no evaluation to come is as good.

    Also on another machine than the one with the GPU that the run began on, with other flags of the machine's.
    """
    shutil.copytree(reference, tmp_path / "run")
    state = checkpoint(tmp_path / "run")
    state["best"] = (1e9, state["best"][1])
    state["config"]["device"] = "cuda:7"
    torch.save(state, tmp_path / "run" / "checkpoint.pt")
    (tmp_path / "run" / "best_policy.pt").write_bytes(b"of an evaluation to come")
    finish(script, ["--resume", tmp_path / "run", "--device", "cpu", "--num-threads", 2], tmp_path / "output")
    saved = common.read_file(tmp_path / "run" / "best_policy.pt", "policy", script)
    assert_same(saved["weights"], state["best"][1])


def test_metrics_of_a_fork(script, reference, tmp_path, monkeypatch):
    """A new one, a Python number, is a new column. An evaluation may return numpy's numbers: no checkpoint has them.

    The seconds count on from the checkpoint's.
    """
    shutil.copytree(reference, run := tmp_path / "run")
    torch.save(checkpoint(run) | {"seconds": 1e6}, run / "checkpoint.pt")
    module = importlib.import_module(script)
    log, (columns, *before) = common.Run.log_training, rows(run / "train.csv")
    monkeypatch.setattr(common.Run, "log_training", lambda run, step, metrics: log(run, step, metrics | {"one": 1}))
    monkeypatch.setattr(module, "evaluate", evaluate_in_numpy)
    for steps in (320, 340):
        module.train(module.Config(resume=run, num_iterations=steps))
        table = rows(run / "train.csv")
        assert table[:16] == [[*columns, "one"], *([*row, "nan"] for row in before)]
        assert [(row[0], row[-1]) for row in table[16:]] == [(str(i), "1.0") for i in range(320, steps + 1, 20)]
        assert read_csv(run / "train.csv")[-1]["seconds"] > 1e6
    assert_tensorboard_once(run)


def test_what_a_fork_keeps(script, reference, tmp_path, monkeypatch):
    """Its replay's tensors are in the checkpoint. One that could not be read again does not replace the last."""
    module, config = importlib.import_module(script), json.loads((reference / "config.json").read_text())
    buffer, agent = module.ReplayBuffer, getattr(module, AGENTS[script])
    init, add, update = buffer.__init__, buffer.add, agent.update

    def with_ages(self, capacity, *more, **named):
        init(self, capacity, *more, **named)
        self.ages = torch.zeros(capacity)

    def older(self, *step, **named):
        add(self, *step, **named)
        self.ages += 1

    def with_numpys_learning_rate(self, *batch, **named):
        metrics = update(self, *batch, **named)
        self.optimizers[0].param_groups[0]["lr"] = np.float64(1e-3)
        return metrics

    monkeypatch.setattr(buffer, "__init__", with_ages)
    monkeypatch.setattr(buffer, "add", older)
    run = module.train(module.Config(**config | {"run_dir": tmp_path / "run", "num_iterations": 40}))
    module.train(module.Config(resume=run, num_iterations=60))
    state = checkpoint(run)
    assert state["ranks"][0]["buffer"]["ages"][0] == state["env_steps"] / 2  # two environments
    monkeypatch.setattr(agent, "update", with_numpys_learning_rate)
    with pytest.raises(common.RunError, match="^checkpoint.pt could not be read again: it has numpy"):
        module.train(module.Config(resume=run, num_iterations=80))
    monkeypatch.setattr(buffer, "__init__", init)
    with pytest.raises(common.InputError, match="does not fit"):
        module.train(module.Config(resume=run, num_iterations=80))
    assert checkpoint(run)["step"] == 60


def test_a_forks_network_that_pickle_does_not_know(script, reference, tmp_path, monkeypatch):
    """A lambda in it is evaluated. What cannot be sent to a worker at all is told."""
    module, config = importlib.import_module(script), json.loads((reference / "config.json").read_text())
    init = module.Policy.__init__

    def with_a_lambda(self, *more):
        init(self, *more)
        self.scale = lambda output: output

    def with_a_parametrized_layer(self, *more):
        init(self, *more)
        self.layer = torch.nn.utils.parametrizations.weight_norm(torch.nn.Linear(1, 1))

    monkeypatch.setattr(module.Policy, "__init__", with_a_lambda)
    run = module.train(module.Config(**config | {"run_dir": tmp_path / "lambda", "num_iterations": 20}))
    assert [row["step"] for row in read_csv(run / "eval.csv")] == [0, 20]
    monkeypatch.setattr(module.Policy, "__init__", with_a_parametrized_layer)
    with pytest.raises(common.TaskError, match="^sending the policy to a worker failed: Serialization of parametrized"):
        module.train(module.Config(**config | {"run_dir": tmp_path / "parametrized", "num_iterations": 20}))


def evaluate_in_numpy(policy, task, seed):
    return np.float64(seed), np.int64(1)


def stop_and_continue(script, run_dir, output, arguments, hook):
    """Stops a run by the hook's signal and follows the command that it ends with.

    Returns the numbers of updates and of environment steps when it stopped.
    """
    run = finish(script, arguments, output / "stopped", hook)
    last = run.stdout.splitlines()[-1]
    state = checkpoint(run_dir)
    assert f"stopped at step {state['step']};" in last
    assert run.stderr.strip() == "stopping: saving a checkpoint first (Ctrl-C again stops at once)"
    assert (run_dir / "learning_curve.png").stat().st_size > 0 and not list(run_dir.glob("*.pt2"))
    finish(script, shlex.split(re.search(rf"python {script}\.py (--resume .+)$", last)[1]), output / "continued")
    return state["step"], state["env_steps"]


def test_stop_and_continue(script, reference, tmp_path):
    """A checkpoint at this very step, the curve, and a line with the command that continues, quoted for a shell."""
    for moment, count, stopped in ((before_update, 110, (110, 96 + 110)), (before_random_actions, 20, (0, 2 * 20))):
        run = tmp_path / f"{stopped[0]}" / "a run"
        arguments = flags(script, run, "--num-envs", 2)
        hook = partial(signal_the_group, moment=moment, count=count)
        assert stop_and_continue(script, run, run.parent, arguments, hook) == stopped
        assert_same_run(run, reference)


def before_random_actions(module, count, action):
    before_call(getattr(module, AGENTS[module.__name__]), "random_actions", count, action)


def signal_the_group(module, moment, count):
    """As a terminal and torchrun do."""
    number = signal.SIGTERM if module.__name__ == "sac_minitaur" else signal.SIGINT
    moment(module, count, lambda: os.killpg(0, number))


def test_stop_while_an_evaluation_is_under_way(script, reference, tmp_path):
    """It is left out, at once, and done when the run is continued. Also the last one."""
    arguments = flags(script, tmp_path / "run", "--num-envs", 2)
    step = 100 if script == "sac_minitaur" else 300
    hook = partial(hang_up_in_an_evaluation, step=step)
    assert stop_and_continue(script, tmp_path / "run", tmp_path, arguments, hook)[0] == step
    assert_same_run(tmp_path / "run", reference)


def hang_up_in_an_evaluation(module, step):
    """As a terminal that is closed. Most of the episodes still wait for a worker."""
    evaluate = common.Run.evaluate

    def evaluate_slowly(run, at, policy):
        if at == step and not run.stopping:
            run.evaluate_episode, common.evaluation_seeds = play_for_ever, lambda config: range(20)
            threading.Timer(0.5, os.kill, (os.getpid(), signal.SIGHUP)).start()
        return evaluate(run, at, policy)

    common.Run.evaluate = evaluate_slowly


def play_for_ever(policy, task, seed):
    time.sleep(10**6)


def test_second_interrupt_in_a_notebook(script, tmp_path):
    """It ends the cell and no more."""
    run = finish(script, flags(script, tmp_path / "run"), tmp_path / "output", interrupt_a_cell_twice)
    assert run.stdout.splitlines()[-1] == "the kernel lives, with 0 workers"
    assert checkpoint(tmp_path / "run")["step"] == 0  # the second came before a checkpoint was written


def interrupt_a_cell_twice(module):
    before_update(module, 20, interrupt)
    before_call(common.Run, "save", 2, interrupt)
    main = module.main

    def cell():
        with pytest.raises(KeyboardInterrupt):
            main()
        print(f"the kernel lives, with {len(multiprocessing.active_children())} workers")

    module.main = cell


def test_stop_while_filming(script, reference, tmp_path):
    """The films are made when the run is continued."""
    shutil.copytree(reference, run := tmp_path / "run")
    stopped = finish(script, ["--resume", run, "--video"], tmp_path / "stopped", interrupt_a_film)
    assert "stopped while filming; to continue" in stopped.stdout.splitlines()[-1]
    assert "warning" not in stopped.stdout and stopped.stderr.startswith("\nstopping:")
    assert len(stopped.stderr.splitlines()) == 2 and not list(run.glob("[!.]*.mp4"))
    finish(script, ["--resume", run, "--video"], tmp_path / "continued")
    assert len(list(run.glob("*.mp4"))) == 3


def interrupt_a_film(module):
    before_call(imageio.core.format.Format.Writer, "append_data", 3, lambda: time.sleep(60))
    before_call(common, "export_policy", 2, interrupt)  # while the workers film


def test_several_seeds_in_processes_of_a_script_of_their_own(script, tmp_path):
    """Each stops with a checkpoint, whether the terminal interrupts them all or one is asked to."""
    run = Process(script, [tmp_path], tmp_path / "output", train_seeds)
    assert run.wait() == 0
    assert all(0 < checkpoint(tmp_path / f"{seed}")["step"] < 10**6 for seed in range(2))
    assert run.stdout.count("stopped at step") == 2


def train_seeds(module):
    def main():
        values = {"num_iterations": 10**6, "initial_collect_steps": 96, "batch_size": 24, "log_interval": 20}
        values |= dict(zip(["env_id"], TASK[module.__name__][1:]))
        path, processes = Path(sys.argv[1]), []
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # inherited, as from a shell that starts it in the background
        for seed in range(2):
            config = module.Config(seed=seed, run_dir=path / f"{seed}", num_eval_episodes=1, device="cpu", **values)
            processes.append(multiprocessing.Process(target=module.train, args=(config,)))
            processes[-1].start()
        for seed, process in enumerate(processes):
            wait_until((path / f"{seed}" / "train.csv").exists)
        os.kill(processes[0].pid, signal.SIGTERM)
        processes[0].join()
        os.killpg(0, signal.SIGINT)
        processes[1].join()

    module.main = main


def test_every_other_change_is_refused(script, reference):
    """In one line that names the field."""
    config = read_command_line(script, "--resume", reference)
    for field in set(vars(config)) - {"resume", "evaluate"}:
        continued = copy.copy(config)
        value = {"device": "auto", "num_iterations": 301}.get(field, "another")
        object.__setattr__(continued, field, value)  # unchecked: few fields take such a value
        if field in ("video", "checkpoint_interval", "num_iterations", "device", "num_threads", "cuda_graph"):
            common.Run(continued, script, None, None)
        else:
            with pytest.raises(common.InputError, match=f"^--{field.replace('_', '-')} .*: leave it out$"):
                common.Run(continued, script, None, None)
    message = "--num-iterations 299 differs from the 300 of the run to resume: raise it"
    with pytest.raises(common.InputError, match=message):
        common.Run(dataclasses.replace(config, num_iterations=299), script, None, None)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA GPU")
def test_a_run_on_a_gpu_continues_exactly(script, reference, tmp_path):
    """In one process, as in a notebook, which has used the GPU when it starts the workers. The CPU continues it too.

    SAC's updates are replayed as a CUDA graph: they are those of the run without one.
    """
    module = importlib.import_module(script)
    config = json.loads((reference / "config.json").read_text()) | {"device": "cuda"}
    with_graph, without = ({"cuda_graph": value} if script == "sac_minitaur" else {} for value in (True, False))
    whole = module.train(module.Config(**config | {"run_dir": tmp_path / "whole"}))
    module.train(module.Config(**config | {"run_dir": tmp_path / "run", "num_iterations": 190} | with_graph))
    run = module.train(module.Config(resume=tmp_path / "run", num_iterations=300))
    assert_same_run(run, whole)
    module.train(module.Config(resume=run, num_iterations=310, device="cpu", **without))
    assert checkpoint(run)["step"] == 310


def test_where_processes_are_spawned(reference, script, tmp_path):
    """As on macOS and Windows."""
    finish(script, flags(script, tmp_path / "run", "--num-envs", 2), tmp_path / "output", spawn)
    assert_same_run(tmp_path / "run", reference)


def spawn(module):
    common.START_METHOD = "spawn"


def test_minitaur_resumes_exactly(tmp_path):
    pytest.importorskip("pybullet")
    arguments = (
        "--device cpu --no-video --num-iterations 60 --initial-collect-steps 200 --batch-size 32 --log-interval 5 "
        "--eval-interval 60 --num-eval-episodes 1 --checkpoint-interval 20 --actor-layers 32 32 --critic-layers 32 32"
    ).split()
    finish("sac_minitaur", [*arguments, "--run-dir", tmp_path / "whole"], tmp_path / "1")
    hook = partial(before_update, count=50, action=die)
    run = Process("sac_minitaur", [*arguments, "--run-dir", tmp_path / "run"], tmp_path / "2", hook)
    assert run.wait() == -signal.SIGKILL
    state = checkpoint(tmp_path / "run")
    assert state["step"] == 40 and len(state["ranks"][0]["environments"]["episodes"][0][1]) > 0  # in mid-episode
    assert state["ranks"][0]["buffer"]["rows"].shape[1] >= 2 * (28 + 7) + 8 + 2  # what only the critics see among it
    finish("sac_minitaur", ["--resume", tmp_path / "run"], tmp_path / "3")
    assert_same_run(tmp_path / "run", tmp_path / "whole")


def test_soak(script, tmp_path):
    """Cycles of killing and resuming, at moments drawn at random, end in the bits of an uninterrupted run."""
    per_cycle = 20
    size = ["--num-iterations", per_cycle * CYCLES + 100, "--checkpoint-interval", 9, "--num-eval-episodes", 1]
    finish(script, flags(script, tmp_path / "whole", *size), tmp_path / "output")
    draw = random.Random(0)
    arguments = flags(script, tmp_path / "run", *size)
    for cycle in range(CYCLES):
        done = checkpoint(tmp_path / "run")["step"] if cycle else 0
        # Now and then from the start on: at its imports, at its first files, at the replay of its episode.
        first = 0 if cycle and draw.random() < 0.3 else draw.randint(1, per_cycle) + cycle * per_cycle - done
        hook = partial(kill_after, updates=first, events=draw.randint(1, 300_000 if first <= 0 else 4_000))
        run = Process(script, arguments, tmp_path / f"cycle{cycle}", hook)
        assert run.wait() == -signal.SIGKILL, (cycle, run.stdout, run.stderr)
        for path in (tmp_path / "run").glob("*.csv"):
            rows(path)
        arguments = ["--resume", tmp_path / "run"]
    assert "warning" not in finish(script, arguments, tmp_path / "last").stdout
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
