#!/usr/bin/env bash
# gym-anytrading: env.reset() seeds the action space with 0. So all random episodes are the same one.
#
# Who meets it: somebody who trains DQN or SAC on its trading tasks, and takes the random actions
# of the warm-up, or of epsilon-greedy exploration, from env.action_space.sample(). Also somebody
# who measures the random policy over many episodes, to have a number to beat.
#
# The guess: reset() begins a new episode, and leaves the stream of the action space alone. Only
# env.action_space.seed(...) seeds that one. Ten random episodes are ten different ones.
#
# The behaviour: each reset() without a seed seeds the action space with int(uniform(0, 1)), and
# that is always 0. The prices always begin at the same place, too. So from the second episode on
# each random episode has the same actions and the same rewards, whatever the two seeds are. The
# warm-up fills the replay buffer with copies of one episode, and the random policy's score has a
# spread of nothing. Draw the actions from a generator of your own.
#
# Seen on 2026-11-29 with Python 3.11.7, gym-anytrading 2.0.0, gymnasium 1.4.0, numpy 2.4.6, ten
# episodes of 100 steps, reset(seed=...) in the first one alone:
#   stocks-v0, seed 7: 2 different episodes of 10, scores [35.15, 17.2, 17.2, 17.2] ...
#   stocks-v0, seed 8: 2 different episodes of 10, scores [40.7, 17.2, 17.2, 17.2] ...
#   second episode, first 20 actions: 1 1 1 0 0 0 0 0 0 1 1 1 1 1 1 1 1 1 1 1
#   the same second episode with seeds 7 and 8: True
#   for comparison CartPole-v1, seed 7: 10 different episodes of 10
set -euo pipefail

work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install -qq --no-compile --disable-pip-version-check \
    gym-anytrading==2.0.0 gymnasium==1.4.0 numpy==2.4.6

cat > "$work/show.py" <<'PY'
import platform
from importlib.metadata import version

import gym_anytrading  # noqa: F401  (registers stocks-v0)
import gymnasium
import numpy as np


def random_episodes(env, seed, number=10, steps=100):
    """Play the random policy. Return each episode's actions, and its sum of rewards."""
    env.action_space.seed(seed + 1000)
    actions, scores = [], []
    for episode in range(number):
        env.reset(seed=seed if episode == 0 else None)
        taken, score = [], 0.0
        for _ in range(steps):
            taken.append(int(env.action_space.sample()))
            _, reward, terminated, truncated, _ = env.step(taken[-1])
            score += float(reward)
            if terminated or truncated:
                break
        actions.append(tuple(taken))
        scores.append(round(score, 2))
    return actions, scores


def trading():
    return gymnasium.make("stocks-v0", window_size=10, frame_bound=(10, 111))


print("Python", platform.python_version(), "gym-anytrading", version("gym-anytrading"), end=" ")
print("gymnasium", gymnasium.__version__, "numpy", np.__version__)
play = {seed: random_episodes(trading(), seed) for seed in (7, 8)}
for seed, (actions, scores) in play.items():
    different = len(set(actions))
    print(f"stocks-v0, seed {seed}: {different} different episodes of 10, scores {scores[:4]} ...")
    assert all(len(taken) == 100 for taken in actions)
second = [play[seed][0][1] for seed in (7, 8)]
print("second episode, first 20 actions:", *second[0][:20])
print("the same second episode with seeds 7 and 8:", second[0] == second[1])
other, _ = random_episodes(gymnasium.make("CartPole-v1"), 7)
print(f"for comparison CartPole-v1, seed 7: {len(set(other))} different episodes of 10")

assert len(set(other)) == 10
for actions, scores in play.values():
    assert len(set(actions[1:])) == 1, "changed: the random episodes differ now"
    assert len(set(scores[1:])) == 1, "changed: the scores differ now"
assert second[0] == second[1], "changed: the seed matters now"
PY
"$work/venv/bin/python" -W ignore "$work/show.py"
