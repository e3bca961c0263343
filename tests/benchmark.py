"""Times this checkout and another one in turn, so that a drift of the machine's speed touches both alike.

    git worktree add /tmp/other COMMIT
    python tests/benchmark.py /tmp/other | tee speed.csv            # 15 minutes
    python tests/benchmark.py /tmp/other 400 401 | tee until_25.csv  # for these seeds, how long until the robot runs

Nothing else should run on the machine. Quote the ratios rather than the seconds.
"""

import csv
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
REPEATS = 3
RUNS = 25  # the return of a Minitaur that runs


def start(checkout, script, run_dir, *flags):
    command = [sys.executable, f"{script}.py", "--no-video", "--run-dir", run_dir, *flags]
    silent = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    return subprocess.Popen(list(map(str, command)), cwd=checkout, **silent)


def rows(path):
    """The rows of a CSV as dicts of numbers; none before the file is there."""
    if not path.exists():
        return []
    with open(path) as file:
        return [{name: float(value) for name, value in row.items()} for row in csv.DictReader(file)]


def whole_command(checkout, run_dir, script, *flags):
    """Seconds of a command from its start to its end."""
    begin = time.perf_counter()
    if start(checkout, script, run_dir, *flags).wait():
        sys.exit(f"{script}.py {flags} failed in {checkout}")
    return time.perf_counter() - begin


def thousand_updates(checkout, run_dir):
    """Seconds of SAC's updates 1 000 to 2 000 on the Minitaur, its environments included."""
    flags = ("--num-iterations", 2_000, "--log-interval", 1_000, "--num-eval-episodes", 1)
    whole_command(checkout, run_dir, "sac_minitaur", *flags)
    first, second = rows(run_dir / "train.csv")
    return second["seconds"] - first["seconds"]


def until_it_runs(checkout, run_dir, seed):
    """Seconds until SAC's first evaluation of a return of 25, without the evaluations' own time."""
    flags = ("--seed", seed, "--eval-interval", 2_500, "--log-interval", 2_500, "--num-eval-episodes", 10)
    begin = time.perf_counter()
    process = start(checkout, "sac_minitaur", run_dir, *flags)
    evaluations = []
    while not evaluations or evaluations[-1]["average_return"] < RUNS:
        if process.poll() is not None:
            sys.exit(f"seed {seed} never reached {RUNS} in {checkout}")
        time.sleep(0.2)
        evaluations = rows(run_dir / "eval.csv")
    seconds = time.perf_counter() - begin
    process.send_signal(signal.SIGTERM)
    process.wait()
    trained = {row["step"]: row["seconds"] for row in rows(run_dir / "train.csv")}
    evaluating = [row["seconds"] - trained[row["step"]] for row in evaluations if row["step"] in trained]
    return seconds - sum(evaluating)


def main():
    other, *seeds = sys.argv[1:]
    measures = {f"SAC until a return of {RUNS}, seed {seed}": (until_it_runs, seed) for seed in seeds}
    if not seeds:
        for repeat in range(REPEATS):
            measures[f"DQN, the default command {repeat}"] = (whole_command, "dqn_cartpole")
            measures[f"DQN, one update {repeat}"] = (whole_command, "dqn_cartpole", "--num-iterations", 1)
            measures[f"SAC, 1 000 updates {repeat}"] = (thousand_updates,)
    table = csv.writer(sys.stdout, lineterminator="\n")
    table.writerow(("measured", "this, seconds", "other, seconds", "ratio"))
    for name, (measure, *arguments) in measures.items():
        seconds = []
        for checkout in (ROOT, Path(other)):
            with tempfile.TemporaryDirectory() as directory:
                seconds.append(measure(checkout, Path(directory) / "run", *arguments))
        this, that = seconds
        table.writerow((name, f"{this:.1f}", f"{that:.1f}", f"{this / that:.2f}"))
        sys.stdout.flush()


if __name__ == "__main__":
    main()
