#!/usr/bin/env bash
# multiprocessing's forkserver: once torch and numpy.random are preloaded, all workers draw the
# same "unseeded" noise.
#
# Who meets it: somebody who starts actors with the forkserver, and preloads torch because the
# workers start slowly. Actors without a seed of their own then all explore in the same way.
#
# The guess: a forkserver worker is a fresh process. An unseeded generator is seeded from the
# system in each of them, so preloading changes the speed and not the numbers.
#
# The behaviour: the global generators of torch and numpy are made when the server imports
# them. Each worker is a copy and starts with the same state. Python's own random module
# is seeded again in each worker, so a look at random.random() does not show the problem.
# Without the preload, all three differ. (Preloading "numpy" alone changes nothing here:
# numpy.random is loaded only when it is first used.)
#
# Seen on 2026-11-28 with Python 3.11.7, torch 2.13.0+cpu, numpy 2.4.6
# (different first numbers among 3 workers):
#   no preload:                    torch 3, numpy 3, random 3
#   preload torch, numpy.random:   torch 1, numpy 1, random 3
set -euo pipefail

work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install -qq --no-compile --disable-pip-version-check torch==2.13.0 numpy==2.4.6

cat > "$work/show.py" <<'PY'
import multiprocessing
import platform
import random
import sys
from importlib.metadata import version


def first_numbers(queue):
    import numpy
    import torch

    queue.put((torch.rand(1).item(), numpy.random.rand(), random.random()))


if __name__ == "__main__":
    preload = sys.argv[1:]
    label = "preload " + ", ".join(preload) + ":" if preload else "no preload:"
    if not preload:
        print("Python", platform.python_version(), "torch", version("torch"), "numpy", version("numpy"))
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(preload)
    queue = context.Queue()
    workers = [context.Process(target=first_numbers, args=(queue,)) for _ in range(3)]
    for worker in workers:
        worker.start()
    rows = [queue.get(timeout=120) for _ in workers]
    for worker in workers:
        worker.join()
    different = [len(set(column)) for column in zip(*rows)]
    print("{:30} torch {}, numpy {}, random {}".format(label, *different))
    assert different == ([1, 1, 3] if preload else [3, 3, 3]), "changed"
PY
"$work/venv/bin/python" "$work/show.py"
"$work/venv/bin/python" "$work/show.py" torch numpy.random
