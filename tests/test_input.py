"""What the user gives and what cannot be used of it: one line, exit status 2, nothing lost."""

import dataclasses
import io
import pickle
import re
import shutil
import sys
from functools import partial
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch

import common
from runs import MODULES, ROOT, read_command_line, read_csv

# The tutorials' values, here written down a second time.
TUTORIALS = {
    "sac_minitaur": {
        "env_id": "MinitaurBulletEnv-v0", "num_iterations": 100_000, "num_envs": 1, "initial_collect_steps": 10_000,
        "collect_steps_per_iteration": 1, "replay_buffer_capacity": 10_000, "batch_size": 256,
        "actor_update_interval": 1, "actor_learning_rate": 3e-4, "critic_learning_rate": 3e-4,
        "alpha_learning_rate": 3e-4, "adam_epsilon": 1e-7, "adam_beta1": 0.9, "privileged_critics": False,
        "critic_batch_norm": False, "target_update_tau": 0.005, "gamma": 0.99, "time_limit_terminates": True,
        "observation_scaling": False, "reward_scaling": False, "reward_scale_factor": 1, "averaged_actor_tau": 1,
        "critic_loss_weight": 0.5, "target_entropy_per_action": -0.5, "initial_log_alpha": 0,
        "actor_layers": (256, 256), "critic_layers": (256, 256), "eval_interval": 10_000, "num_eval_episodes": 20,
    },
    "dqn_cartpole": {
        "env_id": "CartPole-v0", "num_iterations": 20_000, "initial_collect_steps": 100,
        "collect_steps_per_iteration": 1, "replay_buffer_capacity": 100_000, "batch_size": 64, "learning_rate": 1e-3,
        "learning_rate_decay": None, "adam_epsilon": 1e-7, "epsilon": 0.1, "gamma": 1, "time_limit_terminates": True,
        "target_update_tau": 1, "value_unit": False, "advantage_learning": 0, "observation_scaling": False,
        "layers": (100, 50), "log_interval": 200, "eval_interval": 1_000, "num_eval_episodes": 10,
    },
}  # fmt: skip


def main(monkeypatch, *arguments, script="sac_minitaur"):
    """The command line within this process. Returns the exit status."""
    monkeypatch.setattr(sys, "argv", [f"{script}.py", *map(str, arguments)])
    try:
        common.run_main(MODULES[script].main)
    except SystemExit as exit_:
        return exit_.code
    return 0


def refused(script, *arguments):
    """The one line that refuses this command line, from reading it or from training."""
    with pytest.raises(common.InputError, match="^[^\n]*$") as error:
        config, resume, _ = read_command_line(script, *arguments)
        MODULES[script].train(config, resume)
    return str(error.value)


def test_tutorial_sets_every_value_that_is_ours_to_theirs(script):
    """And no other differs. Other flags count beside it."""
    lines = (ROOT / f"{script}.py").read_text().splitlines()
    ours = {line.split(":")[0].strip() for line in lines if re.search(r"^    \w+: .* # ours\b", line)}
    module, theirs = MODULES[script], TUTORIALS[script]
    config, _, _ = read_command_line(script, "--tutorial")
    assert {name: getattr(config, name) for name in theirs} == theirs
    assert {name for name in theirs if getattr(module.Config(), name) != theirs[name]} == ours
    assert module.TUTORIAL.keys() == ours
    given, _, _ = read_command_line(script, "--gamma", 0.9, "--tutorial", "--no-time-limit-terminates")
    assert given == dataclasses.replace(config, gamma=0.9, time_limit_terminates=False)
    assert read_command_line(script, "--tutorial", "--no-tutorial")[0] == module.Config()


OUT_OF_RANGE = {
    "sac_minitaur": """
        --batch-size 0, --num-envs 1025, --critic-layers 0, --device tpu, --env-id a:b:c, --actor-learning-rate -1,
        --adam-beta1 1, --gamma 1.01, --initial-log-alpha nan, --seed -1, --batch-size x, --wings 2""",
    "dqn_cartpole": "--learning-rate-decay 0, --num-envs 2, --resume x --evaluate y, --tutorial --resume x",
}


@pytest.mark.parametrize("script, arguments", [(s, a) for s in MODULES for a in OUT_OF_RANGE[s].split(",")])
def test_values_out_of_range_are_refused_by_name(script, arguments, monkeypatch, capfd):
    flag = arguments.split()[0]
    status = main(monkeypatch, *arguments.split(), script=script)
    output = capfd.readouterr()
    assert status == 2 and output.out == "" and "Traceback" not in output.err
    assert flag in output.err or flag[2:].replace("-", "_") in output.err
    assert len(output.err.splitlines()) < 20


@pytest.mark.parametrize(
    "arguments, said",
    [
        ("--env-id NoSuchTask-v0", "NoSuchTask.* package:Task-v0"),
        ("--env-id no_such_module:Task-v0", "no_such_module"),
        ("--env-id CartPole-v1", "dqn_cartpole.py needs a Discrete"),
        ("--device cuda:77", "--device cuda:77 cannot be used .*: use --device cpu"),
        ("--device mps", "--device mps cannot be used"),
        ("--cuda-graph", "with a CUDA GPU: use --no-cuda-graph"),
        ("--checkpoint-interval 199", "cuts each episode of 200 steps before its end: use a larger one"),
        ("--resume nowhere", "nowhere/checkpoint.pt cannot be used .* No such file"),
        ("--evaluate nowhere.pt", "nowhere.pt cannot be used .* No such file"),
        ("--evaluate full/file", "full/file cannot be used as a policy of sac_minitaur"),
        ("--run-dir full", "--run-dir full cannot be made .* name a new directory"),
    ],
)
def test_bad_input_is_one_line_and_status_2(arguments, said, monkeypatch, capfd, tmp_path):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "file").write_text("somebody's work")
    flags = "--env-id Pendulum-v1 --device cpu --initial-collect-steps 250 --batch-size 32 --num-iterations 1"
    assert main(monkeypatch, *flags.split(), "--run-dir", "run", *arguments.split()) == 2
    output = capfd.readouterr()
    assert output.err.startswith("error: ") and output.err.count("\n") == 1
    assert re.search(said, output.err), output.err
    assert (tmp_path / "full" / "file").read_text() == "somebody's work"
    assert not list(tmp_path.glob("run*"))  # the corrected command may name the same directory


def test_a_notebooks_streams_have_no_reconfigure(monkeypatch):
    for name in ("stdout", "stderr"):
        monkeypatch.setattr(sys, name, io.StringIO())
    assert main(monkeypatch, "--resume", "nowhere") == 2
    assert sys.stderr.getvalue().startswith("error: nowhere/checkpoint.pt cannot be used")


BOX = gym.spaces.Box(-1, 1, (2,))


@pytest.mark.parametrize(
    "kind, observations, actions, needed",
    [
        ("observation", gym.spaces.Box(-1, 1, ()), BOX, gym.spaces.Box),
        ("observation", gym.spaces.Discrete(3), BOX, gym.spaces.Box),
        ("action", BOX, gym.spaces.Box(0, 200, (2,), np.uint8), gym.spaces.Box),
        ("action", BOX, gym.spaces.Box(-1, np.inf, (2,)), gym.spaces.Box),
        ("action", BOX, gym.spaces.Box(-1, 1, ()), gym.spaces.Box),
        ("action", BOX, gym.spaces.Discrete(3), gym.spaces.Box),
        ("action", BOX, BOX, gym.spaces.Discrete),
        ("action", BOX, gym.spaces.Discrete(2, start=1), gym.spaces.Discrete),
    ],
)
def test_spaces_that_an_algorithm_cannot_use(kind, observations, actions, needed):
    with pytest.raises(common.InputError, match=f"^Mine-v0 has the {kind} space .*gymnasium.wrappers"):
        common.require_spaces("Mine-v0", observations, actions, needed)


class CreatesFile:
    """Its pickle creates a file where it is loaded."""

    def __reduce__(self):
        return open, ("created", "w")


def change(path, **values):
    torch.save(torch.load(path, weights_only=True) | values, path)


DAMAGES = {
    "truncated": lambda path: path.write_bytes(path.read_bytes()[: path.stat().st_size // 2]),
    "text": lambda path: path.write_text("a shopping list\n"),
    "another script's": partial(change, script="td3_ant"),
    "another format": partial(change, format=0),
    "another kind": partial(change, kind="video"),
    "another version's": lambda path: change(path, config=torch.load(path)["config"] | {"wings": 2}),
    "a value out of range": lambda path: change(path, config=torch.load(path)["config"] | {"gamma": 2.0}),
    "missing": Path.unlink,
    "a hostile value": lambda path: torch.save({"format": CreatesFile()}, path),
    "a hostile pickle": lambda path: path.write_bytes(pickle.dumps(CreatesFile())),
}


@pytest.fixture
def copy(reference, tmp_path):
    """A finished run, to be damaged."""
    return shutil.copytree(reference, tmp_path / "run")


@pytest.mark.parametrize("name", ["checkpoint.pt", "policy.pt"])
def test_damaged_or_foreign_file(script, copy, monkeypatch, name):
    """The run itself stays as it is, and nothing in the file is executed."""
    monkeypatch.chdir(copy)
    whole = (copy / name).read_bytes()
    arguments = ["--resume", copy] if name == "checkpoint.pt" else ["--evaluate", copy / name]
    table = (copy / "train.csv").read_bytes()
    for what, damage in DAMAGES.items():
        (copy / name).write_bytes(whole)
        damage(copy / name)
        assert str(copy / name) in refused(script, *arguments), what
        assert not (copy / "created").exists(), what
    assert (copy / "train.csv").read_bytes() == table


def test_a_changed_script(script, copy):
    """Its network is larger, it has one more optimizer or one of another kind, or other tensors in its replay."""
    state = torch.load(copy / "checkpoint.pt")
    larger = {name: torch.stack((value, value)) for name, value in state["agent"].items()}
    first, *others = state["optimizers"]
    grouped = first | {"param_groups": 2 * first["param_groups"]}
    own = state["processes"][0]
    more_replay = own | {"replay": own["replay"] | {"ages": torch.zeros(250)}}
    less_replay = own | {"replay": {name: rows for name, rows in own["replay"].items() if name != "rewards"}}
    for values in (
        {"agent": larger}, {"optimizers": others}, {"optimizers": [grouped, *others]},
        {"processes": [more_replay]}, {"processes": [less_replay]},
    ):  # fmt: skip
        torch.save(state | values, copy / "checkpoint.pt")
        assert f"{copy} does not fit" in refused(script, "--resume", copy)


def test_a_policy_is_evaluated_as_the_run_was(script, reference, monkeypatch, capsys):
    """Its file says on what task and on which episodes. Other episodes may be chosen."""
    evaluate = partial(main, monkeypatch, "--no-video", script=script)
    evaluations = read_csv(reference / "eval.csv")
    best = max(evaluations, key=lambda row: row["average_return"])
    for name, row in (("policy.pt", evaluations[-1]), ("best_policy.pt", best)):
        assert evaluate("--evaluate", reference / name) == 0
        spread, length = (row[f"std_{of}"] for of in ("return", "episode_length"))
        assert capsys.readouterr().out.splitlines()[-1] == (
            f"{reference / name}: AverageReturn = {row['average_return']:.6f} +/- {spread:.6f}, "
            f"AverageEpisodeLength = {row['average_episode_length']:.6f} +/- {length:.6f}"
        )
    other_task = "MountainCar-v0" if script == "dqn_cartpole" else "MountainCarContinuous-v0"
    assert evaluate("--evaluate", reference / "policy.pt", "--env-id", other_task) == 2
    error = capsys.readouterr().err
    assert "policy.pt does not fit MountainCar" in error and error.count("\n") == 1
    assert evaluate("--evaluate", reference / "best_policy.pt", "--num-eval-episodes", 1, "--seed", 9) == 0
    assert "+/- 0.000000, Average" in capsys.readouterr().out


def test_commands_of_readme_and_docstrings_are_taken():
    text = "\n".join((ROOT / name).read_text() for name in ("README.md", "sac_minitaur.py", "dqn_cartpole.py"))
    commands = re.findall(r"(?:python|nproc-per-node \w+) (\w+)\.py((?: +-{1,2}[^`#\n]*)?)", text)
    assert len(commands) > 15
    for script, arguments in commands:
        arguments = re.sub(r"--(resume|evaluate) runs/\S+|--seed S|--help", "", arguments)
        read_command_line(script, *arguments.split())
