"""The Minitaur against pybullet's own class, bit for bit, and against what gymnasium expects."""

import contextlib
import dataclasses
import importlib
import importlib.util
import math
import sys
import types
from pathlib import Path
from unittest import mock

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import sac_minitaur
from runs import run_python

ENV_ID = "MinitaurBulletEnv-v0"
pytest.importorskip("pybullet")


def trot(step, frequency=2.0, swing=0.5, extension=0.3):
    """Diagonal legs in phase, without looking at the robot: it walks slowly and stays up for a whole episode."""
    phase = 2 * math.pi * frequency * step * 0.01 + np.array([0, math.pi, math.pi, 0])
    return np.concatenate((swing * np.sin(phase), extension * np.cos(phase)))


def crouch(step):
    """One extreme command for ever: the robot falls, and after more than a second of stalling a motor overheats."""
    return -np.ones(8)


def random_actions(seed, hold=1):
    """Each held for `hold` steps: for 10, the robot falls soon; for 1 it trembles and stands."""
    actions = np.random.default_rng(seed).uniform(-1, 1, (1000, 8))
    return lambda step: actions[step // hold]


@contextlib.contextmanager
def old_gym():
    """Stands in for the retired packages that pybullet_envs imports, and takes all it imported out again."""
    old = mock.Mock(__version__="0.21.0", Env=object)
    old.spaces.Box = lambda low, high, dtype: gym.spaces.Box(low.astype(dtype), high.astype(dtype))
    old.utils.seeding.np_random = lambda seed=None: (np.random.default_rng(seed), seed)
    stubs = {"gym": old, "gym.spaces": old.spaces, "gym.utils": old.utils, "gym.utils.seeding": old.utils.seeding}
    stubs["pkg_resources"] = mock.Mock(parse_version=lambda version: tuple(map(int, version.split("."))))
    # The packages' own __init__ would register every environment with the old gym.
    folder = Path(importlib.util.find_spec("pybullet_envs").submodule_search_locations[0])
    for name, path in (("pybullet_envs", folder), ("pybullet_envs.bullet", folder / "bullet")):
        stubs[name] = types.ModuleType(name)
        stubs[name].__path__ = [str(path)]
    with mock.patch.dict(sys.modules, stubs), mock.patch.object(sys, "path", sys.path.copy()):
        yield


class Pair:
    """Our environment and the original, the original's randomization fed with what ours drew."""

    def __init__(self):
        with old_gym():
            module = importlib.import_module("pybullet_envs.bullet.minitaur_gym_env")
            self.original = module.MinitaurBulletEnv()
        self.original.set_env_randomizer(self)
        self.env = gym.make(ENV_ID)

    def randomize_env(self, original):
        dynamics, minitaur = self.env.unwrapped.dynamics, original.minitaur
        minitaur.SetBaseMass(dynamics.base_mass)
        minitaur.SetLegMasses([dynamics.leg_mass, dynamics.motor_mass])
        minitaur.SetBatteryVoltage(dynamics.voltage)
        minitaur.SetMotorViscousDamping(dynamics.viscous_damping)
        minitaur.SetFootFriction(dynamics.foot_friction)

    def play(self, seed, act, dtype, num_steps=None):
        """Steps both and compares: to the end of the episode, or for `num_steps` whatever happens.

        Returns the number of steps, and those at which the robot was down and a motor was switched off.
        """
        observation, _ = self.env.reset(seed=seed)
        assert_same_observation(observation, self.original.reset())
        fallen, overheated = [], []
        for step in range(num_steps or 1000):
            action = act(step).astype(dtype)
            observation, reward, terminated, truncated, _ = self.env.step(action)
            expected, expected_reward, expected_done, _ = self.original.step(action)
            assert_same_observation(observation, expected)
            assert reward == expected_reward and terminated == expected_done, step
            assert truncated == (step + 1 >= 1000)
            motors = self.original.minitaur._motor_enabled_list
            assert self.env.unwrapped.motor_enabled.tolist() == motors
            if terminated:
                fallen.append(step)
            if not all(motors):
                overheated.append(step)
            if num_steps is None and (terminated or truncated):
                break
        return step + 1, fallen, overheated

    def close(self):
        self.env.close()
        self.original._pybullet_client.disconnect()


def assert_same_observation(observation, expected):
    assert observation.dtype == np.float32 and expected.dtype == np.float64
    assert (observation == expected.astype(np.float32)).all(), np.abs(observation - expected).max()


@pytest.fixture(scope="module")
def pair():
    pair = Pair()
    yield pair
    pair.close()


@pytest.fixture(scope="module")
def env():
    with gym.make(ENV_ID) as env:
        yield env


# numpy 1 computes the original's Python float × float32 scalar in float64.
numpy_2 = pytest.mark.skipif(np.__version__.startswith("1."), reason="the original's float32 arithmetic is numpy 2's")
float32 = pytest.param(np.float32, marks=numpy_2, id="float32")
float64 = pytest.param(np.float64, id="float64")


@pytest.mark.parametrize("dtype", [float32, float64])
@pytest.mark.parametrize("seed", [1, 2])
def test_equals_the_original_with_random_actions(pair, seed, dtype):
    pair.play(seed, random_actions(seed), dtype, num_steps=60)
    steps, fallen, _ = pair.play(seed, random_actions(seed, hold=10), dtype)
    assert fallen == [steps - 1] and steps < 500


@numpy_2
def test_equals_the_original_over_a_whole_walk(pair):
    steps, fallen, _ = pair.play(0, trot, np.float32)
    assert steps == 1000 and not fallen  # so the time limit ended it
    assert pair.env.unwrapped.x > 1  # and it was a walk


def test_equals_the_original_with_whole_numbers(pair):
    pair.env.reset(seed=0)
    pair.original.reset()
    for action in [[1, -1, 1, -1, 0, 0, 0, 0]] * 5:
        observation, *_ = pair.env.step(action)
        expected, *_ = pair.original.step(action)
        assert_same_observation(observation, expected)


def test_equals_the_original_when_motors_overheat(pair):
    _, _, overheated = pair.play(0, crouch, np.float64, num_steps=220)
    assert 100 < overheated[0] < 200  # the steps after the switch-off are compared too
    # The next reset switches the motors on again, in both.
    assert not pair.play(0, trot, np.float64, num_steps=20)[2]


@pytest.mark.parametrize("value", [1.02, -1.02, np.nan, np.inf])
def test_refuses_actions_out_of_bounds_as_the_original_does(pair, value):
    pair.env.reset(seed=0)
    action = np.zeros(8, np.float32)
    pair.env.step(action + np.float32(1.005))  # the original's tolerance
    action[5] = value
    for step in (pair.env.step, pair.original.step):
        with pytest.raises(ValueError):
            step(action)


def test_draws_dynamics_in_their_ranges(env):
    simulator = env.unwrapped.simulator
    env.unwrapped._build()
    base, leg, motor = (simulator.getDynamicsInfo(env.unwrapped.robot, link)[0] for link in (-1, 2, 1))
    ranges = dict(
        base_mass=(0.8 * base, 1.2 * base), leg_mass=(0.8 * leg, 1.2 * leg), motor_mass=(0.8 * motor, 1.2 * motor),
        voltage=(14.8, 16.8), viscous_damping=(0, 0.01), foot_friction=(0.8, 1.5),
    )  # fmt: skip
    draws = []
    for seed in range(25):
        env.reset(seed=seed)
        draws.append([getattr(env.unwrapped.dynamics, name) for name in ranges])
    least, most = np.min(draws, axis=0), np.max(draws, axis=0)
    low, high = np.transpose(list(ranges.values()))
    assert len(low) == len(dataclasses.fields(sac_minitaur.Dynamics))
    assert (low <= least).all() and (most <= high).all()
    assert (least < (low + high) / 2).all() and (most > (low + high) / 2).all()
    # SI units: a robot of some 5 kg.
    assert 1 < base < 10 and 0.01 < leg < 1 and 0.05 < motor < 1


def rollout(env, seed, num_steps=60, options=None):
    """The bits of everything that the first steps of an episode return."""
    act = random_actions(0)
    observation, _ = env.reset(seed=seed, options=options)
    bits = [observation.tobytes()]
    for step in range(num_steps):
        observation, reward, terminated, truncated, _ = env.step(act(step).astype(np.float32))
        bits += [observation.tobytes(), reward, terminated, truncated]
    return bits


def test_a_seed_fixes_the_episode(env):
    """In a used simulator, too."""
    env.reset(seed=1)
    for step in range(180):  # a robot on its back with a motor overheated
        env.step(crouch(step))
    used = rollout(env, seed=7)
    dynamics = env.unwrapped.dynamics
    with gym.make(ENV_ID) as fresh:
        assert rollout(fresh, seed=7) == used and fresh.unwrapped.dynamics == dynamics
    assert rollout(env, seed=8) != used
    # An unseeded reset goes on drawing from the same generator.
    env.reset()
    assert env.unwrapped.dynamics not in (dynamics, None)


def test_dynamics_can_be_given(env):
    env.reset(seed=0)
    dynamics = env.unwrapped.dynamics
    with pytest.raises(dataclasses.FrozenInstanceError):
        dynamics.base_mass = 1.0
    drawn = rollout(env, seed=0)
    given = rollout(env, seed=1, options={"dynamics": dynamics})
    assert env.unwrapped.dynamics == dynamics and given == drawn  # the seed decides nothing else
    for field in dataclasses.fields(dynamics):
        changed = dataclasses.replace(dynamics, **{field.name: 0.9 * getattr(dynamics, field.name)})
        assert rollout(env, seed=0, num_steps=10, options={"dynamics": changed}) != drawn[: 1 + 4 * 10], field.name


def test_what_only_critics_see_is_all_that_training_adds(env):
    assert sac_minitaur.make_training_env(env.spec, False).observation_space == env.observation_space
    with contextlib.closing(sac_minitaur.make_training_env(env.spec, True)) as training_env:
        assert training_env.observation_space.shape == (28 + 7,)
        observation, _ = env.reset(seed=3)
        extended, _ = training_env.reset(seed=3)
        assert extended.dtype == np.float32 and extended[:28].tolist() == observation.tolist()
        for step in range(60):
            action = trot(step).astype(np.float32)
            observation, *rest, _ = env.step(action)
            extended, *other_rest, _ = training_env.step(action)
            assert other_rest == rest
            assert extended.dtype == np.float32 and extended[:28].tolist() == observation.tolist()
            assert extended in training_env.observation_space


def test_privileged_observation_is_in_the_bodys_own_frame(env):
    """With the robot turned to its left by 90 degrees, what moves along the world's y moves forwards."""
    env.reset(seed=3)
    minitaur = env.unwrapped
    simulator, robot = minitaur.simulator, minitaur.robot
    orientation = simulator.getQuaternionFromEuler((0, 0, math.pi / 2))
    simulator.resetBasePositionAndOrientation(robot, (1, 2, 5), orientation)
    minitaur._read_base()
    simulator.resetBaseVelocity(robot, (-2, 1, 3), (-5, 4, 6))
    privileged = minitaur.privileged_observation()
    assert privileged.dtype == np.float32
    np.testing.assert_allclose(privileged, [1, 2, 3, 4, 5, 6, 5], atol=1e-6)


def test_spaces_are_those_that_the_tutorials_print(env):
    high = np.repeat(np.float32(["3.1515927", "167.72488", "5.71", "1.01"]), [8, 8, 8, 4])
    space = env.observation_space
    assert space.dtype == np.float32 and (space.high == high).all() and (space.low == -high).all()
    space = env.action_space
    assert space.shape == (8,) and space.dtype == np.float32 and (space.high == 1).all() and (space.low == -1).all()
    assert env.spec.reward_threshold == 15.0 and env.spec.max_episode_steps == 1000


@pytest.mark.filterwarnings("error")
def test_passes_gymnasiums_check():
    check_env(gym.make(ENV_ID).unwrapped)


def test_any_program_can_make_it(tmp_path):
    """Another process gives the same bits. It may end while it holds the environment in a circle of references."""
    code = f"""
import gymnasium, types
env = gymnasium.make("sac_minitaur:{ENV_ID}")
observation, _ = env.reset(seed=7)
print(env.spec.max_episode_steps, observation.tobytes().hex(), env.unwrapped.dynamics.base_mass)
keep = types.SimpleNamespace(env=env)
keep.itself = keep
"""
    process = run_python(tmp_path, "-c", code)
    with gym.make(ENV_ID) as env:
        observation, _ = env.reset(seed=7)
        expected = f"1000 {observation.tobytes().hex()} {env.unwrapped.dynamics.base_mass}"
    assert process.stdout == f"{expected}\n"
    # Nothing else is on its console but for a line of pybullet's own: no "Exception ignored".
    assert [line for line in process.stderr.splitlines() if not line.startswith("pybullet build time")] == []


def test_other_tasks_need_no_pybullet(tmp_path):
    code = """
import sys
sys.modules.update(dict.fromkeys(("pybullet", "pybullet_data", "pybullet_utils")))  # an import of these raises
import gymnasium as gym
import dqn_cartpole
assert "sac_minitaur" not in sys.modules
import common, sac_minitaur
common.find_task(sac_minitaur.Config(env_id="Pendulum-v1"), gym.spaces.Box)
try:
    common.find_task(sac_minitaur.Config(), gym.spaces.Box)
except common.InputError as error:
    print(error)
"""
    process = run_python(tmp_path, "-c", code)
    assert process.stdout.startswith(f"--env-id {ENV_ID} cannot be made: ") and process.stdout.count("\n") == 1
    assert "pybullet" in process.stdout and "uv run --python 3.13" in process.stdout
