"""Soft Actor-Critic teaches the Minitaur, a simulated quadruped, to run.

    python sac_minitaur.py                                    # half an hour to an hour on two CPU cores, return 25 to 32
    python sac_minitaur.py --env-id Pendulum-v1 --num-iterations 10000 --initial-collect-steps 1000
    python sac_minitaur.py --resume runs/RUN                  # continues a run that was stopped or killed
    python sac_minitaur.py --evaluate runs/RUN/policy.pt2     # evaluates and films a saved policy
    torchrun --nproc-per-node 2 sac_minitaur.py               # two processes, one agent

It reimplements the TF-Agents tutorials "SAC minitaur" (2018, 2021, 2023): Haarnoja et al. 2018, "Soft Actor-Critic
Algorithms and Applications" (https://arxiv.org/abs/1812.05905). Every value of theirs is a default here but those
marked "ours" in `Config`, each for a reason that README gives.
"""

import copy
import math
from collections import deque
from dataclasses import dataclass
from functools import partial

import gymnasium as gym
import numpy as np
import torch
import tyro
from torch import nn
from torch.nn import functional as F

import common
from common import InputError


@dataclass(frozen=True)
class Config:
    """Soft Actor-Critic on the Minitaur. Values are the tutorials' unless a line says "ours"."""

    env_id: str = "MinitaurBulletEnv-v0"
    """a gymnasium task with a bounded Box action space"""
    num_iterations: int = 100_000
    """gradient updates"""
    initial_collect_steps: int = 10_000
    """environment steps with random actions before the first update, over all processes"""
    collect_steps_per_iteration: int = 1
    """environment steps per gradient update, over all environments and processes"""
    num_envs: int = 1
    """environments that each process steps at once, each in a worker process of its own"""
    replay_buffer_capacity: int = 1_000_000
    """transitions kept by each process (the 2018 tutorial's value; the later ones have 10 000)"""
    batch_size: int = 256
    """transitions per update, over all processes"""

    actor_learning_rate: float = 3e-4
    """Adam's, for the actor"""
    critic_learning_rate: float = 3e-4
    """Adam's, for the critics"""
    alpha_learning_rate: float = 3e-4
    """Adam's, for log α"""
    adam_epsilon: float = 1e-7
    """Adam's ε (Keras' default, which the tutorials leave unsaid)"""
    adam_beta1: float = 0.5
    """ours, and CrossQ's (theirs: 0.9): decay of Adam's mean gradient"""
    # States of very different value look alike in the robot's observation. The policy sees no more than the task gives.
    privileged_critics: bool = True
    """ours (theirs: no): critics see the velocity and height too, where the environment tells them (arXiv:1710.06542)"""
    # What is learned counts at the next update then. With target critics that takes a fifth of the run.
    critic_batch_norm: bool = True
    """ours (theirs: none): normalize the critics over the batch, without target critics (CrossQ, arXiv:1902.05605)"""
    target_update_tau: float = 0.005
    """step of the target critics, where there are any, towards the critics, after every update"""
    gamma: float = 0.99
    """discount"""
    # One step of 0.01 s changes the return so little that the critics' errors hide it.
    n_step: int = 3
    """ours (theirs: 1): environment steps whose rewards a target sums before it bootstraps"""
    # Values of a thousandth are lost in the noise of new critics.
    reward_scaling: bool = True
    """ours (theirs: none): divide the rewards by the spread of the initial random data's n-step returns, here 0.005"""
    reward_scale_factor: float = 0.5
    """ours (theirs: 1): factor of the rewards, after the division"""
    # Every step of Adam changes the actor a little everywhere, and that of one moment may fall. Its average acts wherever
    # no action is sampled.
    averaged_actor_tau: float = 0.005
    """ours (theirs: 1, the actor itself): step of the averaged actor towards the actor, after every update"""
    # So that the replay holds the states that the policy, as it is evaluated, leads to.
    mean_action_episodes: bool = True
    """ours (theirs: none): every second episode is collected as an evaluation is, with the averaged actor's mean action"""
    critic_loss_weight: float = 0.5
    """factor of each critic's mean squared error (TF-Agents' default, which the tutorials leave unsaid)"""
    target_entropy_per_action: float = -1.0
    """ours, and the paper's −|A| (TF-Agents' default, which the tutorials leave unsaid: −|A|/2, so −0.5)"""
    initial_log_alpha: float = -2.0
    """ours (TF-Agents' default, which the tutorials leave unsaid: 0)"""
    actor_layers: tuple[int, ...] = (256, 256)
    """hidden units of the actor"""
    critic_layers: tuple[int, ...] = (256, 256)
    """hidden units of each critic"""
    observation_scaling: bool = True
    """ours (theirs: none): standardize observations by mean and standard deviation of the initial random data"""

    seed: int = 0
    """source of all randomness"""
    device: str = "auto"
    """auto, cpu, cuda, cuda:N or mps"""
    num_threads: int = 1
    """CPU threads of the update; the physics and the evaluations want the other cores"""
    run_dir: str | None = None
    """a new directory for the results (default: runs/sac_minitaur-<time>-seed<seed>)"""
    resume: str | None = None
    """directory of a run to continue from its last checkpoint"""
    evaluate: str | None = None
    """an exported policy (.pt2) to evaluate and film instead of training"""
    video: bool = True
    """film the trained and the random agent at the end"""
    log_interval: int = 5_000
    """updates between rows of train.csv"""
    eval_interval: int = 10_000
    """updates between evaluations"""
    num_eval_episodes: int = 20
    """episodes per evaluation"""
    checkpoint_interval: int = 5_000
    """updates between checkpoints, the policy's export among them"""


# The environment


@dataclass(frozen=True)
class Dynamics:
    """What the Minitaur draws anew at every reset. Ranges: pybullet's minitaur_env_randomizer.py."""

    base_mass: float
    """kg, the model's × U(0.8, 1.2)"""
    leg_mass: float
    """kg, of each of the 16 leg links, the model's × U(0.8, 1.2)"""
    motor_mass: float
    """kg, of each of the 8 motors, the model's × U(0.8, 1.2)"""
    voltage: float
    """V, the battery's, U(14.8, 16.8)"""
    viscous_damping: float
    """N·m·s/rad, the motors', U(0, 0.01)"""
    foot_friction: float
    """lateral friction coefficient of the feet, U(0.8, 1.5)"""


class Simulator:
    """A simulation of its own in this process, with pybullet's functions as methods.

    It ends with its last reference. As `pybullet_utils.bullet_client.BulletClient`, which prints a line to the console
    for every simulation it opens.
    """

    def __init__(self):
        # Imported here so that other tasks train on machines without pybullet.
        import pybullet
        import pybullet_data

        self.pybullet = pybullet
        self.client = pybullet.connect(pybullet.DIRECT)
        self.setAdditionalSearchPath(pybullet_data.getDataPath())

    def __getattr__(self, name):
        value = getattr(self.pybullet, name)
        if callable(value):
            value = partial(value, physicsClientId=self.client)
        setattr(self, name, value)  # looked up once
        return value

    def __del__(self):
        if "client" in self.__dict__:  # not where pybullet is missing
            self.disconnect()


class MinitaurBulletEnv(gym.Env):
    """Ghost Robotics' Minitaur on a plane, equal to the last bit to pybullet's `MinitaurBulletEnv-v0` of the old gym.

    Action (8,): for each leg (front left, back left, front right, back right) first its swing, then for each leg its
    extension, in [-1, 1], held for 0.01 s. Use float32: the motor commands are computed in the action's precision.
    Observation (28,): 8 motor angles in rad, 8 motor velocities in rad/s, 8 observed torques in N·m, the base's
    orientation as a quaternion (x, y, z, w); the original's float64 values in the float32 of its observation space.
    Reward: metres forward in this step less 0.005 × 0.002 s × the mechanical power in W.
    Terminated when the robot has fallen. `reset(options={"dynamics": d})` uses a `Dynamics` instead of drawing one.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 100}

    SUBSTEPS, SUBSTEP_SECONDS, SOLVER_ITERATIONS = 5, 0.002, 60
    MOTORS = tuple(f"{leg}{side}" for leg in ("front_left", "back_left", "front_right", "back_right") for side in "LR")
    DIRECTION = np.array([-1.0, -1, -1, -1, 1, 1, 1, 1])
    BASE_LINK = -1
    LEG_LINKS = (2, 3, 5, 6, 8, 9, 11, 12, 15, 16, 18, 19, 21, 22, 24, 25)
    MOTOR_LINKS = (1, 4, 7, 10, 14, 17, 20, 23)
    FOOT_LINKS = (3, 6, 9, 12, 16, 19, 22, 25)
    KNEE_ANGLE = -2.1834
    KP, KD = 1.0, 0.02
    RESISTANCE, TORQUE_CONSTANT, NOMINAL_VOLTAGE = 0.186, 0.0954, 16.0
    MAX_NET_VOLTAGE, MAX_OBSERVED_TORQUE = 50.0, 5.7
    # Motor torque in N·m at currents of 0, 10, … 60 A: the iron saturates.
    CURRENTS = np.array([0.0, 10, 20, 30, 40, 50, 60])
    TORQUES = np.array([0, 1, 1.9, 2.45, 3.0, 3.25, 3.5])
    OVERHEAT_TORQUE, OVERHEAT_SUBSTEPS = 2.45, 500
    MIN_UPRIGHTNESS, MIN_HEIGHT = 0.85, 0.13

    def __init__(self, render_mode=None):
        self.render_mode = render_mode
        self.simulator = Simulator()
        max_velocity = self.NOMINAL_VOLTAGE / self.TORQUE_CONSTANT
        high = np.repeat([math.pi, max_velocity, self.MAX_OBSERVED_TORQUE, 1.0], [8, 8, 8, 4]) + 0.01
        self.observation_space = gym.spaces.Box(np.float32(-high), np.float32(high))
        self.privileged_space = gym.spaces.Box(-np.inf, np.inf, (7,), np.float32)
        self.action_space = gym.spaces.Box(-1, 1, (8,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self._build()
        self.dynamics = (options or {}).get("dynamics") or self._draw_dynamics()
        self._apply_dynamics()
        self.hot_substeps = np.zeros(8)
        self.motor_enabled = np.ones(8, bool)
        self.x = 0.0
        self._read_motors()
        for _ in range(100):
            self._substep(math.pi / 2)
        return self._observation(), {}

    def _build(self):
        """Loads plane and robot into an empty simulation, in the start pose, its legs closed to four-bar linkages."""
        simulator = self.simulator
        simulator.resetSimulation()
        simulator.setPhysicsEngineParameter(numSolverIterations=self.SOLVER_ITERATIONS)
        simulator.setTimeStep(self.SUBSTEP_SECONDS)
        simulator.loadURDF("plane.urdf")
        simulator.setGravity(0, 0, -10)
        self.robot = robot = simulator.loadURDF(
            "quadruped/minitaur.urdf", (0, 0, 0.2), flags=simulator.URDF_USE_SELF_COLLISION
        )
        joints = (simulator.getJointInfo(robot, i) for i in range(simulator.getNumJoints(robot)))
        joint = {info[1].decode(): info[0] for info in joints}
        self.motor_joints = [joint[f"motor_{motor}_joint"] for motor in self.MOTORS]
        knee_joints = [joint[f"knee_{motor}_link"] for motor in self.MOTORS]
        for motor, knee, direction in zip(self.motor_joints, knee_joints, self.DIRECTION):
            simulator.resetJointState(robot, motor, direction * math.pi / 2)
            simulator.resetJointState(robot, knee, direction * self.KNEE_ANGLE)
            for free in (motor, knee):  # pybullet's own velocity motor brakes every joint until it is given no force
                simulator.setJointMotorControl2(robot, free, simulator.VELOCITY_CONTROL, force=0)
        for left, right in zip(knee_joints[::2], knee_joints[1::2]):
            simulator.createConstraint(
                robot, right, robot, left, simulator.JOINT_POINT2POINT, (0, 0, 0), (0, 0.005, 0.2), (0, 0.01, 0.2)
            )

    def _draw_dynamics(self):
        uniform = self.np_random.uniform
        links = (self.BASE_LINK, self.LEG_LINKS[0], self.MOTOR_LINKS[0])
        masses = (self.simulator.getDynamicsInfo(self.robot, link)[0] for link in links)
        return Dynamics(*(m * uniform(0.8, 1.2) for m in masses), uniform(14.8, 16.8), uniform(0, 0.01), uniform(0.8, 1.5))

    def _apply_dynamics(self):
        change, dynamics = self.simulator.changeDynamics, self.dynamics
        change(self.robot, self.BASE_LINK, mass=dynamics.base_mass)
        for link in self.LEG_LINKS:
            change(self.robot, link, mass=dynamics.leg_mass)
        for link in self.MOTOR_LINKS:
            change(self.robot, link, mass=dynamics.motor_mass)
        for link in self.FOOT_LINKS:
            change(self.robot, link, lateralFriction=dynamics.foot_friction)

    def step(self, action):
        """Raises ValueError when an action component is outside ±1.01, as the original does."""
        action = 1.0 * np.asarray(action)  # whole numbers would be computed in whole numbers
        if not (np.abs(action) <= 1.01).all():
            raise ValueError(f"action {action} is outside [-1, 1]")
        command = self._motor_angles(action)
        for _ in range(self.SUBSTEPS):
            self._substep(command)
        observation = self._observation()
        x, _, height = self.position
        energy = abs(np.dot(self.observed_torque, self.velocity)) * self.SUBSTEP_SECONDS
        reward = x - self.x - 0.005 * energy
        self.x = x
        up_z = self.simulator.getMatrixFromQuaternion(self.orientation)[8]
        fallen = up_z < self.MIN_UPRIGHTNESS or height < self.MIN_HEIGHT
        return observation, float(reward), fallen, False, {}

    @staticmethod
    def _motor_angles(action):
        """The angles in rad that the eight motors are to reach, from the leg model's swing and extension.

        In the action's own precision and in this order: with float32 actions the original computes in float32 too.
        """
        swing, extension = np.repeat(action[:4], 2), np.repeat(action[4:], 2)
        quarter = np.array([1, -1, 1, -1, -1, 1, -1, 1], action.dtype) * action.dtype.type(math.pi / 4)
        return math.pi + -math.pi / 4 * (extension + 1.5) + quarter * swing

    def _substep(self, command):
        """Drives the motors towards the angles `command` for 0.002 s (pybullet's motor.py, in its order of operations)."""
        simulator, dynamics = self.simulator, self.dynamics
        pwm = (-self.KP * (self.angle - command) - self.KD * self.velocity).clip(-1, 1)
        drive = pwm * dynamics.voltage
        self.observed_torque = (self.TORQUE_CONSTANT * (drive / self.RESISTANCE)).clip(
            -self.MAX_OBSERVED_TORQUE, self.MAX_OBSERVED_TORQUE
        )
        back_emf = (self.TORQUE_CONSTANT + dynamics.viscous_damping) * self.velocity
        current = (drive - back_emf).clip(-self.MAX_NET_VOLTAGE, self.MAX_NET_VOLTAGE) / self.RESISTANCE
        torque = np.interp(np.abs(current), self.CURRENTS, self.TORQUES)
        self.hot_substeps = (self.hot_substeps + 1) * (torque > self.OVERHEAT_TORQUE)
        self.motor_enabled &= self.hot_substeps <= self.OVERHEAT_SUBSTEPS
        force = np.sign(current) * torque * self.DIRECTION * self.motor_enabled
        simulator.setJointMotorControlArray(
            self.robot, self.motor_joints, simulator.TORQUE_CONTROL, forces=force.tolist()
        )
        simulator.stepSimulation()
        self._read_motors()

    def _read_motors(self):
        states = self.simulator.getJointStates(self.robot, self.motor_joints)
        self.angle = np.array([state[0] for state in states]) * self.DIRECTION
        self.velocity = np.array([state[1] for state in states]) * self.DIRECTION

    def _observation(self):
        self.position, self.orientation = self.simulator.getBasePositionAndOrientation(self.robot)
        return np.concatenate(
            (self.angle, self.velocity, self.observed_torque, self.orientation), dtype=np.float32, casting="same_kind"
        )

    def privileged_observation(self):
        """What the observation lacks, (7,) float32: the base's velocity in m/s and angular velocity in rad/s, both in
        its own frame (forwards, to its left, up), and its height in m."""
        velocity, angular_velocity = self.simulator.getBaseVelocity(self.robot)
        rotation = np.reshape(self.simulator.getMatrixFromQuaternion(self.orientation), (3, 3))
        return np.concatenate((velocity @ rotation, angular_velocity @ rotation, self.position[2:]), dtype=np.float32)

    def render(self):
        """The robot from the side that it runs past, (360, 480, 3) uint8, from pybullet's software renderer."""
        simulator = self.simulator
        position, _ = simulator.getBasePositionAndOrientation(self.robot)
        view = simulator.computeViewMatrixFromYawPitchRoll(position, distance=1, yaw=0, pitch=-30, roll=0, upAxisIndex=2)
        projection = simulator.computeProjectionMatrixFOV(fov=60, aspect=480 / 360, nearVal=0.1, farVal=100)
        pixels = simulator.getCameraImage(480, 360, view, projection, renderer=simulator.ER_TINY_RENDERER)[2]
        return np.asarray(pixels, np.uint8).reshape(360, 480, 4)[..., :3]

    def close(self):
        self.simulator = None  # ended just once: pybullet gives its number to the next one


if "MinitaurBulletEnv-v0" not in gym.registry:
    gym.register(
        id="MinitaurBulletEnv-v0", entry_point=MinitaurBulletEnv, max_episode_steps=1000, reward_threshold=15.0
    )


def make_env(env_id, **kwargs):
    """The task as registered. Raises InputError when it is unknown or its spaces are not what SAC needs."""
    try:
        env = gym.make(env_id, **kwargs)
    except (gym.error.Error, ImportError) as error:
        raise InputError(f"--env-id {env_id} cannot be made: {common.first_line(error)}") from None
    observations, actions = env.observation_space, env.action_space
    if not isinstance(observations, gym.spaces.Box) or not observations.shape:
        raise InputError(f"--env-id {env_id} has the observation space {observations}: a Box of some dimension is needed")
    if not (isinstance(actions, gym.spaces.Box) and actions.shape and actions.dtype.kind == "f" and actions.is_bounded()):
        raise InputError(f"--env-id {env_id} has the action space {actions}: SAC needs a bounded Box of real numbers")
    if not (actions.low < actions.high).all():
        raise InputError(f"--env-id {env_id} has the action space {actions}: SAC needs room between its bounds")
    return env


class AppendPrivileged(gym.ObservationWrapper):
    """Ends every observation (O,) with the environment's `privileged_observation()` (P,), which only critics see."""

    def __init__(self, env):
        super().__init__(env)
        own, privileged = env.observation_space, env.unwrapped.privileged_space
        self.observation_space = gym.spaces.Box(np.append(own.low, privileged.low), np.append(own.high, privileged.high))

    def observation(self, observation):
        return np.append(observation, self.unwrapped.privileged_observation())


def make_training_env(env_id, privileged):
    """The task with flat observations and actions in [-1, 1], as the agent sees it in training.

    With `privileged` the observations end with what only the critics see, where the environment has that.
    """
    env = make_env(env_id)
    if (env.action_space.low != -1).any() or (env.action_space.high != 1).any():
        env = gym.wrappers.RescaleAction(env, np.float32(-1), np.float32(1))
    if len(env.observation_space.shape) != 1:
        env = gym.wrappers.FlattenObservation(env)
    return AppendPrivileged(env) if privileged and hasattr(env.unwrapped, "privileged_space") else env


# The networks


class BatchNorm(nn.BatchNorm1d):
    """Normalizes features (B, F) by mean and variance of the batch, all ranks' together; in `eval` mode by running ones.

    Momentum and ε are CrossQ's.
    """

    def __init__(self, features, ranks):
        super().__init__(features, momentum=0.01, eps=1e-3)
        self.ranks = ranks

    def forward(self, x):
        if self.ranks.world_size == 1 or not self.training:
            return super().forward(x)
        mean, mean_square = self.ranks.mean(torch.stack((x.mean(0), x.square().mean(0))))
        variance = mean_square - mean.square()
        with torch.no_grad():
            batch_size = len(x) * self.ranks.world_size
            self.running_mean.lerp_(mean, self.momentum)
            self.running_var.lerp_(variance * batch_size / (batch_size - 1), self.momentum)
            self.num_batches_tracked += 1
        return (x - mean) * (variance + self.eps).rsqrt() * self.weight + self.bias


def mlp(inputs, hidden_layers, outputs, normalization=None):
    """Linear layers with ReLU between, Glorot-uniform weights and zero biases (the tutorials' initialization).

    `normalization(features)`, if any, makes a layer for the input of each.
    """
    layers = []
    for units in (*hidden_layers, outputs):
        if normalization:
            layers.append(normalization(inputs))
        layers += [nn.Linear(inputs, units), nn.ReLU(inplace=True)]
        inputs = units
    layers.pop()  # nothing after the outputs
    for layer in layers:
        if isinstance(layer, nn.Linear):
            nn.init.xavier_uniform_(layer.weight)
            nn.init.zeros_(layer.bias)
    return nn.Sequential(*layers)


class ObservationScaling(nn.Module):
    """Standardizes observations (…, S) by a fixed mean and standard deviation, clipped to ±10; the identity until `fit`.

    A shorter one, without what only the critics see, is scaled by the first S' of these.
    """

    def __init__(self, observation_size):
        super().__init__()
        self.register_buffer("mean", torch.zeros(observation_size))
        self.register_buffer("std", torch.ones(observation_size))
        self.register_buffer("limit", torch.tensor(torch.inf))

    def fit(self, observations, ranks):
        """Takes mean and standard deviation from observations (N, S), over all ranks."""
        mean = ranks.mean(observations.mean(0))
        variance = ranks.mean((observations - mean).square().mean(0))
        self.mean.copy_(mean)
        # What hardly moves under random actions may move later: its deviation is not taken for less than 0.01.
        self.std.copy_(variance.sqrt().clamp(min=0.01))
        self.limit.fill_(10.0)

    def forward(self, observation):
        size = observation.shape[-1]
        return ((observation - self.mean[:size]) / self.std[:size]).clamp(-self.limit, self.limit)


class Actor(nn.Module):
    """A Gaussian over actions, squashed by tanh into (-1, 1). It sees the first O numbers of an observation."""

    def __init__(self, observation_size, action_size, hidden_layers):
        super().__init__()
        self.observation_size = observation_size
        self.net = mlp(observation_size, hidden_layers, 2 * action_size)

    def forward(self, observation):
        """Mean and log standard deviation before squashing, (…, A) each, for scaled observations (…, O or more)."""
        mean, log_std = self.net(observation[..., : self.observation_size]).chunk(2, dim=-1)
        return mean, log_std.clamp(-20, 2)

    def sample(self, observation):
        """Actions (…, A) and their log-probabilities (…), differentiable with respect to the network.

        With a = tanh(u), log π(a) = log N(u) − Σ log(1 − tanh²u) (arXiv:1812.05905, appendix C). The subtracted term
        equals 2 (log 2 − u − softplus(−2u)) exactly, and does not round to log 0 where tanh saturates.
        """
        mean, log_std = self(observation)
        noise = torch.randn_like(mean)
        u = mean + log_std.exp() * noise
        log_normal = -0.5 * noise.square() - log_std - 0.5 * math.log(2 * math.pi)
        log_determinant = 2 * (math.log(2) - u - F.softplus(-2 * u))
        return u.tanh(), (log_normal - log_determinant).sum(-1)


class TwinCritics(nn.Module):
    """Two estimates of Q(s, a), independent of each other but for their data."""

    def __init__(self, observation_size, action_size, hidden_layers, normalization=None):
        super().__init__()
        inputs = observation_size + action_size
        self.q1 = mlp(inputs, hidden_layers, 1, normalization)
        self.q2 = mlp(inputs, hidden_layers, 1, normalization)

    def forward(self, observation, action):
        """(2, …) for scaled observations (…, S) and actions (…, A)."""
        x = torch.cat((observation, action), dim=-1)
        return torch.stack((self.q1(x), self.q2(x))).squeeze(-1)


class Policy(nn.Module):
    """The deterministic policy, in the task's own units: what is evaluated, exported and filmed."""

    def __init__(self, scaling, actor, action_space):
        super().__init__()
        self.scaling, self.actor = scaling, actor
        low, high = torch.as_tensor(action_space.low), torch.as_tensor(action_space.high)
        self.register_buffer("center", (low + high) / 2)
        self.register_buffer("half_range", (high - low) / 2)

    def forward(self, observation):
        """Actions (batch, *action shape) for raw observations (batch, *observation shape)."""
        mean, _ = self.actor(self.scaling(observation.flatten(1)))
        return self.center + self.half_range * mean.tanh().unflatten(1, self.center.shape)


def make_policy(weights, observation_space, action_space):
    """The policy with exported weights (`common.load_weights`), which tell its layers' sizes too.

    Raises KeyError, ValueError or RuntimeError when they are of another task than one with these spaces.
    """
    *hidden_layers, outputs = (len(w) for name, w in weights.items() if name.startswith("actor") and w.dim() == 2)
    observation_size = math.prod(observation_space.shape)
    actor = Actor(observation_size, outputs // 2, hidden_layers)
    scaling = ObservationScaling(weights["scaling.mean"].numel())  # of what only the critics see as well
    policy = Policy(scaling, actor, action_space)
    policy.load_state_dict(weights)
    return policy


# The replay buffer


class ReplayBuffer:
    """The last `capacity` n-step transitions, on the training device, in float32, each one row of one tensor.

    A row holds an observation s₀, the action a₀ taken there, the return r₀ + γ r₁ + … of the n steps from there, the
    last observation s' and the discount of its value: γⁿ, or 0 where the episode has ended. An episode cut off by its
    time limit has not ended, and its last state has a value. Towards the end of an episode fewer than n steps are
    left: n is then their number. Sampling is a single gather.
    """

    def __init__(self, capacity, state_size, action_size, n_step, gamma, num_envs, device):
        self.sizes = (state_size, action_size, 1, 1, state_size)
        self.n_step, self.gamma = n_step, gamma
        self.rows = common.empty_replay(capacity, sum(self.sizes), device)
        self.size = self.position = 0
        # Each environment's last steps (observation, action, reward), whose n-step returns are not complete.
        self.incomplete = [deque() for _ in range(num_envs)]

    def add(self, observations, actions, rewards, terminated, truncated, next_observations):
        """Takes a step of each of K environments: (K, S), (K, …), (K,), (K,), (K,), (K, S), as numpy arrays.

        Stores the transitions that it completes, over the oldest when full.
        """
        for k, steps in enumerate(self.incomplete):
            steps.append((observations[k], actions[k].ravel(), rewards[k]))
            ended = terminated[k] or truncated[k]
            while len(steps) == self.n_step or (ended and steps):
                n_step_return = sum(self.gamma**i * reward for i, (_, _, reward) in enumerate(steps))
                discount = 0.0 if terminated[k] else self.gamma ** len(steps)
                observation, action, _ = steps.popleft()
                row = np.concatenate((observation, action, (n_step_return, discount), next_observations[k]))
                self.rows[self.position].copy_(torch.from_numpy(row))
                self.position = (self.position + 1) % len(self.rows)
                self.size = min(self.size + 1, len(self.rows))

    def sample(self, batch_size):
        """A batch drawn uniformly with replacement: (B, S), (B, A), (B,), (B,), (B, S)."""
        indices = torch.randint(self.size, (batch_size,), device=self.rows.device)
        observations, actions, returns, discounts, next_observations = self.rows[indices].split(self.sizes, dim=1)
        return observations, actions, returns.squeeze(1), discounts.squeeze(1), next_observations

    def observations_and_returns(self):
        """All that is stored of these: (size, S), (size,)."""
        observations, _, returns, _, _ = self.rows[: self.size].split(self.sizes, dim=1)
        return observations, returns.squeeze(1)

    def state(self):
        """A copy of the filled part and of the incomplete transitions, for a checkpoint."""
        incomplete = [[tuple(map(torch.as_tensor, step)) for step in steps] for steps in self.incomplete]
        return {"rows": self.rows[: self.size].to("cpu", copy=True), "position": self.position, "incomplete": incomplete}

    def load_state(self, state):
        self.size, self.position = len(state["rows"]), state["position"]
        self.rows[: self.size] = state["rows"].to(self.rows.device)
        for steps, saved in zip(self.incomplete, state["incomplete"]):
            steps.extend(tuple(value.numpy() for value in step) for step in saved)


# The agent


def td_targets(returns, discounts, next_q, next_log_probs, alpha):
    """R + discount × (min over the twins of Q(s', a') − α log π(a'|s')): (B,).

    next_q (2, B), the rest (B,). Equations 3 and 5 of arXiv:1812.05905, with the twins' minimum and, in place of one
    reward and γ (1 − terminated), n of them and the discount after them (the entropy of the steps between is left out).
    """
    return returns + discounts * (next_q.amin(0) - alpha * next_log_probs)


def critic_loss(q, targets, weight):
    """The sum over the twins of `weight` × mean squared error: q (2, B), targets (B,)."""
    return weight * (q - targets).square().mean(1).sum()


def actor_loss(log_probs, q, alpha):
    """The mean of α log π(a|s) − min over the twins of Q(s, a): log_probs (B,), q (2, B). Equation 7."""
    return (alpha * log_probs - q.amin(0)).mean()


def alpha_loss(log_alpha, log_probs, target_entropy):
    """−log α × (log π + target entropy), averaged: raises α while the entropy is below its target. log_probs (B,).

    TF-Agents' default: equation 18 of arXiv:1812.05905 has α in place of log α, with the same sign of the gradient.
    """
    return -(log_alpha * (log_probs.detach() + target_entropy)).mean()


class SACAgent:
    """Actor, twin critics with their targets, and the temperature α, with their optimizers.

    The actor sees the task's observation, O numbers. The critics see S = `state_size` numbers: first the task's, then
    what only they see (by default nothing more).
    """

    def __init__(self, config, observation_space, action_space, device, ranks, state_size=None):
        self.config, self.device, self.ranks = config, device, ranks
        self.action_shape = action_space.shape
        observation_size = math.prod(observation_space.shape)
        self.state_size = state_size = state_size or observation_size
        self.action_size = action_size = math.prod(action_space.shape)
        self.target_entropy = config.target_entropy_per_action * action_size
        self.scaling = ObservationScaling(state_size).to(device)
        self.reward_scale = torch.tensor(float(config.reward_scale_factor), device=device)
        self.actor = Actor(observation_size, action_size, config.actor_layers).to(device)
        normalization = partial(BatchNorm, ranks=ranks) if config.critic_batch_norm else None
        self.critics = TwinCritics(state_size, action_size, config.critic_layers, normalization).to(device)
        # With batch normalization there are none (CrossQ).
        self.target_critics = None if config.critic_batch_norm else copy.deepcopy(self.critics).requires_grad_(False)
        self.log_alpha = torch.tensor(float(config.initial_log_alpha), device=device, requires_grad=True)
        self.averaged_actor = copy.deepcopy(self.actor).requires_grad_(False)
        self.policy = Policy(self.scaling, self.averaged_actor, action_space).to(device)

        self.actor_parameters, self.critic_parameters = list(self.actor.parameters()), list(self.critics.parameters())
        self.averaged_parameters = list(self.averaged_actor.parameters())
        self.target_parameters = list(self.target_critics.parameters()) if self.target_critics else []
        adam = {"betas": (config.adam_beta1, 0.999), "eps": config.adam_epsilon, "fused": device.type != "mps"}
        self.critic_optimizer = torch.optim.Adam(self.critic_parameters, config.critic_learning_rate, **adam)
        # One optimizer for the actor and α, which learn from the same sample of actions.
        groups = [
            {"params": self.actor_parameters, "lr": config.actor_learning_rate},
            {"params": [self.log_alpha], "lr": config.alpha_learning_rate},
        ]
        self.actor_optimizer = torch.optim.Adam(groups, **adam)

    def random_actions(self, count):
        """Uniform actions (K, *action shape) in [-1, 1], numpy."""
        return (2 * torch.rand(count, *self.action_shape) - 1).numpy()

    def fit_scaling(self, observations, returns):
        """Fixes the scales of observations and rewards by observations (N, S) and n-step returns (N,) of all ranks."""
        if self.config.observation_scaling:
            self.scaling.fit(observations, self.ranks)
        if self.config.reward_scaling:
            mean = self.ranks.mean(returns.mean())
            std = self.ranks.mean((returns - mean).square().mean()).sqrt()
            self.reward_scale /= torch.where(std > 1e-6, std, 1.0)  # rewards that were all equal stay as they are

    @torch.no_grad()
    def act(self, observations, sampled):
        """Actions (K, *action shape) in [-1, 1] for flat observations (K, S), numpy to numpy.

        They are drawn from the policy where `sampled` (K,) is true; elsewhere they are the averaged actor's mean.
        """
        observations = self.scaling(torch.as_tensor(observations, dtype=torch.float32, device=self.device))
        actions, _ = self.actor.sample(observations)
        mean, _ = self.averaged_actor(observations)
        actions = torch.where(torch.as_tensor(sampled, device=self.device)[:, None], actions, mean.tanh())
        return actions.view(-1, *self.action_shape).cpu().numpy()

    def update(self, batch):
        """One gradient step of the critics, then of the actor and α; the averages follow.

        `batch` is what `ReplayBuffer.sample` returns. Returns the scalars to log, as tensors on the device: reading a
        number back here would make a GPU wait at every step.
        """
        config = self.config
        observations, actions, returns, discounts, next_observations = batch
        observations, next_observations = self.scaling(observations), self.scaling(next_observations)
        returns = self.reward_scale * returns
        alpha = self.log_alpha.detach().exp()

        with torch.no_grad():
            next_actions, next_log_probs = self.actor.sample(next_observations)
        if self.target_critics:
            q = self.critics(observations, actions)
            next_q = self.target_critics(next_observations, next_actions)
        else:
            # Both in one pass: normalized apart, what the replay did and what the actor would do could not be compared.
            self.critics.train()
            both = torch.cat((observations, next_observations)), torch.cat((actions, next_actions))
            q, next_q = self.critics(*both).chunk(2, dim=1)
            self.critics.eval()
        with torch.no_grad():
            targets = td_targets(returns, discounts, next_q, next_log_probs, alpha)
        loss_q = critic_loss(q, targets, config.critic_loss_weight)
        self._step(self.critic_optimizer, loss_q, self.critic_parameters)

        new_actions, log_probs = self.actor.sample(observations)
        loss_pi = actor_loss(log_probs, self.critics(observations, new_actions), alpha)
        loss_alpha = alpha_loss(self.log_alpha, log_probs, self.target_entropy)
        self._step(self.actor_optimizer, loss_pi + loss_alpha, [*self.actor_parameters, self.log_alpha])

        with torch.no_grad():
            torch._foreach_lerp_(self.averaged_parameters, self.actor_parameters, config.averaged_actor_tau)
            if self.target_critics:
                torch._foreach_lerp_(self.target_parameters, self.critic_parameters, config.target_update_tau)
        return {
            "critic_loss": loss_q.detach(),
            "actor_loss": loss_pi.detach(),
            "alpha_loss": loss_alpha.detach(),
            "alpha": alpha,
            "entropy": -log_probs.detach().mean(),
            "mean_q": q.detach().mean(),
        }

    def _step(self, optimizer, loss, parameters):
        optimizer.zero_grad()
        loss.backward(inputs=parameters)  # the actor's loss passes through the critics and leaves them no gradient
        self.ranks.average_gradients(parameters)
        optimizer.step()

    def state(self):
        """Everything that an update depends on and changes, for a checkpoint."""
        state = {
            "scaling": self.scaling.state_dict(),
            "actor": self.actor.state_dict(),
            "averaged_actor": self.averaged_actor.state_dict(),
            "critics": self.critics.state_dict(),
            "log_alpha": self.log_alpha.detach(),
            "reward_scale": self.reward_scale,
            "critic_optimizer": self.critic_optimizer.state_dict(),
            "actor_optimizer": self.actor_optimizer.state_dict(),
        }
        return state | ({"target_critics": self.target_critics.state_dict()} if self.target_critics else {})

    def load_state(self, state):
        for name, saved in state.items():
            own = getattr(self, name)
            if isinstance(own, torch.Tensor):
                own.detach().copy_(saved)
            else:
                own.load_state_dict(saved)


# Evaluation


@torch.inference_mode()
def evaluate(policy, env_id, seed):
    """Return and length of one episode with the deterministic `policy`, or with random actions where it is None."""
    with make_env(env_id) as env:
        env.action_space.seed(seed)
        observation, _ = env.reset(seed=seed)
        episode_return, length, done = 0.0, 0, False
        while not done:
            action = act(policy, observation) if policy else env.action_space.sample()
            observation, reward, terminated, truncated, _ = env.step(action)
            episode_return, length, done = episode_return + float(reward), length + 1, terminated or truncated
    return episode_return, length


@torch.inference_mode()
def act(policy, observation):
    """The policy's action for one raw observation, numpy to numpy."""
    return policy(torch.as_tensor(observation, dtype=torch.float32)[None])[0].numpy()


def film(policy, env_id, seed, path):
    """Films one episode of the policy, or of random actions where it is None."""
    env = make_env(env_id, render_mode="rgb_array")
    env.action_space.seed(seed)
    common.record_video(path, env, lambda o: act(policy, o) if policy else env.action_space.sample(), seed)


# Training


def check(config):
    """Raises InputError for a value that no run could use."""
    common.require_range(
        config, 1, math.inf, "num_iterations", "initial_collect_steps", "collect_steps_per_iteration", "num_envs",
        "replay_buffer_capacity", "batch_size", "n_step", "actor_layers", "critic_layers", "log_interval",
        "eval_interval", "num_eval_episodes", "checkpoint_interval",
    )  # fmt: skip
    common.require_range(
        config, 0, math.inf, "actor_learning_rate", "critic_learning_rate", "alpha_learning_rate", "adam_epsilon",
        "reward_scale_factor", "critic_loss_weight",
    )  # fmt: skip
    common.require_range(config, 0, 1, "target_update_tau", "gamma", "averaged_actor_tau")
    common.require_range(config, 0, math.nextafter(1, 0), "adam_beta1")
    common.require_range(config, -math.inf, math.inf, "target_entropy_per_action", "initial_log_alpha")
    common.require_range(config, 0, 2**63 - 1, "seed")
    common.require_range(config, 1, 1024, "num_threads")
    # Every environment's last transitions are not complete yet.
    common.require_batch(config, held_back=config.num_envs * (config.n_step - 1))


def train(config):
    """Trains as `config` says and returns the run directory's path.

    Raises InputError for a config that cannot be run, RunError when the run fails; what it saved stays.

    A resumed run equals one that was never interrupted: a checkpoint is taken between two iterations and holds the
    agent, the replay, the random generators and the evaluations under way, and of the running episodes their seeds and
    actions, which bring the simulator back to the same state (`common.SeededEpisodes`).
    """
    check(config)
    with make_env(config.env_id) as env:
        observation_space, action_space, spec = env.observation_space, env.action_space, env.spec
    with common.Run(config, "sac_minitaur", evaluate) as run:
        ranks, saved = run.ranks, run.checkpoint
        episodes = common.Episodes(config.num_envs, config.seed, ranks.rank * config.num_envs, saved.get("episodes"))
        make_one = partial(make_training_env, config.env_id, config.privileged_critics)
        envs = run.enter(episodes.open_envs(make_one, in_workers=True))
        torch.manual_seed(config.seed)  # the same networks on every rank
        state_size = envs.single_observation_space.shape[0]
        agent = SACAgent(config, observation_space, action_space, run.device, ranks, state_size)
        buffer = ReplayBuffer(
            config.replay_buffer_capacity, agent.state_size, agent.action_size, config.n_step, config.gamma,
            config.num_envs, run.device,
        )  # fmt: skip
        policy_file = common.PolicyFile(agent.policy, observation_space.shape)
        torch.manual_seed(common.episode_seed(config.seed, ranks.rank))  # different actions and batches
        run.start(observation_space, action_space, buffer.rows.nbytes)

        step, env_steps = saved.get("step", 0), saved.get("env_steps", 0)
        if saved:
            agent.load_state(saved["agent"])
            buffer.load_state(saved.pop("buffer"))  # not kept beside it
            common.set_random_state(saved["random"])
            run.restart_evaluations(agent.policy, policy_file)
        else:
            run.start_evaluation(step, env_steps, policy=None)

        def save():
            if run.writes:
                policy_file.save(run.path / "policy.pt2", agent.policy)
            shared = {"step": step, "env_steps": env_steps, "agent": agent.state()}
            own = {"buffer": buffer.state(), "episodes": episodes.state(), "random": common.random_state()}
            run.save_checkpoint(shared, own)

        save()
        last_saved = step
        stopping = False
        steps_per_round = config.num_envs * ranks.world_size
        observations, _ = envs.reset()
        while step < config.num_iterations and not stopping:
            warming_up = env_steps < config.initial_collect_steps
            if warming_up:
                actions = agent.random_actions(config.num_envs)
            else:
                by_mean = config.mean_action_episodes & (np.array(episodes.number) % 2 == 1)  # every second episode
                actions = agent.act(observations, sampled=~by_mean)
            envs.step_async(actions)  # the physics runs beside the updates, which sample what was stored before
            env_steps += steps_per_round

            metrics = {}
            updates_due = (env_steps - config.initial_collect_steps) // config.collect_steps_per_iteration
            while not warming_up and step < min(updates_due, config.num_iterations):
                metrics = agent.update(buffer.sample(config.batch_size // ranks.world_size))
                step += 1
                run.progress.update()
                if step % config.log_interval == 0:
                    run.log_training(step, env_steps, episodes, metrics)
                if step % config.eval_interval == 0:
                    run.start_evaluation(step, env_steps, agent.policy)

            next_observations, rewards, terminated, truncated, infos = envs.step_wait()
            done = terminated | truncated
            last_observations = common.last_observations(next_observations, infos)
            buffer.add(observations, actions, rewards, terminated, truncated, last_observations)
            episodes.record(actions, rewards, done)
            observations = next_observations
            common.require_finite(step, metrics)

            if warming_up and env_steps >= config.initial_collect_steps:
                agent.fit_scaling(*buffer.observations_and_returns())
                run.start_evaluation(step, env_steps, agent.policy)
            if env_steps % 100 < steps_per_round:  # not at every step: between processes each look is a message
                run.report_evaluations(policy_file)
                stopping = run.stop_requested()
            if step - last_saved >= config.checkpoint_interval or step == config.num_iterations or stopping:
                save()
                last_saved = step

        if step % config.eval_interval and not stopping:
            run.start_evaluation(step, env_steps, agent.policy)
        run.finish(step, policy_file, agent.policy, film if config.video else None, spec.reward_threshold)
        return run.path


def main():
    config = tyro.cli(Config, description=__doc__)
    if config.resume is not None:
        config = tyro.cli(Config, default=common.resumed_config(config, "sac_minitaur"))
    if config.evaluate is not None:
        check(config)
        common.evaluate_policy_file(config, make_env, make_policy, evaluate, film)
    else:
        train(config)


if __name__ == "__main__":
    common.run_main(main)
