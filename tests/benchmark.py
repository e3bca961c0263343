"""Measures speed: environment step, update, training, the whole job and DQN, in turn, and prints medians and ratios.

    python tests/benchmark.py                  # 12 minutes, 18 with both peers; nothing else should run on the machine
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

import common  # noqa: E402
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
    buffer = sac_minitaur.ReplayBuffer(100_000, 35, 8, config.n_step, config.gamma, config.num_envs, cpu)
    buffer.rows.normal_()
    buffer.rows[:, 35 + 8 + 1] = config.gamma**config.n_step  # nothing terminates
    buffer.size = 100_000

    def new_agent(config):
        spaces = gym.spaces.Box(-1, 1, (28,), np.float32), gym.spaces.Box(-1, 1, (8,), np.float32)
        return sac_minitaur.SACAgent(config, *spaces, cpu, common.Ranks(), state_size=35)

    def update(agent, num_threads):
        torch.set_num_threads(num_threads)
        return milliseconds(lambda: agent.update(buffer.sample(256)), 100)

    normalized, plain = new_agent(config), new_agent(sac_minitaur.Config(critic_batch_norm=False))
    yield "1 thread", lambda: update(normalized, 1)
    yield "1 thread, target critics", lambda: update(plain, 1)  # as in the tutorials, in place of batch normalization
    yield "2 threads", lambda: update(normalized, 2)


def run(*command):
    """What a Python command prints, run in a process of its own."""
    command = [sys.executable, *map(str, command)]
    environment = os.environ | {"PYTHONPATH": str(ROOT / "tests")}  # for the task registered above
    return subprocess.run(command, cwd=ROOT, env=environment, check=True, capture_output=True, text=True).stdout


def training(evaluations, *flags):
    """Milliseconds an iteration by the run's own clock, from `TRAINING_STEPS` updates to twice as many.

    By then the evaluations before the first update are over. With `evaluations` there are 2 episodes for every 1 000
    iterations, which is the default command's 20 for 10 000: all that start in this time end in it.
    """
    with tempfile.TemporaryDirectory() as directory:
        run(
            "sac_minitaur.py", "--env-id", f"benchmark:{UPRIGHT}", "--num-iterations", 2 * TRAINING_STEPS,
            "--initial-collect-steps", 500, "--log-interval", TRAINING_STEPS, "--no-video",
            "--eval-interval", 1_000 if evaluations else 1_000_000, "--num-eval-episodes", 2 if evaluations else 1,
            "--run-dir", Path(directory) / "run", *flags,
        )  # fmt: skip
        with open(Path(directory) / "run" / "train.csv") as file:
            start, end = (float(row["seconds"]) for row in csv.DictReader(file))
    return (end - start) / TRAINING_STEPS * 1e3


def peer_training(module, evaluations):
    """The same of `SAC` of stable_baselines3 or sbx, with the tutorials' sizes, in a process of its own."""
    code = f"""
import time, torch, gymnasium as gym
from {module} import SAC
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.monitor import Monitor
torch.set_num_threads(2)
env, eval_env = (gym.make("benchmark:{UPRIGHT}") for _ in range(2))
callback = EvalCallback(Monitor(eval_env), n_eval_episodes=2, eval_freq=1000, verbose=0) if {evaluations} else None
model = SAC("MlpPolicy", env, learning_starts=500, batch_size=256, buffer_size=100_000)
model.learn(600)
start = time.perf_counter()
model.learn({TRAINING_STEPS}, reset_num_timesteps=False, callback=callback)
print((time.perf_counter() - start) / {TRAINING_STEPS} * 1e3)
"""
    return float(run("-c", code).splitlines()[-1])


def training_candidates(evaluations):
    """Ours on one and two threads, ours with target critics, and the peers that are installed, which have these too."""
    yield "ours, 1 thread", lambda: training(evaluations)
    yield "ours, 1 thread, target critics", lambda: training(evaluations, "--no-critic-batch-norm")
    yield "ours, 2 threads", lambda: training(evaluations, "--num-threads", 2)
    for name, module in (("Stable-Baselines3", "stable_baselines3"), ("SBX", "sbx")):
        if importlib.util.find_spec(module):
            yield f"{name}, 2 threads", lambda module=module: peer_training(module, evaluations)


def dqn(*flags):
    with tempfile.TemporaryDirectory() as directory:
        command = "dqn_cartpole.py", "--no-video", "--run-dir", Path(directory) / "run", *flags
        return milliseconds(lambda: run(*command), 1)


def dqn_candidates():
    yield "20 000 updates", dqn
    yield "1 update", lambda: dqn("--num-iterations", 1)  # so this much is start-up


def main():
    common.keep_freed_memory()
    print(f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}, torch {torch.__version__}")
    for title, candidates in (
        ("Minitaur, one step", environment_candidates()),
        ("SAC update, batch 256", update_candidates()),
        ("SAC training, an iteration without evaluations", training_candidates(evaluations=False)),
        ("SAC, an iteration of the whole job", training_candidates(evaluations=True)),
        ("DQN, the default command but for the videos", dqn_candidates()),
    ):
        result = medians(dict(candidates))
        print(f"\n{title}")
        first = next(iter(result.values()))
        for name, time_ in result.items():
            print(f"  {name:32} {time_:10.2f} ms  × {time_ / first:.2f}", flush=True)


if __name__ == "__main__":
    main()
