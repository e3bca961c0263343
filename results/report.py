"""Prints README's tables and draws its figures from the CSVs beside this file: `python results/report.py`.

`results/<experiment>/seed<k>/` holds the CSVs of one run. `tutorials.csv` holds what the TF-Agents tutorials print.
"""

import csv
import math
from pathlib import Path
from statistics import median

from matplotlib.figure import Figure

RESULTS = Path(__file__).resolve().parent
# Directory of our runs, and name of the figure → title, the task's threshold, the tutorials' random steps and runs.
FIGURES = {
    "sac_minitaur": (
        "SAC on the Minitaur",
        15.0,
        10_000,
        ("sac_minitaur_2018", "sac_minitaur_2021", "sac_minitaur_2023"),
    ),
    "dqn_cartpole": (
        "DQN on CartPole-v0",
        195.0,
        100,
        ("dqn_cartpole_2021", "dqn_cartpole_2023"),
    ),
}


def read(path):
    with open(path) as file:
        return [{key: float(value) for key, value in row.items()} for row in csv.DictReader(file)]


def runs(experiment):
    """The evaluations of an experiment: seed → rows of its `eval.csv`, by rising seeds."""
    paths = (RESULTS / experiment).glob("seed*/eval.csv")
    return dict(sorted((int(path.parent.name.removeprefix("seed")), read(path)) for path in paths))


def returns_by_step(rows, step="step"):
    return {row[step]: row["average_return"] for row in rows}


def tutorials():
    """The tutorials' evaluations: run → (steps, returns)."""
    curves = {}
    with open(RESULTS / "tutorials.csv") as file:
        for row in csv.DictReader(file):
            steps, returns = curves.setdefault(row["run"], ([], []))
            steps.append(int(row["step"]))
            returns.append(float(row["average_return"]))
    return curves


def number(value, digits=2):
    return f"{value:.{digits}f}" if math.isfinite(value) else "–"


def with_spread(row):
    return f"{row['average_return']:.2f} ± {row['std_return']:.2f}"


def print_table(experiment, goal, late):
    """One row for each seed: `goal` is the return to reach, `late` the step from which the worst evaluation counts."""
    columns = f"at 10000 | at 20000 | final return | episode length | best | worst from {late} on | first ≥ {goal}"
    print(f"\n### {experiment}\n\n| seed | {columns} |\n|{' --- |' * 8}")
    summary = []
    for seed, rows in runs(experiment).items():
        at = returns_by_step(rows)
        early, later = (at.get(step, math.nan) for step in (10_000, 20_000))
        final, length = rows[-1]["average_return"], rows[-1]["average_episode_length"]
        best = max(at.values())
        worst = min((value for step, value in at.items() if step >= late), default=math.nan)
        # Step 0 does not count: an untrained network may balance by luck.
        first = next((step for step, value in at.items() if step > 0 and value >= goal), math.inf)
        summary.append((early, later, final, length, best, worst, first))
        print(f"| {seed} | {number(early)} | {number(later)} | {with_spread(rows[-1])} | {length:.0f}", end="")
        print(f" | {best:.2f} | {number(worst)} | {number(first, 0)} |")
    medians = (number(median(column), digits) for column, digits in zip(zip(*summary), (2, 2, 2, 0, 2, 2, 0)))
    print(f"| median | {' | '.join(medians)} |")


def print_sac_ablation():
    """The returns at 10 000 updates of seeds 410 to 412, for the default and for the runs without a choice."""
    print("\n### sac_minitaur, without one choice\n\n| without | median at 10000 | each seed |\n| --- | --- | --- |")
    names = sorted(path.name for path in (RESULTS / "sac_minitaur_without").glob("*"))
    for name in ("sac_minitaur", *(f"sac_minitaur_without/{name}" for name in names)):
        at = [returns_by_step(rows)[10_000] for seed, rows in runs(name).items() if seed in (410, 411, 412)]
        print(f"| {name.rpartition('/')[2]} | {median(at):.1f} | {', '.join(number(value, 1) for value in at)} |")


def print_dqn_ablation(base):
    """How many seeds of `base` and of the runs without a choice reach 200 early, and stay there from 10 000 on."""
    columns = "without | seeds | 200 by 5000 | median first 200 | stay ≥ 195 | worst"
    print(f"\n### {base}, without one choice\n\n| {columns} |")
    print(f"|{' --- |' * 6}")
    names = sorted(path.name for path in RESULTS.glob(f"{base}_without_*"))
    for name in (base, *names, f"{base}_tutorial"):
        curves = [returns_by_step(rows) for rows in runs(name).values()]
        first = [next((s for s, value in at.items() if s > 0 and value >= 200), math.inf) for at in curves]
        worst = [min(value for s, value in at.items() if s >= 10_000) for at in curves]
        label = name.removeprefix(base).removeprefix("_without_").removeprefix("_") or "nothing"
        early, stay = sum(s <= 5_000 for s in first), sum(value >= 195 for value in worst)
        print(f"| {label} | {len(curves)} | {early} | {number(median(first), 0)} | {stay} | {min(worst):.1f} |")


def draw(name, title, threshold, random_steps, published):
    figure = Figure(figsize=(7, 4.5), layout="constrained")
    axes = figure.subplots()
    at = [returns_by_step(rows, "env_steps") for rows in runs(name).values()]
    for returns in at:
        axes.plot(list(returns), list(returns.values()), color="C0", linewidth=0.7, alpha=0.6)
    steps = sorted(set.intersection(*map(set, at)))
    middle = [median(returns[step] for returns in at) for step in steps]
    axes.plot(steps, middle, color="C0", linewidth=2.5, label=f"ours, median of {len(at)} seeds (each thin)")
    tutorial_curves = tutorials()
    for run, style in zip(published, ("-", ":", "-.")):
        label = f"tutorial, {run.rpartition('_')[2]}"
        steps, returns = tutorial_curves[run]  # an environment step for each update
        steps = [random_steps + step for step in steps]
        axes.plot(steps, returns, color="C1", linestyle=style, linewidth=1, label=label)
    axes.axhline(threshold, color="green", linestyle="--", linewidth=1, label="the task's threshold")
    axes.set(title=title, xlabel="environment steps", ylabel="average return")
    axes.ticklabel_format(style="plain")
    figure.legend(loc="outside lower center", ncols=2, fontsize="small")
    figure.savefig(RESULTS / f"{name}.png", dpi=110)


def main():
    for name in sorted({path.parents[1].relative_to(RESULTS).as_posix() for path in RESULTS.glob("**/eval.csv")}):
        if name in ("dqn_cartpole", "dqn_cartpole_v1"):
            print_table(name, goal=475 if "_v1" in name else 200, late=10_000)
        elif "pendulum" in name:
            print_table(name, goal=-200, late=5_000)
        elif "_without_" in name:
            continue
        elif "hopper" in name or "halfcheetah" in name:
            print_table(name, goal=3_000, late=50_000)
        elif "sac" in name:
            print_table(name, goal=15, late=50_000)
    print_sac_ablation()
    print_dqn_ablation("dqn_cartpole")
    for name, figure in FIGURES.items():
        draw(name, *figure)


if __name__ == "__main__":
    main()
