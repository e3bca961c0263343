#!/usr/bin/env bash
# multiprocessing's forkserver: set_forkserver_preload quietly does nothing for a module beside
# the main script, when the program is started from another folder.
#
# Who meets it: somebody who preloads a slow module of their own (networks, a robot model) for the
# actor processes, and starts training with "python project/train.py" or from a scheduler.
#
# The guess: what the main script can import, the forkserver can import too. If it can not,
# there is an error or a warning.
#
# The behaviour: the server does not get sys.path of the main program. It looks in the current
# folder instead, and ignores an ImportError. The workers do find the module, so nothing fails,
# but each of them loads it again. Started from the script's folder, it is loaded once. So
# numbers made at import time (here from an unseeded numpy generator) are shared by the workers
# in one folder and not in the other.
#
# Seen on 2026-11-28 with Python 3.11.7 and numpy 2.4.6 (3 workers):
#   started in the project: model was loaded 1 time(s), different numbers: 1
#   started elsewhere:      model was loaded 3 time(s), different numbers: 3
set -euo pipefail

work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install -qq --no-compile --disable-pip-version-check numpy==2.4.6

mkdir "$work/project"
cat > "$work/project/model.py" <<'PY'
import os

import numpy as np

LOADED_BY = os.getpid()
START = np.random.default_rng().random()
PY
cat > "$work/project/train.py" <<'PY'
import multiprocessing
import sys


def act(queue):
    import model

    queue.put((model.LOADED_BY, model.START))


if __name__ == "__main__":
    label, expected = sys.argv[1], int(sys.argv[2])
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["model"])
    queue = context.Queue()
    workers = [context.Process(target=act, args=(queue,)) for _ in range(3)]
    for worker in workers:
        worker.start()
    loaders, starts = zip(*[queue.get(timeout=60) for _ in workers])
    for worker in workers:
        worker.join()
    loads, numbers = len(set(loaders)), len(set(starts))
    print(f"{label:23} model was loaded {loads} time(s), different numbers: {numbers}")
    assert loads == numbers == expected, "changed"
PY
python="$work/venv/bin/python"
"$python" -c 'import platform, numpy; print("Python", platform.python_version(), "numpy", numpy.__version__)'
(cd "$work/project" && "$python" train.py "started in the project:" 1)
(cd "$work" && "$python" project/train.py "started elsewhere:" 3)
