"""How soon the Minitaur runs, in this checkout and another one in turn: a drift of the machine's speed touches both.

    git worktree add /tmp/other COMMIT
    python results/time_to_25.py /tmp/other 400 401 402 | tee until_25.csv  # for these seeds, ten minutes each

Nothing else should run on the machine. Quote the ratios rather than the seconds.
"""

import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from report import read

ROOT = Path(__file__).resolve().parent.parent
RUNS = 25  # the return of a Minitaur that runs
FLAGS = "--no-video --eval-interval 2500 --log-interval 2500 --num-eval-episodes 10".split()


def until_it_runs(checkout, run_dir, seed):
    """Seconds until the first evaluation of a return of 25, without the evaluations' own time."""
    command = [sys.executable, "sac_minitaur.py", "--seed", seed, "--run-dir", str(run_dir), *FLAGS]
    begin = time.perf_counter()
    process = subprocess.Popen(command, cwd=checkout, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    evaluations = []
    while not evaluations or evaluations[-1]["average_return"] < RUNS:
        if process.poll() is not None:
            sys.exit(f"seed {seed} never reached {RUNS} in {checkout}")
        time.sleep(0.2)
        if (run_dir / "eval.csv").exists():
            evaluations = read(run_dir / "eval.csv")
    seconds = time.perf_counter() - begin
    process.send_signal(signal.SIGTERM)
    process.wait()
    trained = {row["step"]: row["seconds"] for row in read(run_dir / "train.csv")}
    evaluating = [row["seconds"] - trained[row["step"]] for row in evaluations if row["step"] in trained]
    return seconds - sum(evaluating)


def main():
    other, *seeds = sys.argv[1:]
    print("seed,this (seconds),other (seconds),ratio")
    for seed in seeds:
        seconds = []
        for checkout in (ROOT, Path(other)):
            with tempfile.TemporaryDirectory() as directory:
                seconds.append(until_it_runs(checkout, Path(directory) / "run", seed))
        this, that = seconds
        print(f"{seed},{this:.1f},{that:.1f},{this / that:.2f}", flush=True)


if __name__ == "__main__":
    main()
