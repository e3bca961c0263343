"""Deep Q-learning teaches a cart to balance a pole.

    python dqn_cartpole.py                                    # less than a minute on two CPU cores, return 200
    python dqn_cartpole.py --env-id CartPole-v1 --num-iterations 50000
    python dqn_cartpole.py --resume runs/RUN                  # continues a run that was stopped or killed
    python dqn_cartpole.py --evaluate runs/RUN/policy.pt      # evaluates and films a saved policy
    python dqn_cartpole.py --tutorial                         # the tutorial's own choices, which are less stable
    torchrun --nproc-per-node 2 dqn_cartpole.py               # two processes, one agent

The Q-network estimates Q(s, a): the sum of the rewards after action a in state s, with the best actions from then on.
Each later reward counts γ times as much as the one before. Each update moves Q(s, a) towards a target,
r + γ max Q(s', ·): r is the reward, s' the next state, and the maximum is over all actions there. A slow copy of the
Q-network, the target network, computes that maximum, so that the target moves slowly. Advantage learning also lowers
the targets of the worse actions, so that the best one stands out. The policy takes the action of the largest Q. While
it collects data, some actions are random: so it explores.

It reimplements the TF-Agents tutorial "Train a Deep Q Network" (2021, 2023): Mnih et al. 2015, "Human-level control
through deep reinforcement learning" (https://doi.org/10.1038/nature14236). `Config` marks "ours", README says why.
"""

import copy
import math
import warnings
from functools import partial
from pathlib import Path

import gymnasium as gym
import numpy as np
import torch
from pydantic import NonNegativeFloat, PositiveInt, StrictBool, model_validator
from pydantic.dataclasses import dataclass
from torch import nn
from torch.nn import functional as F

import common

# gymnasium recommends v1, which has 500 steps. The tutorial uses v0, which has 200.
warnings.filterwarnings("ignore", ".*environment CartPole-v0 is out of date", DeprecationWarning)


@dataclass(frozen=True, config=common.CONFIG)
class Config:
    """Deep Q-learning on CartPole. Values are the tutorial's unless a line says "ours"."""

    env_id: str = "CartPole-v0"  # a gymnasium task with a Discrete action space
    max_episode_steps: PositiveInt | None = None  # time limit (default: the task's own, or 10 000 where it has none)
    num_iterations: PositiveInt = 20_000  # gradient updates
    initial_collect_steps: PositiveInt = 100  # random steps before the first update, over environments and processes
    collect_steps_per_iteration: PositiveInt = 1  # environment steps per update, over all environments and processes
    num_envs: common.Parallel = 1  # environments that each process steps at once
    replay_buffer_capacity: PositiveInt = 100_000  # transitions kept by each process
    batch_size: PositiveInt = 64  # transitions per update, over all processes

    learning_rate: NonNegativeFloat = 1e-3  # Adam's, at the start
    learning_rate_decay: PositiveInt | None = 3_000  # ours (theirs: None): rate × 1 / (1 + (updates / this)²)
    adam_epsilon: NonNegativeFloat = 1e-7  # Adam's ε (Keras' default)
    epsilon: common.Fraction = 0.1  # probability of a random action while collecting (TF-Agents' default)
    gamma: common.Fraction = 0.99  # ours (theirs: 1, TF-Agents' default): discount
    target_update_tau: common.Fraction = 0.05  # ours (theirs: 1): target ← target + τ (Q-network − target) per update
    value_unit: bool = True  # ours (theirs: no): Q = value of an endless episode + scale × output: `fit_scaling`
    advantage_learning: common.Below1 = 0.9  # ours (theirs: 0): lower targets by this × (max Q(s, ·) − Q(s, a))
    observation_scaling: bool = True  # ours (theirs: no): map observations from the task's bounds to [-1, 1]
    layers: common.Layers = (100, 50)  # hidden units of the Q-network
    tutorial: StrictBool = False  # set every value marked "ours" back to the tutorial's; other flags override it

    seed: common.Seed = 0  # source of all randomness
    device: common.Device = "auto"  # auto, cpu, cuda, cuda:N or mps
    num_threads: common.Parallel = 1  # CPU threads of the update; more gain nothing here
    run_dir: Path | None = None  # a new directory for the results (default: runs/dqn_cartpole-<time>-seed<seed>)
    resume: Path | None = None  # directory of a run to continue from its last checkpoint
    evaluate: Path | None = None  # a run's policy.pt to evaluate and film instead of training
    video: bool = True  # film the trained agent, a random one, and the progress between
    log_interval: PositiveInt = 200  # updates between rows of train.csv
    eval_interval: PositiveInt = 1_000  # updates between evaluations
    num_eval_episodes: PositiveInt = 10  # episodes per evaluation
    checkpoint_interval: PositiveInt = 5_000  # updates between checkpoints

    @model_validator(mode="before")
    @classmethod
    def _complete(cls, given):  # fills in what is not given
        return common.complete_config(given, cls, TUTORIAL, "dqn_cartpole")

    @model_validator(mode="after")
    def _finite_value(self):
        if self.value_unit and self.gamma == 1:
            raise ValueError("--gamma 1 makes an endless episode's value infinite: use less, or --no-value-unit")
        return self


TUTORIAL = dict(
    learning_rate_decay=None, gamma=1.0, target_update_tau=1.0, value_unit=False, advantage_learning=0.0,
    observation_scaling=False,
)  # fmt: skip


# In shapes: B batch, K environments, N transitions stored, O numbers of an observation, A number of actions


class ObservationScaling(nn.Module):
    """Maps flat observations (…, O) from the bounds of their space to [-1, 1]; what is not bounded stays as it is."""

    def __init__(self, space):
        super().__init__()
        low, high = (torch.from_numpy(np.float32(bound)).flatten() for bound in (space.low, space.high))
        half_range = (high - low) / 2
        bounded = half_range.isfinite() & (half_range > 0)
        self.register_buffer("center", torch.where(bounded, low + half_range, 0.0))
        self.register_buffer("half_range", torch.where(bounded, half_range, 1.0))

    def fit(self, observations, ranks):
        """Drops bounds that nobody reaches: scaled by them, all observations (N, O) would come near one number.

        If a bound is over 130 times wider than the data, all over 10 times are dropped. CartPole has no such bound.
        """
        low, high = observations.amin(0), observations.amax(0)
        ranks.average([low, high])  # in place, over the processes
        spread = (high - low) / 2  # the half range of the data
        factor = self.half_range / torch.where(spread > 0, spread, 1.0)  # of a constant one (a pixel): by 1
        beyond = (factor > 10) & (factor.amax() > 130)
        self.center.copy_(torch.where(beyond, low + spread, self.center))
        self.half_range.copy_(torch.where(beyond, spread.clamp(min=1), self.half_range))

    def forward(self, observation):
        return (observation - self.center) / self.half_range


class QNetwork(nn.Module):
    """One output for each action. Q is offset + scale × output: see `DQNAgent.q_values`.

    It starts as the tutorial's. ReLU layers: weights of variance 2 / inputs, from a normal distribution cut at two
    standard deviations, and zero biases. Last layer: weights from U(−0.03, 0.03), biases −0.2.
    """

    def __init__(self, observation_size, num_actions, hidden_layers):
        super().__init__()
        layers, sizes = [], (observation_size, *hidden_layers)
        for inputs, units in zip(sizes[:-1], hidden_layers):
            layers += [linear := nn.Linear(inputs, units), nn.ReLU(inplace=True)]
            std = math.sqrt(2 / inputs) / 0.87962566103423978  # 0.88: the std of a normal cut at ±2 (as in Keras)
            nn.init.trunc_normal_(linear.weight, 0, std, -2 * std, 2 * std)
            nn.init.zeros_(linear.bias)
        layers.append(linear := nn.Linear(sizes[-1], num_actions))
        nn.init.uniform_(linear.weight, -0.03, 0.03)
        nn.init.constant_(linear.bias, -0.2)
        self.net = nn.Sequential(*layers)

    def forward(self, observation):
        """(…, A) for scaled observations (…, O)."""
        return self.net(observation)


class Policy(nn.Module):
    """The greedy policy: what is evaluated, exported and filmed."""

    def __init__(self, config, observation_space, action_space):
        super().__init__()
        self.scaling = ObservationScaling(observation_space) if config.observation_scaling else nn.Identity()
        self.q_network = QNetwork(math.prod(observation_space.shape), int(action_space.n), config.layers)

    def forward(self, observation):
        """Actions (batch,) for raw observations (batch, …), flat or not."""
        return self.q_network(self.scaling(observation.flatten(1))).argmax(1)  # the largest output has the largest Q

    @torch.inference_mode()
    def act(self, observation):
        """The action for one raw observation, from numpy to numpy."""
        return self(torch.from_numpy(np.array(observation, np.float32))[None]).numpy()[0]


class ReplayBuffer:
    """The last `capacity` transitions, on the training device, in float32, each packed into one row of one tensor.

    A row is (observation, action, reward, terminated, next observation), so that sampling is one indexing operation.
    A time limit does not set `terminated`: there the target still counts the next state's value.
    """

    def __init__(self, capacity, observation_size, device):
        self.sizes = (observation_size, 1, 1, 1, observation_size)
        self.rows = common.empty_replay(capacity, sum(self.sizes), device)
        self.size = self.position = 0

    def add(self, observations, actions, rewards, terminated, next_observations):
        """Stores K transitions, numpy (K, O), (K,), (K,), (K,), (K, O). A full buffer drops its oldest."""
        columns = (observations, actions[:, None], rewards[:, None], terminated[:, None], next_observations)
        rows = torch.from_numpy(np.concatenate(columns, axis=1, dtype=np.float32))
        for row in rows:
            self.rows[self.position].copy_(row)
            self.position = (self.position + 1) % len(self.rows)
            self.size = min(self.size + 1, len(self.rows))

    def sample(self, batch_size):
        """A batch drawn uniformly with replacement: (B, O), (B,) of int64, (B,), (B,), (B, O)."""
        indices = torch.randint(self.size, (batch_size,), device=self.rows.device)
        observations, actions, rewards, terminated, next_observations = self.rows[indices].split(self.sizes, dim=1)
        return observations, actions.squeeze(1).long(), rewards.squeeze(1), terminated.squeeze(1), next_observations

    def observations_and_rewards(self):
        """All stored observations (N, O) and rewards (N,)."""
        observations, _, rewards, _, _ = self.rows[: self.size].split(self.sizes, dim=1)
        return observations, rewards.squeeze(1)


def td_targets(rewards, terminated, next_q, gamma):
    """r + γ (1 − terminated) max Q(s', ·): (B,), for next_q (B, A) and the rest (B,). Algorithm 1 of Mnih et al."""
    return rewards + gamma * (1 - terminated) * next_q.amax(1)


def gap_to_best(q, actions):
    """max Q(s, ·) − Q(s, a), how much worse a is than the best: (B,), for q (B, A), actions (B,). arXiv:1512.04860."""
    return q.amax(1) - q.gather(1, actions[:, None]).squeeze(1)


class DQNAgent(nn.Module):
    """The Q-network, its slow copy for steady targets, the optimizer, and the greedy policy that is evaluated.

    `ranks.average` takes means over the processes of torchrun. With one process it does nothing.
    """

    def __init__(self, config, observation_space, action_space, device, ranks):
        super().__init__()
        self.config, self.device, self.ranks = config, device, ranks
        self.num_actions = int(action_space.n)
        self.policy = Policy(config, observation_space, action_space)
        self.scaling, self.q_network = self.policy.scaling, self.policy.q_network
        self.target_network = copy.deepcopy(self.q_network).requires_grad_(False)
        self.register_buffer("value_offset", torch.tensor(0.0))  # Q = offset + scale × output
        self.register_buffer("value_scale", torch.tensor(1.0))  # with --value-unit `fit_scaling` sets these two
        self.to(device)
        adam = {"eps": config.adam_epsilon, "fused": True}  # fused: one operation for all parameters
        self.optimizer = torch.optim.Adam(self.q_network.parameters(), config.learning_rate, **adam)
        self.optimizers = [self.optimizer]  # for the checkpoint; add a scheduler here

    def random_actions(self, count):
        """Uniform actions (K,), numpy."""
        return torch.randint(self.num_actions, (count,)).numpy()

    def fit_scaling(self, observations, rewards):
        """Fits the scales to the observations (N, O) and rewards (N,), averaged over the processes.

        An output of 0 then means an endless episode, Q = mean reward / (1 − γ). The network learns what an end changes.
        """
        if self.config.observation_scaling:
            self.scaling.fit(observations, self.ranks)
        if self.config.value_unit:
            self.ranks.average([mean := rewards.mean(), mean_abs := rewards.abs().mean()])  # in place
            self.value_offset.copy_(mean / (1 - self.config.gamma))
            self.value_scale.copy_(torch.where(mean_abs > 0, mean_abs, 1.0) / (1 - self.config.gamma))

    @torch.no_grad()
    def act(self, observations):
        """Epsilon-greedy actions (K,) for flat observations (K, O), from numpy to numpy."""
        observations = torch.as_tensor(observations, dtype=torch.float32, device=self.device)
        greedy = self.policy(observations).cpu().numpy()
        exploring = (torch.rand(len(greedy)) < self.config.epsilon).numpy()
        return np.where(exploring, self.random_actions(len(greedy)), greedy)

    def q_values(self, network, observations):
        """Q(s, ·) by a network: (B, A), for scaled observations (B, O)."""
        return self.value_offset + self.value_scale * network(observations)

    def update(self, batch, step):
        """Update number `step`, from 0: a gradient step of the Q-network. The target network follows it.

        `batch` is what `ReplayBuffer.sample` returns. Returns the scalars to log, as tensors on the device: `.item()`
        here would make the CPU wait for the GPU.
        """
        config = self.config
        if config.learning_rate_decay:  # ours, set at every update: lr / (1 + (step / decay)²)
            self.optimizer.param_groups[0]["lr"] = config.learning_rate / (1 + (step / config.learning_rate_decay) ** 2)
        s, a, rewards, terminated, next_s = batch  # (B, O), (B,), (B,), (B,), (B, O)
        s, next_s = self.scaling(s), self.scaling(next_s)  # ours
        with torch.no_grad():
            next_q = self.q_values(self.target_network, next_s)  # Q̄(s', ·), the target network's: (B, A)
            y = td_targets(rewards, terminated, next_q, config.gamma)  # r + γ (1 − terminated) max Q̄(s', ·): (B,)
            if config.advantage_learning:  # ours: y − this × (max Q̄(s, ·) − Q̄(s, a)), so worse actions fall further
                y -= config.advantage_learning * gap_to_best(self.q_values(self.target_network, s), a)
        q = self.q_values(self.q_network, s).gather(1, a[:, None]).squeeze(1)  # Q(s, a): (B,)
        loss = F.mse_loss(q, y)  # mean (Q(s, a) − y)²
        self.optimizer.zero_grad()
        loss.backward()
        self.ranks.average(parameter.grad for parameter in self.q_network.parameters())  # over the processes
        self.optimizer.step()

        with torch.no_grad():  # the target network's weights: θ̄ ← θ̄ + τ (θ − θ̄)
            for target, parameter in zip(self.target_network.parameters(), self.q_network.parameters()):
                target.lerp_(parameter, config.target_update_tau)  # ours: τ below 1
        return {"loss": loss.detach(), "mean_q": q.detach().mean()}


def evaluate(policy, task, seed):
    """Return and length of one episode of `task`, a gymnasium spec. `policy` is greedy; None: random actions."""
    with gym.make(task) as env:
        env.action_space.seed(seed)
        observation, _ = env.reset(seed=seed)
        episode_return, length, done = 0.0, 0, False
        while not done:
            action = policy.act(observation) if policy else env.action_space.sample()
            observation, reward, terminated, truncated, _ = env.step(action)
            episode_return, length, done = episode_return + float(reward), length + 1, terminated or truncated
    return episode_return, length


def train(config):
    """Trains as `config` says and returns the run directory's path, after Ctrl-C, too.

    Raises InputError for an unusable config, RunError when the run fails, TaskError when the task does. Saved files
    stay. A resumed run equals an uninterrupted one: `common.SeededEpisodes` plays the running episodes again.
    """
    task, observation_space, action_space = common.find_task(config, gym.spaces.Discrete)
    with common.Run(config, "dqn_cartpole", task, evaluate) as run:
        # They reset themselves. They step in this process: a message to a worker takes longer than a step of CartPole.
        envs = common.Environments(partial(gym.make, task), run, in_workers=False)
        torch.manual_seed(config.seed)  # the same networks on every rank
        agent = DQNAgent(config, observation_space, action_space, run.device, run.ranks)
        buffer = ReplayBuffer(config.replay_buffer_capacity, envs.observations.shape[1], run.device)
        torch.manual_seed(common.derive_seed(config.seed, run.ranks.rank))  # own actions and batches on every rank
        step = run.start(agent, buffer, envs)  # the number of updates: 0, or the checkpoint's
        # Random actions first. After the last, fit the scales: in this loop, which a resumed run skips.
        while envs.steps < config.initial_collect_steps and not run.stop_requested(step):
            envs.step_async(agent.random_actions(config.num_envs))
            buffer.add(*envs.step_wait())
            if envs.steps >= config.initial_collect_steps:
                agent.fit_scaling(*buffer.observations_and_rewards())
        while step < config.num_iterations:
            if step % config.eval_interval == 0:
                run.evaluate(step, agent.policy)
            if run.stop_requested(step):
                break

            # The next update needs `due` steps in all. A turn of this loop steps all environments, updates, or both.
            due = config.initial_collect_steps + (step + 1) * config.collect_steps_per_iteration
            if envs.steps < due:
                envs.step_async(agent.act(envs.observations))
                buffer.add(*envs.step_wait())
            if envs.steps >= due:
                metrics = agent.update(buffer.sample(run.batch_size), step)  # this process's share of the batch
                step += 1
                run.log_training(step, metrics)  # a row every log_interval updates
            if step - run.saved_step >= config.checkpoint_interval:
                run.save(step)

        run.finish(step, observation_space)  # checkpoint, evaluation, curve, films
        return run.path


def main():
    config = common.read_command_line(Config, __doc__)
    if config.evaluate is None:
        train(config)
    else:
        task, *spaces = common.find_task(config, gym.spaces.Discrete)
        common.evaluate_policy(config, "dqn_cartpole", Policy(config, *spaces), task, evaluate)


if __name__ == "__main__":
    common.run_main(main)
