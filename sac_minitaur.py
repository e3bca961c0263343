"""Soft Actor-Critic teaches the Minitaur, a simulated quadruped, to run.

    python sac_minitaur.py                                    # 16 minutes on two idle CPU cores, return about 36
    python sac_minitaur.py --env-id Pendulum-v1 --num-iterations 10000 --initial-collect-steps 1000
    python sac_minitaur.py --resume runs/RUN                  # continues a run that was stopped or killed
    python sac_minitaur.py --evaluate runs/RUN/policy.pt      # evaluates and films a saved policy
    python sac_minitaur.py --tutorial                         # the tutorials' own choices, which learn little
    torchrun --nproc-per-node 2 sac_minitaur.py               # two processes, one agent

The actor is a network that gives a density π(a|s) of actions, and samples from it. How random the actions are is the
entropy, the mean of −log π(a|s). Two critics estimate Q(s, a): the rewards from action a on, and α × the entropies of
the steps after it. The actor learns to make Q + α × entropy large: it earns much but stays random, and so it explores.
α is tuned until the entropy has a given value. The critics move to a target, with r, γ and s' as in dqn_cartpole.py:

    y = r + γ (min Q(s', a') − α log π(a'|s')) with a' ~ π(·|s'), or y = r where the robot fell

The minimum is over the two critics, not over actions. The actor uses it, too: an actor that maximizes one estimate
exploits its errors. In SAC's paper slow copies of the critics, the target critics, compute y. Here the critics compute
it themselves, as in CrossQ, a later variant of SAC (arXiv:1902.05605): batch normalization makes this stable enough.

This script reimplements the TF-Agents tutorials "SAC minitaur" (2018, 2021, 2023), after Haarnoja et al. 2018, "Soft
Actor-Critic Algorithms and Applications" (https://arxiv.org/abs/1812.05905). `Config` marks what is "ours", README why.
"""

import copy
import dataclasses
import math
import os
import weakref
from functools import partial
from pathlib import Path

import gymnasium as gym
import numpy as np
import torch
from pydantic import NonNegativeFloat, PositiveInt
from pydantic.dataclasses import dataclass
from torch import nn
from torch.nn import functional as F

import common


@dataclass(frozen=True, config=common.CONFIG)
class Config:
    """Soft Actor-Critic on the Minitaur. Values are the tutorials' of 2021 and 2023 unless a line says "ours"."""

    env_id: common.Task = "MinitaurBulletEnv-v0"  # a gymnasium task with a bounded Box action space
    max_episode_steps: PositiveInt | None = None  # time limit (default: the task's own, or 1 000 where it has none)
    num_iterations: PositiveInt = 60_000  # ours (theirs: 100 000): gradient updates
    initial_collect_steps: PositiveInt = 10_000  # random steps before the first update, of all environments together
    collect_steps_per_iteration: PositiveInt = 1  # steps of each environment for each update
    num_envs: common.Count = 4  # ours (theirs: 1): environments at once, each in a worker process
    replay_buffer_capacity: PositiveInt = 1_000_000  # ours (theirs: 1e4; 2018: 1e6): transitions kept by each process
    batch_size: PositiveInt = 128  # ours (theirs: 256): transitions for each update, over all processes
    actor_update_interval: PositiveInt = 3  # ours, as in CrossQ (theirs: 1): updates for each move of actor and α

    actor_learning_rate: NonNegativeFloat = 1e-3  # ours, as in CrossQ (theirs: 3e-4): Adam's, for the actor
    critic_learning_rate: NonNegativeFloat = 1e-3  # ours, as in CrossQ (theirs: 3e-4): Adam's, for the critics
    alpha_learning_rate: NonNegativeFloat = 1e-3  # ours, as in CrossQ (theirs: 3e-4): Adam's, for log α
    adam_epsilon: NonNegativeFloat = 1e-7  # Adam's ε, Keras's value
    adam_beta1: common.Below1 = 0.5  # ours (theirs: 0.9): Adam's β1. CrossQ lowers the networks'. Here α has it, too
    privileged_critics: bool = True  # ours (theirs: no): critics see speed, turning and height (arXiv:1710.06542)
    critic_batch_norm: bool = True  # ours (theirs: no): batch norm instead of target critics (CrossQ, arXiv:1902.05605)
    target_update_tau: common.Fraction = 0.005  # without batch norm: target ← target + τ (critics − target) per update
    gamma: common.Fraction = 0.99  # discount
    time_limit_terminates: bool = False  # ours (theirs: yes): a time limit counts as an end of the task
    observation_scaling: bool = True  # ours (theirs: no): bring observations near [-1, 1]: `common.ObservationScaling`
    reward_scaling: bool = True  # ours (theirs: no): divide rewards by their std under random actions
    reward_scale_factor: NonNegativeFloat = 0.5  # ours (theirs: 1): factor of the rewards, after the division
    averaged_actor_tau: common.Fraction = 0.015  # ours (theirs: 1): policy ← policy + τ (actor − policy)
    critic_loss_weight: NonNegativeFloat = 0.5  # factor of each critic's loss (TF-Agents' default)
    target_entropy_per_action: float = -1.0  # ours (theirs: −0.5): entropy that α aims at, per number of an action
    initial_log_alpha: float = 0.0  # log α at the start (TF-Agents' default); α weighs the entropy against Q
    actor_layers: common.Layers = (256, 256)  # hidden units of the actor
    critic_layers: common.Layers = (256, 256)  # hidden units of each critic

    seed: common.Seed = 0  # source of the run's randomness
    device: common.Device = "auto"  # auto, cpu, cuda, cuda:N or mps
    num_threads: common.Count = 1  # CPU threads of the update: 1 or 2 on two cores, 4 on sixteen
    cuda_graph: bool = False  # on a GPU: record the update once and repeat it, about twice as fast: see `cuda_graph`
    run_dir: Path | None = None  # a new directory for the results (default: runs/sac_minitaur-<time>-seed<seed>)
    video: bool = True  # film the trained agent, a random one, and the progress between
    log_interval: PositiveInt = 5_000  # updates between rows of train.csv
    eval_interval: PositiveInt = 10_000  # updates between evaluations
    num_eval_episodes: PositiveInt = 20  # episodes per evaluation
    checkpoint_interval: PositiveInt = 5_000  # updates between checkpoints. Each cuts the running episodes


TUTORIAL = {
    "num_iterations": 100_000,
    "num_envs": 1,
    "batch_size": 256,
    "actor_update_interval": 1,
    "replay_buffer_capacity": 10_000,
    "actor_learning_rate": 3e-4,
    "critic_learning_rate": 3e-4,
    "alpha_learning_rate": 3e-4,
    "adam_beta1": 0.9,
    "privileged_critics": False,
    "critic_batch_norm": False,
    "time_limit_terminates": True,
    "observation_scaling": False,
    "reward_scaling": False,
    "reward_scale_factor": 1.0,
    "averaged_actor_tau": 1.0,
    "target_entropy_per_action": -0.5,
}


# In shapes: B batch, K environments, N transitions stored, A action, O the task's observation. In training it has S
# numbers: these O, then the privileged ones. The actor uses the first O. The critics use all S and call them a state.


def mlp(inputs, hidden_layers, outputs, batch_norm=False):
    """Linear layers with ReLU between, Glorot-uniform weights and zero biases (the tutorials' initialization)."""
    layers = []
    for units in (*hidden_layers, outputs):
        if batch_norm:
            layers.append(nn.BatchNorm1d(inputs, momentum=0.01, eps=1e-3))  # of each layer's input, CrossQ's numbers
        linear = nn.Linear(inputs, units)
        nn.init.xavier_uniform_(linear.weight)
        nn.init.zeros_(linear.bias)
        layers += [linear, nn.ReLU(inplace=True)]
        inputs = units
    return nn.Sequential(*layers[:-1])  # no ReLU after the outputs


class Actor(nn.Module):
    """A Gaussian over actions, squashed by tanh into (-1, 1). It uses only the first O of the S numbers of a state."""

    def __init__(self, observation_size, action_size, hidden_layers):
        super().__init__()
        self.observation_size = observation_size
        self.net = mlp(observation_size, hidden_layers, 2 * action_size)

    def forward(self, observation):
        """Mean and log standard deviation before squashing, (…, A) each, for observations (…, O or more)."""
        outputs = self.net(observation[..., : self.observation_size])
        mean, log_std = outputs.chunk(2, dim=-1)
        return mean, log_std.clamp(-20, 2)  # 2018's and the authors' bounds, also with --tutorial

    def sample(self, observation):
        """Actions (…, A) and their log-probabilities (…), differentiable with respect to the network.

        With a = tanh(u), log π(a) = log N(u) − Σ log(1 − tanh²u) (arXiv:1812.05905, appendix C). 1 − tanh²u is tanh's
        slope. The code has its log as 2 (log 2 − u − softplus(−2u)), which is finite where tanh u rounds to ±1, too.
        """
        mean, log_std = self(observation)
        noise = torch.randn_like(mean)
        u = mean + log_std.exp() * noise
        log_density = -0.5 * noise.square() - log_std - 0.5 * math.log(2 * math.pi)  # log N(u): noise = (u − mean) / σ
        log_slope = 2 * (math.log(2) - u - F.softplus(-2 * u))
        return u.tanh(), (log_density - log_slope).sum(-1)


class TwinCritics(nn.Module):
    """Two separate estimates of Q(s, a) from the same data."""

    def __init__(self, state_size, action_size, hidden_layers, batch_norm):
        super().__init__()
        self.q1 = mlp(state_size + action_size, hidden_layers, 1, batch_norm)
        self.q2 = mlp(state_size + action_size, hidden_layers, 1, batch_norm)

    def forward(self, state, action):
        """(2, B) for states (B, S) and actions (B, A)."""
        x = torch.cat((state, action), dim=-1)
        return torch.stack((self.q1(x), self.q2(x))).squeeze(-1)


class Policy(nn.Module):
    """The deterministic policy, in the task's own units: what is evaluated, exported and filmed."""

    def __init__(self, config, observation_space, action_space):
        super().__init__()
        self.action_dtype = action_space.dtype
        self.scaling = common.ObservationScaling(observation_space) if config.observation_scaling else nn.Identity()
        self.actor = Actor(math.prod(observation_space.shape), math.prod(action_space.shape), config.actor_layers)
        low = np.float32(action_space.low)
        high = np.float32(action_space.high)
        # A float64 bound may lie between two float32 numbers: take the inner one.
        low = np.where(low < action_space.low, np.nextafter(low, high), low)
        high = np.where(high > action_space.high, np.nextafter(high, low), high)
        self.register_buffer("low", torch.tensor(low))
        self.register_buffer("high", torch.tensor(high))

    def forward(self, observation):
        """Actions (batch, *action shape) for observations (batch, *observation shape)."""
        mean, _ = self.actor(self.scaling(observation.flatten(1)))
        return to_bounds(mean.tanh().unflatten(1, self.low.shape), self.low, self.high)

    @torch.inference_mode()
    def act(self, observation):
        """The action for one observation, from numpy to numpy, in the action space's own type. Only on the CPU."""
        batch = torch.from_numpy(np.array(observation, np.float32))[None]
        return self(batch)[0].numpy().astype(self.action_dtype)


def to_bounds(action, low, high):
    """Maps an action from [-1, 1] to [low, high]. Halves, because high − low may overflow; clip, because it rounds."""
    return (low / 2 + high / 2 + (high / 2 - low / 2) * action).clip(low, high)


class ReplayBuffer:
    """The last `capacity` transitions, on the training device, in float32.

    `terminated` is 1 where the task itself ended. After a time limit (`truncated`) it is 0: rewards would follow.
    """

    def __init__(self, capacity, state_size, action_size, device):
        self.observations = torch.empty((capacity, state_size), device=device)
        self.actions = torch.empty((capacity, action_size), device=device)
        self.rewards = torch.empty((capacity,), device=device)
        self.terminated = torch.empty((capacity,), device=device)
        self.next_observations = torch.empty((capacity, state_size), device=device)
        self.capacity = capacity
        self.size = 0
        self.position = 0

    def add(self, observations, actions, rewards, terminated, next_observations):
        """Stores K transitions, numpy (K, S), (K, *action shape), (K,), (K,), (K, S). If full, it drops the oldest."""
        count = len(rewards)
        rows = (self.position + torch.arange(count)) % self.capacity
        # .to(self.rewards): to the buffer's device, in float32
        self.observations[rows] = torch.from_numpy(observations).to(self.rewards)
        self.actions[rows] = torch.from_numpy(actions).to(self.rewards).flatten(1)
        self.rewards[rows] = torch.from_numpy(rewards).to(self.rewards)
        self.terminated[rows] = torch.from_numpy(terminated).to(self.rewards)
        self.next_observations[rows] = torch.from_numpy(next_observations).to(self.rewards)
        self.position = (self.position + count) % self.capacity
        self.size = min(self.size + count, self.capacity)

    def sample(self, batch_size):
        """A batch drawn uniformly with replacement: (B, S), (B, A), (B,), (B,), (B, S)."""
        i = torch.randint(self.size, (batch_size,), device=self.rewards.device)
        return self.observations[i], self.actions[i], self.rewards[i], self.terminated[i], self.next_observations[i]


def td_targets(rewards, terminated, next_q, next_log_probs, alpha, gamma):
    """r + γ (1 − terminated) (min over the twins of Q(s', a') − α log π(a'|s')): (B,).

    next_q (2, B), alpha and gamma scalars, the rest (B,). Equations 3 and 5 of arXiv:1812.05905, for two critics.
    """
    return rewards + gamma * (1 - terminated) * (next_q.amin(0) - alpha * next_log_probs)


def critic_loss(q, targets, weight):
    """The sum over the twins of `weight` × mean squared error: q (2, B), targets (B,)."""
    return weight * (q - targets).square().mean(1).sum()


def actor_loss(log_probs, q, alpha):
    """The mean of α log π(a|s) − min over the twins of Q(s, a): log_probs (B,), q (2, B). The paper's equation 7."""
    return (alpha * log_probs - q.amin(0)).mean()


def alpha_loss(log_alpha, log_probs, target_entropy):
    """The mean of −log α (log π + target entropy), which is log α × (entropy − target entropy): log_probs (B,).

    A gradient step raises α while the entropy is too low. As in TF-Agents; equation 18 of arXiv:1812.05905 has α where
    this has log α: the gradient's sign is the same.
    """
    return -(log_alpha * (log_probs.detach() + target_entropy)).mean()


class SACAgent(nn.Module):
    """Actor, twin critics and the entropy's weight α, with their optimizers, and the policy that is evaluated.

    The actor sees the task's observation, O numbers. The critics see S = `state_size` numbers: these O and the
    privileged ones. The policy's actor is a running average of the actor, because a single snapshot may be bad.
    """

    def __init__(self, config, observation_space, action_space, state_size, device):
        super().__init__()
        self.config = config
        self.device = device
        self.action_shape = action_space.shape
        action_size = math.prod(action_space.shape)
        self.target_entropy = config.target_entropy_per_action * action_size
        self.register_buffer("reward_scale", torch.tensor(config.reward_scale_factor))  # see fit_scaling
        self.policy = Policy(config, observation_space, action_space).requires_grad_(False)
        self.scaling = self.policy.scaling
        self.actor = copy.deepcopy(self.policy.actor).requires_grad_(True)  # learns; policy.actor follows it
        self.critics = TwinCritics(state_size, action_size, config.critic_layers, config.critic_batch_norm)
        self.target_critics = None if config.critic_batch_norm else copy.deepcopy(self.critics).requires_grad_(False)
        self.log_alpha = nn.Parameter(torch.tensor(config.initial_log_alpha))
        self.to(device)

        adam = {"betas": (config.adam_beta1, 0.999), "eps": config.adam_epsilon, "fused": True}
        self.critic_optimizer = torch.optim.Adam(self.critics.parameters(), config.critic_learning_rate, **adam)
        self.actor_optimizer = torch.optim.Adam(self.actor.parameters(), config.actor_learning_rate, **adam)
        self.alpha_optimizer = torch.optim.Adam([self.log_alpha], config.alpha_learning_rate, **adam)
        self.optimizers = [self.critic_optimizer, self.actor_optimizer, self.alpha_optimizer]  # a checkpoint saves them

    def random_actions(self, count):
        """Uniform actions (K, *action shape) in [-1, 1], numpy."""
        return (2 * torch.rand(count, *self.action_shape) - 1).numpy()

    def fit_scaling(self, observations, rewards):
        """Fits the scales to observations (N, S) and rewards (N,) of random actions, over all processes.

        Rewards are divided by their standard deviation.
        """
        if self.config.observation_scaling:
            self.scaling.fit(observations[:, : self.actor.observation_size])
        if self.config.reward_scaling:
            mean = rewards.mean()
            common.average([mean])  # in place, over the processes
            variance = (rewards - mean).square().mean()
            common.average([variance])
            std = variance.sqrt()
            # Rewards that were all equal are not divided. Rounding may make their std slightly more than 0.
            divisor = torch.where(std > 1e-6 * mean.abs(), std, 1.0)
            self.reward_scale.copy_(self.config.reward_scale_factor / divisor)

    def scaled(self, observations):
        """Observations (…, S) with the task's O numbers scaled. The critics' batch norm, if any, scales the others."""
        size = self.actor.observation_size
        return torch.cat((self.scaling(observations[..., :size]), observations[..., size:]), dim=-1)

    @torch.no_grad()
    def act(self, observations):
        """Sampled actions (K, *action shape) in [-1, 1] for flat observations (K, S), from numpy to numpy."""
        observations = torch.as_tensor(observations, dtype=torch.float32, device=self.device)
        actions, _ = self.actor.sample(self.scaled(observations))
        if not actions.isfinite().all():
            raise FloatingPointError("the actor's actions are not finite: learning diverged; lower its rates")
        return actions.view(-1, *self.action_shape).cpu().numpy()

    def update(self, batch, step):
        """Update number `step`, from 0: a gradient step of the critics, in some updates also of actor and α.

        `batch` is what `ReplayBuffer.sample` returns. Returns the scalars to log, as tensors on the device: `.item()`
        here would make the CPU wait for the GPU.
        """
        metrics = self.update_critics(batch)
        if step % self.config.actor_update_interval == 0:  # ours; in the paper always
            metrics = metrics | self.update_actor(batch)
        return metrics

    def update_critics(self, batch):
        """Q(s, a) moves to y = r + γ (1 − terminated) (min Q(s', a') − α log π(a'|s')), with a' ~ π(·|s')."""
        config = self.config
        s, a, rewards, terminated, next_s = batch  # (B, S), (B, A), (B,), (B,), (B, S); the actor uses O of S
        s = self.scaled(s)
        next_s = self.scaled(next_s)
        rewards = self.reward_scale * rewards
        alpha = self.log_alpha.detach().exp()
        with torch.no_grad():
            next_a, next_log_probs = self.actor.sample(next_s)  # (B, A), (B,)
        if not config.critic_batch_norm:  # as in the paper
            q = self.critics(s, a)  # (2, B)
            next_q = self.target_critics(next_s, next_a)  # (2, B)
        else:
            # Ours: one pass, as in CrossQ. In two passes batch norm would scale the stored a and the new a' with
            # different means and variances, and Q(s, a) and Q(s', a') would be two functions. No gradient reaches
            # next_q, because y is computed under no_grad.
            self.critics.train()
            both = self.critics(torch.cat((s, next_s)), torch.cat((a, next_a)))  # (2, 2B)
            q, next_q = both.chunk(2, dim=1)  # (2, B) each
            self.critics.eval()  # the actor's step uses the running statistics
        with torch.no_grad():
            y = td_targets(rewards, terminated, next_q, next_log_probs, alpha, config.gamma)  # (B,)
        loss = critic_loss(q, y, config.critic_loss_weight)

        self.critic_optimizer.zero_grad()
        loss.backward()
        # Several processes: the mean of their gradients, and of batch normalization's running means and variances.
        gradients = [parameter.grad for parameter in self.critics.parameters()]
        statistics = [tensor for tensor in self.critics.buffers() if tensor.is_floating_point()]  # not the batch count
        common.average(gradients + statistics)
        self.critic_optimizer.step()
        if not config.critic_batch_norm:  # the target critics follow: θ̄ ← θ̄ + τ (θ − θ̄)
            soft_update(self.target_critics, self.critics, config.target_update_tau)
        return {"critic_loss": loss.detach(), "mean_q": q.detach().mean(), "alpha": alpha}

    def update_actor(self, batch):
        """The actor lowers α log π(a|s) − min Q(s, a), with a ~ π(·|s). α falls while the entropy is too high."""
        s = self.scaled(batch[0])  # (B, S)
        alpha = self.log_alpha.detach().exp()
        new_a, log_probs = self.actor.sample(s)  # (B, A), (B,)
        self.critics.requires_grad_(False)  # the loss passes through them, but they need no gradients
        loss = actor_loss(log_probs, self.critics(s, new_a), alpha)
        loss_alpha = alpha_loss(self.log_alpha, log_probs, self.target_entropy)

        self.actor_optimizer.zero_grad()
        loss.backward()
        self.alpha_optimizer.zero_grad()
        loss_alpha.backward()
        gradients = [parameter.grad for parameter in self.actor.parameters()]
        common.average([*gradients, self.log_alpha.grad])
        self.actor_optimizer.step()
        self.alpha_optimizer.step()
        self.critics.requires_grad_(True)
        soft_update(self.policy.actor, self.actor, self.config.averaged_actor_tau)  # the policy's actor follows
        return {"actor_loss": loss.detach(), "alpha_loss": loss_alpha.detach(), "entropy": -log_probs.detach().mean()}


@torch.no_grad()
def soft_update(target, source, tau):
    """Moves the parameters of `target` by the fraction `tau` towards those of `source`."""
    for slow, parameter in zip(target.parameters(), source.parameters()):
        slow.lerp_(parameter, tau)


def cuda_graph(agent, function):
    """For --cuda-graph: wraps `function(batch)`. Its third call is recorded, and later calls replay the record.

    Without a graph, the GPU waits for Python between hundreds of small operations. The results are the same: a replay
    repeats the operations, with new random numbers. Leave --cuda-graph out when your update has an `if` on data.
    Raises InputError where there is no GPU, or more than one process.
    """
    if agent.device.type != "cuda" or torch.distributed.is_initialized():
        raise common.InputError("--cuda-graph is for one process with a CUDA GPU: use --no-cuda-graph")
    graph = torch.cuda.CUDAGraph()
    calls = 0
    recorded = None
    metrics = None

    def replay(batch):
        nonlocal calls, recorded, metrics
        calls += 1
        if calls < 3:  # they make Adam's state and load what CUDA needs, which must not be recorded
            return function(batch)
        if calls == 3:
            groups = [group for optimizer in agent.optimizers for group in optimizer.param_groups]
            for group in groups:
                group["capturable"] = True  # PyTorch refuses to record an Adam step without it
            recorded = batch
            with torch.cuda.graph(graph, stream=torch.cuda.Stream(agent.device)):  # records only, on this GPU
                metrics = function(recorded)
            for group in groups:
                group["capturable"] = False  # a checkpoint would have True, and a run without a graph would warn
        for graph_input, values in zip(recorded, batch):
            graph_input.copy_(values)  # a replay reads its batch from the recorded tensors
        graph.replay()
        return metrics  # the next replay overwrites them

    return replay


def evaluate(policy, env, seed):
    """Return and length of one episode of a gymnasium environment. `policy` None: random actions."""
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


def make_training_env(task, privileged):
    """The task as the agent sees it in training: actions in [-1, 1], flat observations, the return of each episode.

    With `privileged`, the environment's `privileged_observation` (S − O,), if it has one, follows the observation (O,).
    """
    env = gym.wrappers.RecordEpisodeStatistics(gym.make(task))
    low = env.action_space.low
    high = env.action_space.high
    dtype = env.action_space.dtype
    unit = gym.spaces.Box(-1, 1, low.shape, np.float32)
    env = gym.wrappers.TransformAction(env, lambda action: to_bounds(action, low, high).astype(dtype), unit)
    env = gym.wrappers.FlattenObservation(env)
    if privileged and hasattr(env.unwrapped, "privileged_space"):
        own = env.observation_space
        more = env.unwrapped.privileged_space
        observe = env.unwrapped.privileged_observation
        both = gym.spaces.Box(np.append(own.low, more.low), np.append(own.high, more.high))
        env = gym.wrappers.TransformObservation(env, lambda observation: np.append(observation, observe()), both)
    return env


def make_vector_env(task, config):
    """`num_envs` environments (K), each in a worker process. One whose episode has ended resets itself at once."""
    privileged = config.privileged_critics
    main_process = os.getpid()

    def make():
        if os.getpid() != main_process:  # AsyncVectorEnv makes one in the main process, too, to see its spaces
            common.prepare_worker()  # ignores Ctrl-C, and ends with the main process
        return make_training_env(task, privileged)

    method = common.start_method(config.env_id)  # fork, spawn or forkserver
    autoreset = gym.vector.AutoresetMode.SAME_STEP
    return gym.vector.AsyncVectorEnv([make] * config.num_envs, context=method, autoreset_mode=autoreset)


def store(buffer, observations, actions, result, run):
    """Stores the transitions of one vector step. Returns the observations to act on next: (K, S)."""
    new_observations, rewards, terminated, truncated, infos = result
    ended = terminated | truncated
    if run.config.time_limit_terminates:  # theirs
        terminated = ended
    # Where an episode ended, new_observations is already the next one's start. Its own end is in final_obs.
    next_observations = new_observations.copy()
    for i in np.flatnonzero(ended):
        next_observations[i] = infos["final_obs"][i]
        episode = infos["final_info"]["episode"]
        run.log_episode(episode["r"][i], episode["l"][i])
    buffer.add(observations, actions, rewards, terminated, next_observations)
    run.env_steps += len(rewards) * run.world_size
    return new_observations


def train(config, resume=None):
    """Trains as `config` says and returns the run directory's path.

    `resume` is the directory of a run that continues: see `common.continued`. Raises InputError for what cannot be
    used, and KeyboardInterrupt after Ctrl-C, once a checkpoint is saved.
    """
    config, checkpoint = common.continued(config, resume, "sac_minitaur")
    rank, world_size = common.join_processes()  # torchrun's: this process's number, their count; else 0, 1
    with common.Run("sac_minitaur", config, evaluate, rank, world_size) as run:  # starts processes that call `evaluate`
        task, observation_space, action_space = common.find_task(config, gym.spaces.Box)
        envs = make_vector_env(task, config)
        _, state_size = envs.observation_space.shape  # S, with the privileged numbers
        torch.manual_seed(config.seed)  # the same networks in every process
        agent = SACAgent(config, observation_space, action_space, state_size, run.device)
        buffer = ReplayBuffer(config.replay_buffer_capacity, state_size, math.prod(action_space.shape), run.device)
        if config.cuda_graph:  # agent.update then calls these
            agent.update_critics = cuda_graph(agent, agent.update_critics)
            agent.update_actor = cuda_graph(agent, agent.update_actor)
        torch.manual_seed(common.derive_seed(config.seed, rank))  # own actions and batches in every process
        env_numbers = range(rank * config.num_envs, (rank + 1) * config.num_envs)  # of this process
        start = run.begin(task, agent, buffer, checkpoint)  # restores a checkpoint. start: the updates done so far

        if run.env_steps < config.initial_collect_steps:  # most resumed runs are past this
            observations, _ = envs.reset(seed=[common.derive_seed(config.seed, i) for i in env_numbers])
            while run.env_steps < config.initial_collect_steps:
                run.stop_if_requested(start)
                actions = agent.random_actions(config.num_envs)
                observations = store(buffer, observations, actions, envs.step(actions), run)
            agent.fit_scaling(buffer.observations[: buffer.size], buffer.rewards[: buffer.size])

        for step in range(start, config.num_iterations):
            # A resumed run begins new episodes at its checkpoint, so every run does so: see dqn_cartpole.py. The cut is
            # no termination: the targets of the transitions before it keep Q(s', a').
            if step == start or step % config.checkpoint_interval == 0:
                run.save(step)
                observations, _ = envs.reset(seed=[common.derive_seed(config.seed, i, step) for i in env_numbers])
            if step % config.eval_interval == 0:
                run.evaluate(step, agent.policy)
            run.stop_if_requested(step)

            for _ in range(config.collect_steps_per_iteration - 1):  # the last one is below, during the update
                actions = agent.act(observations)
                observations = store(buffer, observations, actions, envs.step(actions), run)
            # The update learns from the steps before this one, while the simulators work.
            actions = agent.act(observations)
            envs.step_async(actions)
            batch = buffer.sample(config.batch_size // world_size)  # this process's share of the batch
            metrics = agent.update(batch, step)
            observations = store(buffer, observations, actions, envs.step_wait(), run)
            run.log(step + 1, metrics)  # a row every log_interval updates, with the latest of each metric

        envs.close()
        run.finish(config.num_iterations, observation_space.shape)  # checkpoint, evaluation, curve, films
        return run.path


# The Minitaur


@dataclasses.dataclass(frozen=True)
class Dynamics:
    """What the Minitaur draws anew at every reset. Ranges: pybullet's minitaur_env_randomizer.py."""

    base_mass: float  # kg, the model's × U(0.8, 1.2)
    leg_mass: float  # kg, of each of the 16 leg links, the model's × U(0.8, 1.2)
    motor_mass: float  # kg, of each of the 8 motors, the model's × U(0.8, 1.2)
    voltage: float  # V, the battery's, U(14.8, 16.8)
    viscous_damping: float  # N·m·s/rad, the motors', U(0, 0.01)
    foot_friction: float  # lateral friction coefficient of the feet, U(0.8, 1.5)


class Simulator:
    """A simulation of its own in this process, with pybullet's functions as methods.

    Python's garbage collection disconnects it.
    """

    def __init__(self):
        try:
            import pybullet  # here, so that other tasks train on machines without it
            import pybullet_data
        except ImportError as error:
            what = "the Minitaur needs pybullet, which has no wheel for Python 3.14 and newer"
            hint = "uv run --python 3.13 --with-requirements requirements.txt sac_minitaur.py"
            raise ImportError(f"{what}: {hint}") from error

        self.pybullet = pybullet
        self.client = pybullet.connect(pybullet.DIRECT)
        weakref.finalize(self, pybullet.disconnect, self.client)
        self.setAdditionalSearchPath(pybullet_data.getDataPath())

    def __getattr__(self, name):
        value = getattr(self.pybullet, name)
        if callable(value):
            value = partial(value, physicsClientId=self.client)
        setattr(self, name, value)  # looked up once
        return value


class MinitaurBulletEnv(gym.Env):
    """Ghost Robotics' Minitaur on a plane, pybullet's `MinitaurBulletEnv-v0` to the last bit, under numpy 2.

    Action (8,): the swings of the legs front left, back left, front right, back right, then their extensions, in
    [-1, 1], held for 0.01 s. Use float32: the motor commands are computed in the action's precision.
    Observation (28,): 8 motor angles in rad, 8 motor velocities in rad/s, 8 observed torques in N·m, the base's
    orientation as a quaternion (x, y, z, w); the original's float64 values, rounded to float32.
    Reward: metres forward in this step − 0.005 × |observed torques · motor velocities| in W × 0.002 s. As in the
    original the energy counts one substep of the five.
    Terminated when the robot has fallen. `reset(options={"dynamics": d})` uses a `Dynamics` instead of drawing one.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 100}

    SUBSTEPS = 5
    SUBSTEP_SECONDS = 0.002
    SOLVER_ITERATIONS = 60
    MOTORS = tuple(f"{leg}{side}" for leg in ("front_left", "back_left", "front_right", "back_right") for side in "LR")
    DIRECTION = np.array([-1.0, -1, -1, -1, 1, 1, 1, 1])  # the motors of the left legs turn the other way
    BASE_LINK = -1
    LEG_LINKS = (2, 3, 5, 6, 8, 9, 11, 12, 15, 16, 18, 19, 21, 22, 24, 25)
    MOTOR_LINKS = (1, 4, 7, 10, 14, 17, 20, 23)
    FOOT_LINKS = (3, 6, 9, 12, 16, 19, 22, 25)
    KNEE_ANGLE = -2.1834  # rad, in the start pose
    KP = 1.0  # of a PD controller: share of the battery's voltage per rad
    KD = 0.02  # and per rad/s
    RESISTANCE = 0.186  # Ω
    TORQUE_CONSTANT = 0.0954  # N·m/A, and V·s/rad of the back-EMF, the voltage that a turning motor makes itself
    NOMINAL_VOLTAGE = 16.0  # V
    MAX_NET_VOLTAGE = 50.0  # V
    MAX_OBSERVED_TORQUE = 5.7  # N·m
    CURRENTS = np.array([0.0, 10, 20, 30, 40, 50, 60])  # A
    TORQUES = np.array([0, 1, 1.9, 2.45, 3.0, 3.25, 3.5])  # N·m, a motor's at these currents: the iron saturates
    OVERHEAT_TORQUE = 2.45  # N·m
    OVERHEAT_SUBSTEPS = 500  # a motor above this torque for more substeps in a row stays off
    MIN_UPRIGHTNESS = 0.85  # cosine of the base's tilt. Below it the robot has fallen
    MIN_HEIGHT = 0.13  # m, of the base. Below it, too

    def __init__(self, render_mode=None):
        self.render_mode = render_mode
        self.simulator = Simulator()
        max_velocity = self.NOMINAL_VOLTAGE / self.TORQUE_CONSTANT  # rad/s, where the back-EMF takes all the voltage
        high = np.repeat([math.pi, max_velocity, self.MAX_OBSERVED_TORQUE, 1.0], [8, 8, 8, 4]) + 0.01  # a margin
        self.observation_space = gym.spaces.Box(np.float32(-high), np.float32(high))
        self.privileged_space = gym.spaces.Box(-np.inf, np.inf, (7,), np.float32)
        self.action_space = gym.spaces.Box(-1, 1, (8,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self._build()
        if options and "dynamics" in options:
            self.dynamics = options["dynamics"]
        else:
            self.dynamics = self._draw_dynamics()
        self._apply_dynamics()
        self.hot_substeps = np.zeros(8)
        self.motor_enabled = np.ones(8, bool)
        self.x = 0.0
        self._read_motors()
        for _ in range(100):  # holds the start pose for 0.2 s
            self._substep(math.pi / 2)
        self._read_base()
        return self._observation(), {}

    def _build(self):
        """Loads plane and robot into an empty simulation, in the start pose.

        A leg has two motors and below each a shin, on the joint called knee. A pin joins the two shins at the foot.
        """
        simulator = self.simulator
        simulator.resetSimulation()
        simulator.setPhysicsEngineParameter(numSolverIterations=self.SOLVER_ITERATIONS)
        simulator.setTimeStep(self.SUBSTEP_SECONDS)
        simulator.loadURDF("plane.urdf")
        simulator.setGravity(0, 0, -10)
        flags = simulator.URDF_USE_SELF_COLLISION
        self.robot = robot = simulator.loadURDF("quadruped/minitaur.urdf", (0, 0, 0.2), flags=flags)
        joints = (simulator.getJointInfo(robot, i) for i in range(simulator.getNumJoints(robot)))
        joint = {info[1].decode(): info[0] for info in joints}
        self.motor_joints = [joint[f"motor_{motor}_joint"] for motor in self.MOTORS]
        knee_joints = [joint[f"knee_{motor}_link"] for motor in self.MOTORS]  # so the model names these joints
        for motor, knee, direction in zip(self.motor_joints, knee_joints, self.DIRECTION):
            simulator.resetJointState(robot, motor, direction * math.pi / 2)
            simulator.resetJointState(robot, knee, direction * self.KNEE_ANGLE)
            for free in (motor, knee):  # pybullet's own velocity motor brakes every joint until it is given no force
                simulator.setJointMotorControl2(robot, free, simulator.VELOCITY_CONTROL, force=0)
        pin = simulator.JOINT_POINT2POINT, (0, 0, 0), (0, 0.005, 0.2), (0, 0.01, 0.2)  # type, axis, place on each shin
        for left, right in zip(knee_joints[::2], knee_joints[1::2]):
            simulator.createConstraint(robot, right, robot, left, *pin)

    def _draw_dynamics(self):
        uniform = self.np_random.uniform
        links = (self.BASE_LINK, self.LEG_LINKS[0], self.MOTOR_LINKS[0])
        masses = [self.simulator.getDynamicsInfo(self.robot, link)[0] * uniform(0.8, 1.2) for link in links]
        return Dynamics(*masses, uniform(14.8, 16.8), uniform(0, 0.01), uniform(0.8, 1.5))

    def _apply_dynamics(self):
        change = self.simulator.changeDynamics
        dynamics = self.dynamics
        change(self.robot, self.BASE_LINK, mass=dynamics.base_mass)
        for link in self.LEG_LINKS:
            change(self.robot, link, mass=dynamics.leg_mass)
        for link in self.MOTOR_LINKS:
            change(self.robot, link, mass=dynamics.motor_mass)
        for link in self.FOOT_LINKS:
            change(self.robot, link, lateralFriction=dynamics.foot_friction)

    def step(self, action):
        """Raises ValueError unless all components are within ±1.01 (NaN is not), as the original does."""
        action = 1.0 * np.asarray(action)  # integers become floats, float32 stays float32
        if not (np.abs(action) <= 1.01).all():
            raise ValueError(f"action {action} is outside [-1.01, 1.01]")
        command = self._motor_angles(action)
        for _ in range(self.SUBSTEPS):
            self._substep(command)
        self._read_base()
        x, _, height = self.position
        energy = abs(np.dot(self.observed_torque, self.velocity)) * self.SUBSTEP_SECONDS  # one substep, as pybullet
        reward = x - self.x - 0.005 * energy
        self.x = x
        up_z = self.simulator.getMatrixFromQuaternion(self.orientation)[8]
        fallen = up_z < self.MIN_UPRIGHTNESS or height < self.MIN_HEIGHT
        return self._observation(), float(reward), fallen, False, {}

    @staticmethod
    def _motor_angles(action):
        """The angles in rad that the eight motors are to reach, from pybullet's `ConvertFromLegModel`.

        Extension turns the two motors of a leg by the same angle, swing by opposite angles, mirrored on the right. The
        order of operations and the action's own precision are the original's: so are the roundings.
        """
        swing = np.repeat(action[:4], 2)
        extension = np.repeat(action[4:], 2)
        per_swing = math.pi / 4 * np.array([1, -1, 1, -1, -1, 1, -1, 1], action.dtype)  # rad
        return math.pi - math.pi / 4 * (extension + 1.5) + per_swing * swing  # 1.5: pybullet's offset_for_singularity

    def _substep(self, command):
        """Drives the motors towards the angles `command` for 0.002 s, in the order of pybullet's motor.py."""
        simulator = self.simulator
        dynamics = self.dynamics
        pwm = (-self.KP * (self.angle - command) - self.KD * self.velocity).clip(-1, 1)  # share of the voltage
        drive = pwm * dynamics.voltage
        # The observed torque ignores back-EMF and the iron's saturation. The torque that moves the robot has both.
        limit = self.MAX_OBSERVED_TORQUE
        self.observed_torque = (self.TORQUE_CONSTANT * (drive / self.RESISTANCE)).clip(-limit, limit)
        back_emf = (self.TORQUE_CONSTANT + dynamics.viscous_damping) * self.velocity  # pybullet adds the damping here
        current = (drive - back_emf).clip(-self.MAX_NET_VOLTAGE, self.MAX_NET_VOLTAGE) / self.RESISTANCE
        torque = np.interp(np.abs(current), self.CURRENTS, self.TORQUES)
        self.hot_substeps = np.where(torque > self.OVERHEAT_TORQUE, self.hot_substeps + 1, 0)
        self.motor_enabled &= self.hot_substeps <= self.OVERHEAT_SUBSTEPS
        force = np.sign(current) * torque * self.DIRECTION * self.motor_enabled
        mode = simulator.TORQUE_CONTROL
        simulator.setJointMotorControlArray(self.robot, self.motor_joints, mode, forces=force.tolist())
        simulator.stepSimulation()
        self._read_motors()

    def _read_motors(self):
        angle, velocity, _, _ = zip(*self.simulator.getJointStates(self.robot, self.motor_joints))
        self.angle = np.array(angle) * self.DIRECTION
        self.velocity = np.array(velocity) * self.DIRECTION

    def _read_base(self):
        self.position, self.orientation = self.simulator.getBasePositionAndOrientation(self.robot)

    def _observation(self):
        return np.concatenate((self.angle, self.velocity, self.observed_torque, self.orientation), dtype=np.float32)

    def privileged_observation(self):
        """What the observation lacks, (7,) float32: the base's velocity in m/s, its angular velocity in rad/s, both in
        its own frame (forwards, left, up), and its height in m."""
        velocity, angular_velocity = self.simulator.getBaseVelocity(self.robot)
        rotation = np.reshape(self.simulator.getMatrixFromQuaternion(self.orientation), (3, 3))
        return np.concatenate((velocity @ rotation, angular_velocity @ rotation, self.position[2:]), dtype=np.float32)

    def render(self):
        """The robot from its side, (360, 480, 3) uint8, from pybullet's software renderer."""
        simulator = self.simulator
        view = simulator.computeViewMatrixFromYawPitchRoll(self.position, 1, yaw=0, pitch=-30, roll=0, upAxisIndex=2)
        projection = simulator.computeProjectionMatrixFOV(fov=60, aspect=480 / 360, nearVal=0.1, farVal=100)
        pixels = simulator.getCameraImage(480, 360, view, projection, renderer=simulator.ER_TINY_RENDERER)[2]
        return np.asarray(pixels, np.uint8).reshape(360, 480, 4)[..., :3]

    def close(self):
        self.simulator = None  # its finalizer disconnects, only once: pybullet reuses the numbers of clients


if "MinitaurBulletEnv-v0" not in gym.registry:
    gym.register("MinitaurBulletEnv-v0", MinitaurBulletEnv, max_episode_steps=1000, reward_threshold=15.0)


def main():
    config, resume, policy_file = common.read_command_line("sac_minitaur", Config, TUTORIAL, __doc__)
    if policy_file is None:
        train(config, resume)
    else:
        common.evaluate_file(policy_file, "sac_minitaur", config, Policy, gym.spaces.Box, evaluate)


if __name__ == "__main__":
    common.run_main(main)
