"""Deep Q-learning teaches a cart to balance a pole.

    python dqn_cartpole.py                                    # less than a minute on two CPU cores, return 200
    python dqn_cartpole.py --env-id CartPole-v1 --num-iterations 50000
    python dqn_cartpole.py --resume runs/RUN                  # continues a run that was stopped or killed
    python dqn_cartpole.py --evaluate runs/RUN/policy.pt      # evaluates and films a saved policy
    python dqn_cartpole.py --tutorial                         # the tutorial's own choices, which are less stable

The Q-network estimates Q(s, a): the sum of the rewards after action a in state s, with the best actions from then on.
A reward one step later counts γ times as much. Each update moves Q(s, a) towards a target:

    y = r + γ max Q̄(s', ·), or y = r where the task ended: the pole fell

Here r is the reward, s' is the next state, and the maximum is over all actions there. Q̄ is the target network, a slow
copy of the Q-network. Without it each update would move its own target, too, and Q could diverge. The greedy policy
takes the action of the largest Q. While it collects data, some actions are random: so it explores. A replay buffer
keeps the transitions (s, a, r, s', terminated). Each update learns from a few at random: neighbours are too similar.

This script reimplements the TF-Agents tutorial "Train a Deep Q Network" (editions of 2021 and 2023), after Mnih et al.
2015, "Human-level control through deep reinforcement learning" (https://doi.org/10.1038/nature14236). `Config` marks
what is "ours".
"""

import copy
import math
import warnings
from pathlib import Path

import gymnasium as gym
import numpy as np
import torch
from pydantic import NonNegativeFloat, PositiveInt
from pydantic.dataclasses import dataclass
from torch import nn
from torch.nn import functional as F

import common

# gymnasium recommends v1, which has 500 steps. The tutorial uses v0, which has 200.
warnings.filterwarnings("ignore", ".*environment CartPole-v0 is out of date", DeprecationWarning)


@dataclass(frozen=True, config=common.CONFIG)
class Config:
    """Deep Q-learning on CartPole. Values are the tutorial's unless a line says "ours"."""

    env_id: common.Task = "CartPole-v0"  # a gymnasium task with a Discrete action space
    max_episode_steps: PositiveInt | None = None  # time limit (default: the task's own, or 1 000 where it has none)
    num_iterations: PositiveInt = 20_000  # gradient updates
    initial_collect_steps: PositiveInt = 100  # random steps before the first update
    collect_steps_per_iteration: PositiveInt = 1  # environment steps for each update
    replay_buffer_capacity: PositiveInt = 100_000  # transitions kept
    batch_size: PositiveInt = 64  # transitions for each update

    learning_rate: NonNegativeFloat = 1e-3  # Adam's, at the start
    learning_rate_decay: PositiveInt | None = 3_000  # ours (theirs: None): after this many updates the rate is half
    adam_epsilon: NonNegativeFloat = 1e-7  # Adam's ε, Keras's value
    epsilon: common.Fraction = 0.1  # probability of a random action while collecting (TF-Agents' default)
    gamma: common.Fraction = 0.99  # ours (theirs: 1, TF-Agents' default): discount
    time_limit_terminates: bool = False  # ours (theirs: yes, in 2023): a time limit counts as an end of the task
    target_update_tau: common.Fraction = 0.05  # ours (theirs: 1, so no slow copy): Q̄ ← Q̄ + τ (Q − Q̄), in the weights
    value_unit: bool = True  # ours (theirs: no): learn Q in units of mean |r| / (1 − γ): see `fit_scaling`
    advantage_learning: common.Below1 = 0.9  # ours (theirs: 0): β, widens the gap to worse actions: see `update`
    observation_scaling: bool = True  # ours (theirs: no): bring observations near [-1, 1]: `common.ObservationScaling`
    layers: common.Layers = (100, 50)  # hidden units of the Q-network

    seed: common.Seed = 0  # source of the run's randomness
    device: common.Device = "auto"  # auto, cpu, cuda, cuda:N or mps
    num_threads: common.Count = 1  # CPU threads of the update; more gain nothing here
    run_dir: Path | None = None  # a new directory for the results (default: runs/dqn_cartpole-<time>-seed<seed>)
    video: bool = True  # film the trained agent, a random one, and the progress between
    log_interval: PositiveInt = 200  # updates between rows of train.csv
    eval_interval: PositiveInt = 1_000  # updates between evaluations
    num_eval_episodes: PositiveInt = 10  # episodes per evaluation
    checkpoint_interval: PositiveInt = 5_000  # updates between checkpoints. Each cuts the running episode: see `train`


TUTORIAL = {
    "learning_rate_decay": None,
    "gamma": 1.0,
    "time_limit_terminates": True,
    "target_update_tau": 1.0,
    "value_unit": False,
    "advantage_learning": 0.0,
    "observation_scaling": False,
}


# In shapes: B batch, N transitions stored, O numbers of an observation, A number of actions


class QNetwork(nn.Module):
    """One output for each action. Q is offset + scale × output: see `DQNAgent.fit_scaling`.

    The first weights are as the tutorial's. ReLU layers: weights of variance 2 / inputs, from a normal distribution cut
    at two standard deviations, and zero biases. Last layer: weights from U(−0.03, 0.03), biases −0.2.
    """

    def __init__(self, observation_size, num_actions, hidden_layers):
        super().__init__()
        layers = []
        inputs = observation_size
        for units in hidden_layers:
            linear = nn.Linear(inputs, units)
            std = math.sqrt(2 / inputs) / 0.87962566103423978  # 0.88: the std of a normal cut at ±2 (as in Keras)
            nn.init.trunc_normal_(linear.weight, 0, std, -2 * std, 2 * std)
            nn.init.zeros_(linear.bias)
            layers += [linear, nn.ReLU(inplace=True)]
            inputs = units
        last = nn.Linear(inputs, num_actions)
        nn.init.uniform_(last.weight, -0.03, 0.03)
        nn.init.constant_(last.bias, -0.2)
        self.net = nn.Sequential(*layers, last)

    def forward(self, observation):
        """(…, A) for scaled observations (…, O)."""
        return self.net(observation)


class Policy(nn.Module):
    """The greedy policy: what is evaluated, exported and filmed."""

    def __init__(self, config, observation_space, action_space):
        super().__init__()
        self.scaling = common.ObservationScaling(observation_space) if config.observation_scaling else nn.Identity()
        self.q_network = QNetwork(math.prod(observation_space.shape), int(action_space.n), config.layers)

    def forward(self, observation):
        """Actions (batch,) for raw observations (batch, …)."""
        output = self.q_network(self.scaling(observation.flatten(1)))
        return output.argmax(1)  # of the largest Q: it is offset + scale × output, with scale > 0

    @torch.inference_mode()
    def act(self, observation):
        """The action for one raw observation, from numpy to numpy. Only on the CPU."""
        batch = torch.from_numpy(np.array(observation, np.float32))[None]
        return self(batch).numpy()[0]


class ReplayBuffer:
    """The last `capacity` transitions, on the training device. Actions are numbered from 0, all else is float32.

    `terminated` is 1 where the task itself ended. After a time limit (`truncated`) it is 0: rewards would follow.
    """

    def __init__(self, capacity, observation_size, device):
        self.observations = torch.empty((capacity, observation_size), device=device)
        self.actions = torch.empty((capacity,), dtype=torch.int64, device=device)
        self.rewards = torch.empty((capacity,), device=device)
        self.terminated = torch.empty((capacity,), device=device)
        self.next_observations = torch.empty((capacity, observation_size), device=device)
        self.capacity = capacity
        self.size = 0
        self.position = 0

    def add(self, observation, action, reward, terminated, next_observation):
        """Stores one transition: numpy (O,), numbers, numpy (O,). A full buffer drops its oldest."""
        i = self.position
        self.observations[i] = torch.from_numpy(observation)
        self.actions[i] = action
        self.rewards[i] = float(reward)
        self.terminated[i] = float(terminated)
        self.next_observations[i] = torch.from_numpy(next_observation)
        self.position = (i + 1) % self.capacity
        self.size = min(self.size + 1, self.capacity)

    def sample(self, batch_size, generator):
        """A batch drawn uniformly with replacement: (B, O), (B,) of int64, (B,), (B,), (B, O)."""
        i = torch.randint(self.size, (batch_size,), generator=generator).to(self.rewards.device)
        return self.observations[i], self.actions[i], self.rewards[i], self.terminated[i], self.next_observations[i]


def td_targets(rewards, terminated, next_q, gamma):
    """The targets y = r + γ (1 − terminated) max Q̄(s', ·): (B,), for next_q (B, A), the rest (B,). TD is for temporal
    difference, between Q(s, a) and y. Algorithm 1 of Mnih et al."""
    return rewards + gamma * (1 - terminated) * next_q.amax(1)


def gap_to_best(q, actions):
    """max Q(s, ·) − Q(s, a), how much worse a is than the best: (B,), for q (B, A), actions (B,). arXiv:1512.04860."""
    return q.amax(1) - q.gather(1, actions[:, None]).squeeze(1)


class DQNAgent(nn.Module):
    """The Q-network, its slow copy for steady targets, the optimizer, and the greedy policy that is evaluated."""

    def __init__(self, config, observation_space, action_space, device):
        super().__init__()
        self.config = config
        self.device = device
        self.num_actions = int(action_space.n)
        self.generator = torch.Generator()  # for actions and batches: a task cannot disturb it
        self.generator.manual_seed(config.seed)
        self.policy = Policy(config, observation_space, action_space)
        self.scaling = self.policy.scaling  # the same module, not a copy. So is the network
        self.q_network = self.policy.q_network
        self.target_network = copy.deepcopy(self.q_network).requires_grad_(False)
        self.register_buffer("value_offset", torch.tensor(0.0))  # Q = offset + scale × output
        self.register_buffer("value_scale", torch.tensor(1.0))  # with --value-unit `fit_scaling` sets these two
        self.to(device)
        self.optimizer = torch.optim.Adam(
            self.q_network.parameters(), config.learning_rate, eps=config.adam_epsilon, fused=True
        )  # fused: one operation for all parameters
        self.optimizers = [self.optimizer]  # a checkpoint saves them

    def get_extra_state(self):
        """The generator's state. `state_dict` adds it to the weights: so a checkpoint has it."""
        return self.generator.get_state()

    def set_extra_state(self, state):
        """Restores the generator, when `load_state_dict` finds its state."""
        self.generator.set_state(state)

    def fit_scaling(self, observations, rewards):
        """Fits the scales to observations (N, O) and rewards (N,) of random actions.

        Q = (mean r + mean |r| × output) / (1 − γ), so the network learns numbers of size 1, not 100. Output 0 stands
        for an episode that never ends and earns the mean reward. CartPole's rewards are 1: with γ = 0.99, Q = 100 +
        100 × output, and output −1 stands for no more reward. If γ is 1, or all rewards were 0, Q is the output.
        """
        if self.config.observation_scaling:
            self.scaling.fit(observations)
        if self.config.value_unit and self.config.gamma < 1 and rewards.any():
            horizon = 1 / (1 - self.config.gamma)
            self.value_offset.copy_(rewards.mean() * horizon)
            self.value_scale.copy_(rewards.abs().mean() * horizon)

    def random_action(self):
        """A uniform action, from 0 to A − 1."""
        return int(torch.randint(self.num_actions, (), generator=self.generator))

    def act(self, observation):
        """The epsilon-greedy action for a flat numpy observation (O,)."""
        if torch.rand((), generator=self.generator) < self.config.epsilon:
            return self.random_action()
        batch = torch.as_tensor(observation, dtype=torch.float32, device=self.device)[None]
        with torch.inference_mode():
            return int(self.policy(batch))

    def q_values(self, network, observations):
        """Q(s, ·) by a network: (B, A), for scaled observations (B, O)."""
        return self.value_offset + self.value_scale * network(observations)

    def update(self, batch, step):
        """Update number `step`, from 0. Returns the scalars to log, as tensors on the device.

        Plain DQN: Q(s, a) takes a gradient step towards y = r + γ (1 − terminated) max Q̄(s', ·). Then the weights θ̄
        of the target network follow the Q-network's: θ̄ ← θ̄ + τ (θ − θ̄). What we add is in the lines marked "ours", and
        in `q_values`, for --value-unit.
        """
        config = self.config
        s, a, rewards, terminated, next_s = batch  # (B, O), (B,), (B,), (B,), (B, O)
        s = self.scaling(s)  # ours. Without --observation-scaling it changes nothing
        next_s = self.scaling(next_s)

        with torch.no_grad():
            next_q = self.q_values(self.target_network, next_s)  # Q̄(s', ·): (B, A)
            y = td_targets(rewards, terminated, next_q, config.gamma)  # (B,)
            if config.advantage_learning:  # ours: y ← y − β (max Q̄(s, ·) − Q̄(s, a)): a worse action looks clearly worse
                target_q = self.q_values(self.target_network, s)  # Q̄(s, ·): (B, A)
                y = y - config.advantage_learning * gap_to_best(target_q, a)  # (B,). The best action's gap is 0
        q = self.q_values(self.q_network, s).gather(1, a[:, None]).squeeze(1)  # Q(s, a): (B,)
        loss = F.mse_loss(q, y)

        if config.learning_rate_decay:  # ours: a half after `learning_rate_decay` updates, a fifth after twice as many
            rate = config.learning_rate / (1 + (step / config.learning_rate_decay) ** 2)
            self.optimizer.param_groups[0]["lr"] = rate
        self.optimizer.zero_grad()
        loss.backward()
        self.optimizer.step()

        with torch.no_grad():
            for target, parameter in zip(self.target_network.parameters(), self.q_network.parameters()):
                target.lerp_(parameter, config.target_update_tau)
        return {"loss": loss.detach(), "mean_q": q.detach().mean()}


def evaluate(policy, env, seed):
    """Return and length of one episode of a gymnasium environment. `policy` is greedy; None: random actions."""
    observation, _ = env.reset(seed=seed)
    env.action_space.seed(seed)  # after the reset: some tasks make their spaces there
    episode_return = 0.0
    length = 0
    done = False
    while not done:
        action = policy.act(observation) if policy else env.action_space.sample()
        observation, reward, terminated, truncated, _ = env.step(action)
        episode_return += float(reward)
        length += 1
        done = terminated or truncated
    return episode_return, length


def collect_step(env, observation, action, buffer, run):
    """Takes one step, stores the transition, tells `run`, a `common.Run`. Returns what to act on next: (O,)."""
    next_observation, reward, terminated, truncated, info = env.step(action)
    if run.config.time_limit_terminates:  # theirs
        terminated = terminated or truncated
    # The environment is reset only below, so next_observation is still this episode's own last observation.
    buffer.add(observation, action, reward, terminated, next_observation)
    run.env_steps += 1
    if terminated or truncated:
        run.log_episode(info["episode"]["r"], info["episode"]["l"])  # return, length: of RecordEpisodeStatistics
        next_observation, _ = env.reset()
    return next_observation


def train(config, resume=None):
    """Trains as `config` says and returns the run directory's path.

    `resume` is the directory of a run that continues: see `common.continued`. Raises InputError for what cannot be
    used, and KeyboardInterrupt after Ctrl-C, once a checkpoint is saved.
    """
    config, checkpoint = common.continued(config, resume, "dqn_cartpole")
    with common.Run("dqn_cartpole", config, evaluate) as run:  # starts processes that will call `evaluate`
        task, observation_space, action_space = common.find_task(config, gym.spaces.Discrete)  # task: a gymnasium spec
        env = gym.wrappers.RecordEpisodeStatistics(gym.make(task))
        env = gym.wrappers.FlattenObservation(env)  # (O,), a copy: some tasks overwrite their own array
        torch.manual_seed(config.seed)
        agent = DQNAgent(config, observation_space, action_space, run.device)
        buffer = ReplayBuffer(config.replay_buffer_capacity, math.prod(observation_space.shape), run.device)
        start = run.begin(task, agent, buffer, checkpoint)  # restores a checkpoint. start: the updates done so far

        if run.env_steps < config.initial_collect_steps:  # most resumed runs are past this
            observation, _ = env.reset(seed=common.derive_seed(config.seed))
            while run.env_steps < config.initial_collect_steps:
                run.stop_if_requested(start)
                observation = collect_step(env, observation, agent.random_action(), buffer, run)
            agent.fit_scaling(buffer.observations[: buffer.size], buffer.rewards[: buffer.size])

        for step in range(start, config.num_iterations):
            # gymnasium cannot save a task in mid-episode, so a resumed run begins a new episode at its checkpoint.
            # Every run does so at every checkpoint: then one that was killed and resumed equals one left alone. The cut
            # is no termination: the targets of the transitions before it keep Q̄(s', ·).
            if step == start or step % config.checkpoint_interval == 0:
                run.save(step)
                observation, _ = env.reset(seed=common.derive_seed(config.seed, step))
            if step % config.eval_interval == 0:
                run.evaluate(step, agent.policy)
            run.stop_if_requested(step)

            for _ in range(config.collect_steps_per_iteration):
                observation = collect_step(env, observation, agent.act(observation), buffer, run)
            batch = buffer.sample(config.batch_size, agent.generator)
            metrics = agent.update(batch, step)
            run.log(step + 1, metrics)  # a row every log_interval updates

        env.close()
        run.finish(config.num_iterations, observation_space.shape)  # checkpoint, evaluation, curve, films
        return run.path


def main():
    config, resume, policy_file = common.read_command_line("dqn_cartpole", Config, TUTORIAL, __doc__)
    if policy_file is None:
        train(config, resume)
    else:
        common.evaluate_file(policy_file, "dqn_cartpole", config, Policy, gym.spaces.Discrete, evaluate)


if __name__ == "__main__":
    common.run_main(main)
