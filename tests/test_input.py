"""What the user gives and what cannot be used of it: one line, exit status 2, nothing lost."""

import io
import pickle
import re
import shutil
import sys
import zipfile
from functools import partial
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch
from pydantic import ValidationError

import common
import dqn_cartpole
import sac_minitaur
from runs import ROOT, SCRIPTS, Process, finish, read_command_line, read_csv

MODULES = {"sac_minitaur": sac_minitaur, "dqn_cartpole": dqn_cartpole}
# The tutorials' values, here written down a second time.
TUTORIALS = {
    "sac_minitaur": {
        "actor_learning_rate": 3e-4, "critic_learning_rate": 3e-4, "alpha_learning_rate": 3e-4, "adam_beta1": 0.9,
        "privileged_critics": False, "critic_batch_norm": False, "reward_scaling": False, "reward_scale_factor": 1,
        "averaged_actor_tau": 1, "target_entropy_per_action": -0.5, "replay_buffer_capacity": 10_000,
        "time_limit_terminates": True, "num_iterations": 100_000, "num_envs": 1, "batch_size": 256,
        "actor_update_interval": 1, "observation_scaling": False,
    },
    "dqn_cartpole": {
        "learning_rate_decay": None, "gamma": 1, "target_update_tau": 1, "value_unit": False, "advantage_learning": 0,
        "observation_scaling": False, "time_limit_terminates": True,
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


def test_the_tutorials_values_are_the_defaults():
    config = sac_minitaur.Config()
    assert config.env_id == "MinitaurBulletEnv-v0" and config.initial_collect_steps == 10_000
    assert config.collect_steps_per_iteration == 1 and config.gamma == 0.99 and config.target_update_tau == 0.005
    assert config.actor_layers == config.critic_layers == (256, 256) and config.critic_loss_weight == 0.5
    assert config.adam_epsilon == 1e-7 and config.initial_log_alpha == 0
    assert (config.eval_interval, config.num_eval_episodes) == (10_000, 20)
    config = dqn_cartpole.Config()
    assert config.env_id == "CartPole-v0" and config.num_iterations == 20_000 and config.layers == (100, 50)
    assert (config.initial_collect_steps, config.collect_steps_per_iteration, config.batch_size) == (100, 1, 64)
    assert config.replay_buffer_capacity == 100_000 and config.learning_rate == 1e-3
    assert config.epsilon == 0.1 and config.adam_epsilon == 1e-7
    assert (config.log_interval, config.eval_interval, config.num_eval_episodes) == (200, 1_000, 10)


def test_tutorial_sets_every_value_that_is_ours_to_theirs(script):
    """Other flags count beside it. The 2021 edition of DQN's kept the discount at a time limit."""
    lines = (ROOT / f"{script}.py").read_text().splitlines()
    ours = {line.split(":")[0].strip() for line in lines if re.search(r"^    \w+: .* # ours\b", line)}
    module, theirs = MODULES[script], TUTORIALS[script]
    assert theirs.keys() == module.TUTORIAL.keys() == ours
    assert all(getattr(module.Config(), name) != value for name, value in theirs.items())
    assert read_command_line(script, "--tutorial") == (module.Config(**theirs), None, None)
    given = read_command_line(script, "--gamma", 0.9, "--tutorial", "--no-time-limit-terminates")
    assert given[0] == module.Config(**theirs | {"gamma": 0.9, "time_limit_terminates": False})
    assert read_command_line(script, "--tutorial", "--no-tutorial")[0] == module.Config()


def test_flags_are_judged_beside_the_values_that_count(tmp_path):
    """Not beside the defaults: γ = 1 goes with no value unit."""
    assert read_command_line("dqn_cartpole", "--tutorial", "--gamma", 1)[0].gamma == 1
    with pytest.raises(ValidationError, match="--gamma 1 makes an endless episode's value infinite"):
        dqn_cartpole.Config(gamma=1)


OUT_OF_RANGE = {
    "sac_minitaur": """
        --batch-size 0, --num-iterations -5, --initial-collect-steps 0, --collect-steps-per-iteration 0, --num-envs 0,
        --num-envs 1025, --replay-buffer-capacity -1, --max-episode-steps 0, --num-threads 0, --log-interval 0,
        --eval-interval -1, --num-eval-episodes 0, --checkpoint-interval 0, --critic-layers 0, --actor-layers 100000,
        --device tpu, --device cuda:128, --env-id a:b:c, --env-id .x:y-v0, --env-id :y-v0, --actor-learning-rate -1, --critic-learning-rate nan, --adam-epsilon -1,
        --adam-beta1 1, --gamma 1.01, --target-update-tau -0.1, --averaged-actor-tau 7, --reward-scale-factor inf,
        --initial-log-alpha nan, --seed -1, --seed 9223372036854775808, --batch-size x, --wings 2""",
    "dqn_cartpole": """
        --num-iterations 0, --layers -4, --learning-rate nan, --learning-rate-decay 0, --epsilon 3, --gamma 1,
        --target-update-tau 5, --advantage-learning 1, --num-envs 2, --resume x --evaluate y""",
}


@pytest.mark.parametrize("script, arguments", [(s, a) for s in SCRIPTS for a in OUT_OF_RANGE[s].split(",")])
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
        ("--batch-size 300", "--batch-size 300 is more than the transitions stored at first"),
        ("--replay-buffer-capacity 9000000000000000", "--replay-buffer-capacity 9000000000000000 takes .* GB"),
        ("--replay-buffer-capacity 20", "--batch-size 32 is more than"),
        ("--checkpoint-interval 199", "cuts each episode of 200 steps before its end: use a larger one"),
        ("--resume nowhere", "nowhere/checkpoint.pt does not exist"),
        ("--evaluate nowhere.pt", "nowhere.pt does not exist"),
        ("--evaluate full/file", "full/file is not a whole policy"),
        ("--run-dir full", "--run-dir full cannot be made .* name a new directory"),
        ("--run-dir full/file/below", "cannot be made"),
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
    with pytest.raises(SystemExit, match="2"):
        common.run_main(refuse)
    assert sys.stderr.getvalue() == "error: what is wrong\n"


def refuse():
    raise common.InputError("what is wrong")


class Spaces(gym.Env):
    def __init__(self, observation_space=None, action_space=None):
        self.observation_space = observation_space or gym.spaces.Box(-1, 1, (2,))
        self.action_space = action_space or gym.spaces.Box(-1, 1, (1,))


@pytest.mark.parametrize(
    "script, kind, space, said",
    [
        ("sac_minitaur", "action", gym.spaces.Box(0, 200, (2,), np.uint8), "TransformAction"),
        ("sac_minitaur", "action", gym.spaces.Box(-1, np.inf, (2,)), "finite bounds|bounds"),
        ("sac_minitaur", "action", gym.spaces.Box(-1, 1, (2, 0)), "Box"),
        ("sac_minitaur", "action", gym.spaces.Box(np.float32([0, -1]), np.float32([0, 1])), "low < high"),
        ("sac_minitaur", "action", gym.spaces.Box(np.float32(-3e38), np.float32(3e38), (2,)), "bounds"),
        ("sac_minitaur", "action", gym.spaces.Box(1.0, 1.0 + 1e-12, (2,), np.float64), "low < high"),  # none in float32
        ("sac_minitaur", "action", gym.spaces.Box(-1, 1, ()), "Box"),
        ("sac_minitaur", "action", gym.spaces.Discrete(3), "dqn_cartpole.py"),
        ("dqn_cartpole", "action", gym.spaces.Box(-1, 1, (2,)), "sac_minitaur.py"),
        ("dqn_cartpole", "action", gym.spaces.Discrete(2, start=1), "Discrete from 0.*TransformAction"),
        ("dqn_cartpole", "action", gym.spaces.MultiDiscrete([2, 2]), "TransformAction"),
        ("sac_minitaur", "observation", gym.spaces.Box(-1, 1, ()), "Box of some dimension"),
        ("dqn_cartpole", "observation", gym.spaces.Discrete(3), "FlattenObservation"),
        ("dqn_cartpole", "observation", gym.spaces.Dict(a=gym.spaces.MultiBinary(3)), "FlattenObservation"),
    ],
)
@pytest.mark.filterwarnings("ignore::UserWarning:gymnasium")
def test_spaces_that_an_algorithm_cannot_use(script, kind, space, said, monkeypatch):
    spec = gym.envs.registration.EnvSpec("Task-v0", Spaces, kwargs={f"{kind}_space": space})
    monkeypatch.setitem(gym.registry, "Task-v0", spec)
    message = refused(script, "--env-id", "Task-v0")
    assert f"Task-v0 has the {kind} space" in message and re.search(said, message)


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
    "another version's": lambda path: change(path, config=torch.load(path)["config"] | {"wings": 2}),
    "a value out of range": lambda path: change(path, config=torch.load(path)["config"] | {"gamma": 2.0}),
    "missing": Path.unlink,
}


@pytest.fixture
def copy(reference, tmp_path):
    """A finished run, to be damaged."""
    return shutil.copytree(reference, tmp_path / "run")


@pytest.mark.parametrize("name", ["checkpoint.pt", "policy.pt"])
def test_damaged_or_foreign_file(script, copy, tmp_path, name):
    """The run itself stays as it is."""
    whole, created = (copy / name).read_bytes(), tmp_path / "created"
    hostile = {
        "a hostile value": lambda path: path.write_bytes(saved({"format": CreatesFile(created)})),
        "a hostile pickle": lambda path: path.write_bytes(pickle.dumps(CreatesFile(created))),
    }
    arguments = ["--resume", copy] if name == "checkpoint.pt" else ["--evaluate", copy / name]
    table = (copy / "train.csv").read_bytes()
    for what, damage in (DAMAGES | hostile).items():
        (copy / name).write_bytes(whole)
        damage(copy / name)
        assert str(copy / name) in refused(script, *arguments), what
        assert not created.exists(), what
    run = Process(script, arguments, tmp_path / "output")
    assert run.wait() == 2 and run.stderr.startswith("error: ") and run.stderr.count("\n") == 1
    assert (copy / "train.csv").read_bytes() == table


def test_a_changed_script(script, copy, tmp_path):
    """Its network is larger now, or it has one more optimizer or one of another kind."""
    state = torch.load(copy / "checkpoint.pt")
    larger = {name: torch.stack((value, value)) for name, value in state["agent"].items()}
    first, *others = state["optimizers"]
    grouped = first | {"param_groups": 2 * first["param_groups"]}
    for number, values in enumerate(({"agent": larger}, {"optimizers": others}, {"optimizers": [grouped, *others]})):
        torch.save(state | values, copy / "checkpoint.pt")
        run = Process(script, ["--resume", copy], tmp_path / f"output {number}")
        assert run.wait() == 2 and f"{copy} does not fit" in run.stderr and run.stderr.count("\n") == 1


def test_a_policy_is_evaluated_as_the_run_was(script, reference, tmp_path):
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
    run = Process(script, other_task, tmp_path / "other")
    assert run.wait() == 2 and "policy.pt does not fit MountainCar" in run.stderr and run.stderr.count("\n") == 1
    more = ["--num-eval-episodes", 1, "--seed", 9]
    run = finish(script, ["--evaluate", reference / "best_policy.pt", "--no-video", *more], tmp_path / "one")
    assert "+/- 0.000000, Average" in run.stdout


def test_commands_of_readme_and_docstrings_are_taken():
    text = "\n".join((ROOT / name).read_text() for name in ("README.md", "sac_minitaur.py", "dqn_cartpole.py"))
    commands = re.findall(r"(?:python|nproc-per-node \w+) (\w+)\.py((?: +-{1,2}[^`#\n]*)?)", text)
    assert len(commands) > 15
    for script, arguments in commands:
        arguments = re.sub(r"--(resume|evaluate) runs/\S+|--seed S|--help", "", arguments)
        read_command_line(script, *arguments.split())
