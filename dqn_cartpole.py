"""Deep Q-learning teaches a cart to balance a pole.

    python dqn_cartpole.py                                    # less than a minute on two CPU cores, return 200
    python dqn_cartpole.py --env-id CartPole-v1 --num-iterations 50000
    python dqn_cartpole.py --resume runs/RUN                  # continues a run that was stopped or killed
    python dqn_cartpole.py --evaluate runs/RUN/policy.pt2     # evaluates and films a saved policy
    torchrun --nproc-per-node 2 dqn_cartpole.py               # two processes, one agent

It reimplements the TF-Agents tutorial "Train a Deep Q Network" (2021, 2023): Mnih et al. 2015, "Human-level control
through deep reinforcement learning" (https://doi.org/10.1038/nature14236). Every value of theirs is a default here but
those marked "ours" in `Config`. The tutorial discounts by 1 and bootstraps from the network of the step before, so
that nothing bounds its values: its losses reach 1e10, and for one who trained on to 130 000 updates the return fell
back to 12 to 32 (https://github.com/tensorflow/agents/issues/316). Here the observations come on one scale; values are
discounted and start from what an endless episode is worth, so that only falling and leaving the track have to be
learned, and in a unit in which that is a short way; they are bounded by it; a target network follows slowly, and values
the action that the Q-network chooses (double DQN, which alone has no flag); the values of the two actions, nearly equal
after so short a step, are pushed apart; and the learning rate decays.
"""

import math
import warnings
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
    """Deep Q-learning on CartPole. Values are the tutorial's unless a line says "ours"."""

    env_id: str = "CartPole-v0"
    """a gymnasium task with a Discrete action space"""
    num_iterations: int = 20_000
    """gradient updates"""
    initial_collect_steps: int = 100
    """environment steps with random actions before the first update, over all processes"""
    collect_steps_per_iteration: int = 1
    """environment steps per gradient update, over all environments and processes"""
    num_envs: int = 1
    """environments that each process steps at once"""
    replay_buffer_capacity: int = 100_000
    """transitions kept by each process"""
    batch_size: int = 64
    """transitions per update, over all processes"""

    learning_rate: float = 1e-3
    """Adam's, at the start"""
    learning_rate_decay: int = 1_000
    """ours (theirs: none): after this many updates the learning rate is half, after n times as many 1 / (1 + n)"""
    adam_epsilon: float = 1e-7
    """Adam's ε (Keras' default, which the tutorial leaves unsaid)"""
    epsilon: float = 0.1
    """probability of a random action while collecting (TF-Agents' default, which the tutorial leaves unsaid)"""
    gamma: float = 0.99
    """ours (TF-Agents' default, which the tutorial leaves unsaid: 1)"""
    target_update_tau: float = 0.1
    """ours (theirs: 1): step of the target network towards the Q-network, after every update"""
    value_offset: bool = True
    """ours (theirs: none): Q is the network's output plus what the mean initial reward is worth for ever"""
    # Adam moves an output at the pace of its learning rate, whatever the output's unit: for values tens apart, a unit of
    # one reward is a long way.
    value_scale: float = 100.0
    """ours (theirs: 1): Q changes by this where the network's output changes by 1"""
    value_bound: bool = True
    """ours (theirs: none): targets do not exceed what the largest reward seen so far is worth, for ever or once"""
    # The other action comes 0.02 s later and undoes nearly all: without, their values differ by less than the network's
    # errors.
    advantage_learning: float = 0.9
    """ours (theirs: none): a target is lowered by this part of what its action lacks to the best one"""
    layers: tuple[int, ...] = (100, 50)
    """hidden units of the Q-network"""
    # The pole's angle ends at 0.2 and the cart's place at 2.4: unscaled, the network sees ten times as much of the place.
    observation_scaling: bool = True
    """ours (theirs: none): observations come within [-1, 1] where the task bounds them"""

    seed: int = 0
    """source of all randomness"""
    device: str = "auto"
    """auto, cpu, cuda, cuda:N or mps"""
    num_threads: int = 1
    """CPU threads of the update; networks this small gain nothing from more"""
    run_dir: str | None = None
    """a new directory for the results (default: runs/dqn_cartpole-<time>-seed<seed>)"""
    resume: str | None = None
    """directory of a run to continue from its last checkpoint"""
    evaluate: str | None = None
    """an exported policy (.pt2) to evaluate and film instead of training"""
    video: bool = True
    """film the trained and the random agent at the end"""
    log_interval: int = 200
    """updates between rows of train.csv"""
    eval_interval: int = 1_000
    """updates between evaluations"""
    num_eval_episodes: int = 10
    """episodes per evaluation"""
    checkpoint_interval: int = 5_000
    """updates between checkpoints, the policy's export among them"""


# The environment


def make_env(env_id, **kwargs):
    """The task as registered. Raises InputError when it is unknown or its spaces are not what DQN needs."""
    try:
        with warnings.catch_warnings():
            # The tutorial's task: that gymnasium has a v1, with 500 steps instead of 200, is no news here.
            warnings.filterwarnings("ignore", ".*environment CartPole-v0 is out of date", DeprecationWarning)
            env = gym.make(env_id, **kwargs)
    except (gym.error.Error, ImportError) as error:
        raise InputError(f"--env-id {env_id} cannot be made: {common.first_line(error)}") from None
    observations, actions = env.observation_space, env.action_space
    if not isinstance(observations, gym.spaces.Box) or not observations.shape:
        raise InputError(f"--env-id {env_id} has the observation space {observations}: a Box of some dimension is needed")
    if not isinstance(actions, gym.spaces.Discrete) or actions.start != 0:
        raise InputError(f"--env-id {env_id} has the action space {actions}: DQN needs a Discrete from 0")
    return env


def make_training_env(env_id):
    """The task with flat observations, as the agent sees it."""
    env = make_env(env_id)
    return env if len(env.observation_space.shape) == 1 else gym.wrappers.FlattenObservation(env)


# The network


class ObservationScaling(nn.Module):
    """Maps flat observations (…, O) from the bounds of their space to [-1, 1]; what is not bounded stays as it is."""

    def __init__(self, space):
        super().__init__()
        low, high = (torch.as_tensor(bound, dtype=torch.float32).flatten() for bound in (space.low, space.high))
        half_range = (high - low) / 2
        bounded = half_range.isfinite() & (half_range > 0)
        self.register_buffer("center", torch.where(bounded, low + half_range, 0.0))
        self.register_buffer("half_range", torch.where(bounded, half_range, 1.0))

    def forward(self, observation):
        return (observation - self.center) / self.half_range


class QNetwork(nn.Module):
    """Q(s, ·), the estimated return of every action.

    ReLU layers with weights from a normal distribution of variance 2 / inputs, truncated at two standard deviations,
    and zero biases; a last layer with weights from U(−0.03, 0.03) and biases −0.2 (the tutorial's initialization).
    """

    # A standard normal truncated at ±2 has this standard deviation; Keras divides by it, so that 2 / inputs is exact.
    TRUNCATED_STD = 0.87962566103423978

    def __init__(self, observation_size, num_actions, hidden_layers):
        super().__init__()
        layers, inputs = [], observation_size
        for units in hidden_layers:
            layers += [linear := nn.Linear(inputs, units), nn.ReLU(inplace=True)]
            std = math.sqrt(2 / inputs) / self.TRUNCATED_STD
            nn.init.trunc_normal_(linear.weight, 0, std, -2 * std, 2 * std)
            nn.init.zeros_(linear.bias)
            inputs = units
        layers.append(linear := nn.Linear(inputs, num_actions))
        nn.init.uniform_(linear.weight, -0.03, 0.03)
        nn.init.constant_(linear.bias, -0.2)
        self.net = nn.Sequential(*layers)

    def forward(self, observation):
        """(…, A) for scaled observations (…, O)."""
        return self.net(observation)


class Policy(nn.Module):
    """The greedy policy: what is evaluated, exported and filmed."""

    def __init__(self, scaling, q_network):
        super().__init__()
        self.scaling, self.q_network = scaling, q_network

    def forward(self, observation):
        """Actions (batch,) for raw observations (batch, *observation shape)."""
        return self.q_network(self.scaling(observation.flatten(1))).argmax(1)


def make_policy(weights, observation_space, action_space):
    """The policy with exported weights (`common.load_weights`), which tell its layers' sizes too.

    Raises ValueError or RuntimeError when they are of another task than one with these spaces.
    """
    *hidden_layers, _ = (len(w) for name, w in weights.items() if name.startswith("q_network") and w.dim() == 2)
    scaling = ObservationScaling(observation_space) if "scaling.center" in weights else nn.Identity()
    policy = Policy(scaling, QNetwork(math.prod(observation_space.shape), int(action_space.n), hidden_layers))
    policy.load_state_dict(weights)
    return policy


# The replay buffer


class ReplayBuffer:
    """The last `capacity` transitions, on the training device, in float32, each packed into one row of one tensor.

    One row (observation, action, reward, terminated, next observation) makes sampling a single gather. Only
    `terminated` is kept: an episode cut off by its time limit has not ended, and its last state has a value.
    """

    def __init__(self, capacity, observation_size, device):
        self.sizes = (observation_size, 1, 1, 1, observation_size)
        self.rows = common.empty_replay(capacity, sum(self.sizes), device)
        self.size = self.position = 0
        self.largest_reward = -math.inf

    def add(self, observations, actions, rewards, terminated, next_observations):
        """Stores K transitions: (K, O), (K,), (K,), (K,), (K, O), as numpy arrays. Overwrites the oldest when full."""
        columns = (observations, actions[:, None], rewards[:, None], terminated[:, None], next_observations)
        self.largest_reward = max(self.largest_reward, float(rewards.max()))
        rows = torch.from_numpy(np.concatenate(columns, axis=1, dtype=np.float32, casting="unsafe"))
        for row in rows:
            self.rows[self.position].copy_(row)
            self.position = (self.position + 1) % len(self.rows)
            self.size = min(self.size + 1, len(self.rows))

    def sample(self, batch_size):
        """A batch drawn uniformly with replacement: (B, O), (B,) of int64, (B,), (B,), (B, O)."""
        indices = torch.randint(self.size, (batch_size,), device=self.rows.device)
        observations, actions, rewards, terminated, next_observations = self.rows[indices].split(self.sizes, dim=1)
        return observations, actions.squeeze(1).long(), rewards.squeeze(1), terminated.squeeze(1), next_observations

    def rewards(self):
        """All that is stored of these: (size,)."""
        return self.rows[: self.size].split(self.sizes, dim=1)[2].squeeze(1)

    def state(self):
        """A copy of the filled part, for a checkpoint."""
        rows = self.rows[: self.size].to("cpu", copy=True)
        return {"rows": rows, "position": self.position, "largest_reward": self.largest_reward}

    def load_state(self, state):
        self.size, self.position = len(state["rows"]), state["position"]
        self.largest_reward = state["largest_reward"]
        self.rows[: self.size] = state["rows"].to(self.rows.device)


# The agent


def td_targets(rewards, terminated, next_q, next_actions, gamma, bound=math.inf):
    """r + γ (1 − terminated) Q_target(s', a'): (B,), with a' the Q-network's own choice (double DQN, arXiv:1509.06461).

    next_q (B, A) from the target network, the rest (B,). No target exceeds `bound`.
    """
    next_value = next_q.gather(1, next_actions[:, None]).squeeze(1)
    return (rewards + gamma * (1 - terminated) * next_value).clamp(max=bound)


def action_gap(q, actions):
    """max Q(s, ·) − Q(s, a): (B,), for q (B, A) and actions (B,).

    Advantage learning (Baird's; arXiv:1512.04860) takes a part of it off the target: the best action keeps its value,
    and the others' come to lie 1 / (1 − part) times as far below it.
    """
    return q.amax(1) - q.gather(1, actions[:, None]).squeeze(1)


def td_loss(q, targets):
    """The mean squared error: q (B,), targets (B,)."""
    return F.mse_loss(q, targets)


class DQNAgent:
    """The Q-network with its target and optimizer.

    The tutorial's network starts near Q = 0 and climbs to 1 / (1 − γ), a reward at a time, and meanwhile looks no
    further ahead than it has climbed: it balances the pole and does not see that the cart leaves the track. Here
    `value_offset`, the worth of an endless episode, is added to the network, which has to learn only what ends it.
    """

    def __init__(self, config, observation_space, action_space, device, ranks):
        self.config, self.device, self.ranks = config, device, ranks
        self.observation_size = math.prod(observation_space.shape)
        self.num_actions = int(action_space.n)
        network_arguments = (self.observation_size, self.num_actions, config.layers)
        self.q_network = QNetwork(*network_arguments).to(device)
        self.target_network = QNetwork(*network_arguments).to(device).requires_grad_(False)
        self.target_network.load_state_dict(self.q_network.state_dict())
        self.scaling = ObservationScaling(observation_space).to(device) if config.observation_scaling else nn.Identity()
        self.policy = Policy(self.scaling, self.q_network)
        self.value_offset = torch.tensor(0.0, device=device)

        self.parameters = list(self.q_network.parameters())
        self.target_parameters = list(self.target_network.parameters())
        adam = {"eps": config.adam_epsilon, "fused": device.type != "mps"}
        self.optimizer = torch.optim.Adam(self.parameters, config.learning_rate, **adam)
        # A policy that balances sees only states that are worth the same, and the noise of large steps upsets it again.
        decay = config.learning_rate_decay
        self.schedule = torch.optim.lr_scheduler.LambdaLR(self.optimizer, lambda updates: 1 / (1 + updates / decay))

    def random_actions(self, count):
        """Uniform actions (K,), numpy."""
        return torch.randint(self.num_actions, (count,)).numpy()

    def fit_offset(self, rewards):
        """Fixes the offset of Q from the rewards (N,) of the initial random data of all ranks."""
        if self.config.value_offset:
            self.value_offset += self.ranks.mean(rewards.mean()) / (1 - self.config.gamma)

    @torch.no_grad()
    def act(self, observations):
        """Epsilon-greedy actions (K,) for flat observations (K, O), numpy to numpy."""
        observations = torch.as_tensor(observations, dtype=torch.float32, device=self.device)
        greedy = self.policy(observations).cpu().numpy()
        exploring = (torch.rand(len(greedy)) < self.config.epsilon).numpy()
        return np.where(exploring, self.random_actions(len(greedy)), greedy)

    def update(self, batch, largest_reward):
        """One gradient step of the Q-network, then of its target.

        `batch` is what `ReplayBuffer.sample` returns, `largest_reward` the largest ever stored. Returns the scalars to
        log, as tensors on the device: reading a number back here would make a GPU wait at every step.
        """
        config = self.config
        observations, actions, rewards, terminated, next_observations = batch
        # Without it errors of extrapolation add up where all states are worth the same: the mean Q grew to twice as much.
        # Where every reward is a cost, the best that can happen is that the episode ends.
        bound = max(largest_reward, largest_reward / (1 - config.gamma)) if config.value_bound else math.inf

        both = self.scaling(torch.cat((observations, next_observations)))
        observations, next_observations = both.chunk(2)
        with torch.no_grad():
            next_actions = self.q_network(next_observations).argmax(1)
            target_q, next_q = (config.value_scale * self.target_network(both)).chunk(2)
            targets = td_targets(rewards, terminated, self.value_offset + next_q, next_actions, config.gamma, bound)
            targets -= config.advantage_learning * action_gap(target_q, actions)
        output = self.q_network(observations).gather(1, actions[:, None]).squeeze(1)
        q = self.value_offset + config.value_scale * output
        loss = td_loss(q, targets)
        self.optimizer.zero_grad()
        loss.backward()
        self.ranks.average_gradients(self.parameters)
        self.optimizer.step()
        self.schedule.step()

        with torch.no_grad():
            torch._foreach_lerp_(self.target_parameters, self.parameters, config.target_update_tau)
        return {"loss": loss.detach(), "mean_q": q.detach().mean()}

    def state(self):
        """Everything that an update depends on and changes, for a checkpoint."""
        return {
            "q_network": self.q_network.state_dict(),
            "target_network": self.target_network.state_dict(),
            "value_offset": self.value_offset,
            "optimizer": self.optimizer.state_dict(),
            "schedule": self.schedule.state_dict(),
        }

    def load_state(self, state):
        for name, saved in state.items():
            own = getattr(self, name)
            if isinstance(own, torch.Tensor):
                own.copy_(saved)
            else:
                own.load_state_dict(saved)


# Evaluation


@torch.inference_mode()
def evaluate(policy, env_id, seed):
    """Return and length of one episode with the greedy `policy`, or with random actions where it is None."""
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
    """The policy's action for one raw observation: numpy to int."""
    return int(policy(torch.as_tensor(observation, dtype=torch.float32)[None]))


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
        "replay_buffer_capacity", "batch_size", "learning_rate_decay", "layers", "log_interval",
        "eval_interval", "num_eval_episodes", "checkpoint_interval",
    )  # fmt: skip
    common.require_range(config, 0, math.inf, "learning_rate", "adam_epsilon")
    common.require_range(config, 0, 1, "epsilon", "gamma", "target_update_tau")
    common.require_range(config, 0, 2**63 - 1, "seed")
    common.require_range(config, 1, 1024, "num_threads")
    common.require_batch(config)
    if not 0 <= config.advantage_learning < 1:
        raise InputError(f"--advantage-learning {config.advantage_learning} is not in [0, 1): the values would diverge")
    if not 0 < config.value_scale < math.inf:
        raise InputError(f"--value-scale {config.value_scale} is no scale: use a positive number")
    if (config.value_offset or config.value_bound) and config.gamma >= 1:
        raise InputError(
            f"--gamma {config.gamma} makes an endless episode's worth infinite: use less than 1, "
            "or --no-value-offset --no-value-bound"
        )


def train(config):
    """Trains as `config` says and returns the run directory's path.

    Raises InputError for a config that cannot be run, RunError when the run fails; what it saved stays.

    A resumed run equals one that was never interrupted: a checkpoint is taken between two iterations and holds the
    agent, the replay, the random generators and the evaluations under way, and of the running episodes their seeds and
    actions, which bring the environment back to the same state (`common.SeededEpisodes`).
    """
    check(config)
    with make_env(config.env_id) as env:
        observation_space, action_space, spec = env.observation_space, env.action_space, env.spec
    with common.Run(config, "dqn_cartpole", evaluate) as run:
        ranks, saved = run.ranks, run.checkpoint
        episodes = common.Episodes(config.num_envs, config.seed, ranks.rank * config.num_envs, saved.get("episodes"))
        # In this process: a step of CartPole costs less than a message to a worker.
        envs = run.enter(episodes.open_envs(partial(make_training_env, config.env_id), in_workers=False))
        torch.manual_seed(config.seed)  # the same networks on every rank
        agent = DQNAgent(config, observation_space, action_space, run.device, ranks)
        buffer = ReplayBuffer(config.replay_buffer_capacity, agent.observation_size, run.device)
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
            actions = agent.random_actions(config.num_envs) if warming_up else agent.act(observations)
            next_observations, rewards, terminated, truncated, infos = envs.step(actions)
            env_steps += steps_per_round
            done = terminated | truncated
            buffer.add(observations, actions, rewards, terminated, common.last_observations(next_observations, infos))
            episodes.record(actions, rewards, done)
            observations = next_observations

            if warming_up and env_steps >= config.initial_collect_steps:
                agent.fit_offset(buffer.rewards())
                run.start_evaluation(step, env_steps, agent.policy)

            metrics = {}
            updates_due = (env_steps - config.initial_collect_steps) // config.collect_steps_per_iteration
            while step < min(updates_due, config.num_iterations):
                batch = buffer.sample(config.batch_size // ranks.world_size)
                metrics = agent.update(batch, buffer.largest_reward)
                step += 1
                run.progress.update()
                if step % config.log_interval == 0:
                    run.log_training(step, env_steps, episodes, metrics)
                if step % config.eval_interval == 0:
                    run.start_evaluation(step, env_steps, agent.policy)
            common.require_finite(step, metrics)

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
        config = tyro.cli(Config, default=common.resumed_config(config, "dqn_cartpole"))
    if config.evaluate is not None:
        check(config)
        common.evaluate_policy_file(config, make_env, make_policy, evaluate, film)
    else:
        train(config)


if __name__ == "__main__":
    common.run_main(main)
