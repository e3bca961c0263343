"""Measures speed: environment step, update, training, the whole job and DQN, in turn. Prints medians and ratios as CSV.

    python tests/benchmark.py | tee speed.csv  # 15 minutes, 30 with the peers; nothing else should run on the machine
    pip install stable-baselines3 sbx-rl       # optional: compares training with theirs where they are installed

Every figure is the median of `REPEATS` rounds in which all the candidates are measured one after the other, so that a
drift of the machine's speed touches all alike. Quote the ratios rather than the milliseconds.
"""

import csv
import importlib.util
import math
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import gymnasium as gym
import numpy as np
import torch

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

import sac_minitaur  # noqa: E402

REPEATS = 3
TRAINING_STEPS = 1_000
UPRIGHT = "MinitaurThatNeverFalls-v0"


class MinitaurThatNeverFalls(sac_minitaur.MinitaurBulletEnv):
    """Every episode has its 1 000 steps, as a trained robot's, so that all candidates evaluate equally much."""

    MIN_UPRIGHTNESS = MIN_HEIGHT = -math.inf


gym.register(UPRIGHT, MinitaurThatNeverFalls, max_episode_steps=1000)


def milliseconds(function, calls):
    start = time.perf_counter()
    for _ in range(calls):
        function()
    return (time.perf_counter() - start) / calls * 1e3


def medians(candidates):
    """Calls every candidate in turn, `REPEATS` times: name → median of the milliseconds that it returns."""
    rounds = [{name: candidate() for name, candidate in candidates.items()} for _ in range(REPEATS)]
    return {name: statistics.median(times[name] for times in rounds) for name in candidates}


def environment_candidates():
    env = sac_minitaur.MinitaurBulletEnv()
    env.reset(seed=0)
    action = np.zeros(8, np.float32)  # stands, so that step after step has the same contacts
    for _ in range(100):
        env.step(action)
    bare = env.simulator.stepSimulation
    yield "five bare stepSimulation calls", lambda: milliseconds(lambda: [bare() for _ in range(5)], 200)
    yield "step", lambda: milliseconds(lambda: env.step(action), 200)


def update_candidates():
    config, cpu = sac_minitaur.Config(), torch.device("cpu")
    buffer = sac_minitaur.ReplayBuffer(100_000, 35, 8, cpu)
    for tensor in (buffer.observations, buffer.actions, buffer.rewards, buffer.next_observations):
        tensor.normal_()
    buffer.terminated.zero_()
    buffer.size = 100_000

    def new_agent(config):
        spaces = gym.spaces.Box(-1, 1, (28,), np.float32), gym.spaces.Box(-1, 1, (8,), np.float32)
        return sac_minitaur.SACAgent(config, *spaces, 35, cpu)

    def update(agent, num_threads):
        torch.set_num_threads(num_threads)
        return milliseconds(lambda: agent.update(buffer.sample(256), 0), 100)  # 0: of actor and α, too

    normalized, plain = new_agent(config), new_agent(sac_minitaur.Config(critic_batch_norm=False))
    yield "1 thread", lambda: update(normalized, 1)
    yield "1 thread, target critics", lambda: update(plain, 1)  # as in the tutorials, in place of batch normalization
    yield "2 threads", lambda: update(normalized, 2)


def run(*command):
    """What a Python command prints, run in a process of its own."""
    command = [sys.executable, *map(str, command)]
    environment = os.environ | {"PYTHONPATH": str(ROOT / "tests")}  # for the task registered above
    return subprocess.run(command, cwd=ROOT, env=environment, check=True, stdout=subprocess.PIPE, text=True).stdout


def training(evaluations, *flags):
    """Milliseconds an iteration by the run's own clock, from `TRAINING_STEPS` updates to twice as many.

    With `evaluations` there are 2 episodes for every 1 000 iterations, which is the default command's 20 for 10 000.
    """
    with tempfile.TemporaryDirectory() as directory:
        run(
            "sac_minitaur.py", "--env-id", f"benchmark:{UPRIGHT}", "--num-iterations", 2 * TRAINING_STEPS,
            "--initial-collect-steps", 500, "--log-interval", TRAINING_STEPS, "--no-video",
            "--num-envs", 1, "--batch-size", 256, "--actor-update-interval", 1,  # as the peers
            "--eval-interval", 1_000 if evaluations else 1_000_000, "--num-eval-episodes", 2 if evaluations else 1,
            "--run-dir", Path(directory) / "run", *flags,
        )  # fmt: skip
        with open(Path(directory) / "run" / "train.csv") as file:
            start, end = (float(row["seconds"]) for row in csv.DictReader(file))
    return (end - start) / TRAINING_STEPS * 1e3


def peer(code):
    """Runs a peer's job in a process of its own. It prints milliseconds last."""
    start = """
import time, torch, gymnasium as gym
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.monitor import Monitor
torch.set_num_threads(2)
start = time.perf_counter()
"""
    return float(run("-c", start + code).splitlines()[-1])


def peer_training(module, algorithm, evaluations, settings=""):
    """The same of an algorithm of stable_baselines3 or sbx, with the tutorials' sizes."""
    return peer(f"""
from {module} import {algorithm}
env, eval_env = (gym.make("benchmark:{UPRIGHT}") for _ in range(2))
callback = EvalCallback(Monitor(eval_env), n_eval_episodes=2, eval_freq=1000, verbose=0) if {evaluations} else None
model = {algorithm}("MlpPolicy", env, learning_starts=500, batch_size=256, buffer_size=100_000 {settings})
model.learn(600)
start = time.perf_counter()
model.learn({TRAINING_STEPS}, reset_num_timesteps=False, callback=callback)
print((time.perf_counter() - start) / {TRAINING_STEPS} * 1e3)
""")


def installed(module):
    return importlib.util.find_spec(module) is not None


def crossq_candidates(evaluations):
    """Critics with batch normalization and no targets, an actor update at every update, two layers of 256 each."""
    yield "ours, 1 thread (default)", lambda: training(evaluations)
    yield "ours, 2 threads", lambda: training(evaluations, "--num-threads", 2)
    settings = ", policy_delay=1, policy_kwargs={'net_arch': {'pi': [256, 256], 'qf': [256, 256]}}"
    if installed("sbx"):
        yield "SBX CrossQ", lambda: peer_training("sbx", "CrossQ", evaluations, settings)


def sac_candidates(evaluations):
    """Critics with target critics."""
    plain = ("--no-critic-batch-norm",)
    yield "ours, 1 thread", lambda: training(evaluations, *plain)
    yield "ours, 2 threads", lambda: training(evaluations, *plain, "--num-threads", 2)
    for name, module in (("Stable-Baselines3", "stable_baselines3"), ("SBX", "sbx")):
        if installed(module):
            yield name, lambda module=module: peer_training(module, "SAC", evaluations)


def dqn(*flags):
    with tempfile.TemporaryDirectory() as directory:
        command = "dqn_cartpole.py", "--no-video", "--run-dir", Path(directory) / "run", *flags
        return milliseconds(lambda: run(*command), 1)


def peer_dqn(module):
    """The same job: the tutorial's network and sizes, an update at every step, 20 evaluations of 10 episodes."""
    return peer(f"""
from {module} import DQN
callback = EvalCallback(Monitor(gym.make("CartPole-v0")), n_eval_episodes=10, eval_freq=1000, verbose=0)
model = DQN("MlpPolicy", "CartPole-v0", learning_rate=1e-3, buffer_size=100_000, learning_starts=100, batch_size=64,
            train_freq=1, gradient_steps=1, exploration_initial_eps=0.1, exploration_final_eps=0.1,
            policy_kwargs={{"net_arch": [100, 50]}})
model.learn(20_100, callback=callback)
import sys; print("ends at", callback.last_mean_reward, file=sys.stderr)
print((time.perf_counter() - start) * 1e3)
""")


def dqn_candidates():
    yield "20 000 updates", dqn
    yield "1 update", lambda: dqn("--num-iterations", 1)  # so this much is start-up and the files at the end
    for name, module in (("Stable-Baselines3", "stable_baselines3"), ("SBX", "sbx")):
        if installed(module):
            yield name, lambda module=module: peer_dqn(module)


def main():
    machine = f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}, torch"
    print(machine, torch.__version__, file=sys.stderr)
    table = csv.writer(sys.stdout, lineterminator="\n")
    table.writerow(("measured", "candidate", "milliseconds", "ratio"))
    for title, candidates in (
        ("Minitaur, one step", environment_candidates()),
        ("SAC update, batch 256", update_candidates()),
        ("CrossQ's critics, an iteration without evaluations", crossq_candidates(evaluations=False)),
        ("CrossQ's critics, an iteration of the whole job", crossq_candidates(evaluations=True)),
        ("plain SAC, an iteration without evaluations", sac_candidates(evaluations=False)),
        ("plain SAC, an iteration of the whole job", sac_candidates(evaluations=True)),
        ("DQN, the default command but for the videos", dqn_candidates()),
    ):
        result = medians(dict(candidates))
        first = next(iter(result.values()))
        for name, time_ in result.items():
            table.writerow((title, name, f"{time_:.2f}", f"{time_ / first:.2f}"))
        sys.stdout.flush()


if __name__ == "__main__":
    main()
