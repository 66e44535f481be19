"""`python -m experiments.cooperative_navigation`: does it learn what the original learns?

Trains MATD3 and MADDPG on simple_spread with the paper's settings (10,000 episodes of 25 steps) and compares the
training returns with those of the authors' own program (experiments/reference). Writes the table of both (curves.csv),
a figure (curves.png), a comparison (table.md) and the machine and versions (machine.json) into `out`.
"""

import csv
import dataclasses
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

import matd3_jax
from experiments import markdown
from matd3_jax.cli import command
from matd3_jax.cli.options import Command, option, others
from matd3_jax.figures import style
from matd3_jax.runs.paths import check_directory
from matd3_jax.runtime import devices, files
from matd3_jax.runtime.terminal import say
from matd3_jax.stats.intervals import compare, t_interval
from matd3_jax.stats.text import plus_minus

HERE = Path(__file__).parent
ALGORITHMS = {"matd3": "MATD3", "maddpg": "MADDPG"}
EPISODE = 25
BLOCK = 1000
"""Episodes averaged into one point, as in the authors' tables: a single episode's return varies by about 75."""


@dataclasses.dataclass(frozen=True)
class Options:
    """Options of this comparison."""

    seeds: int = option("trials of each algorithm", default=10, least=1)
    total_steps: int = option("of each trial", default=250_000, unit="env steps", least=1)
    out: Path = option("data, figure and table", default=HERE / "results" / "simple_spread")
    overrides: tuple[str, ...] = others("any other setting of matd3_jax.train")


COMMAND = Command("python -m experiments.cooperative_navigation", Options, __doc__)


def main(argv: Sequence[str]) -> int:
    options = COMMAND.parse(argv)
    out = options.out
    check_directory(out, "out")
    devices.prepare()
    ours, seconds = {}, {}
    for algo in ALGORITHMS:
        begun = time.monotonic()
        result = matd3_jax.train(
            *options.overrides,
            env="simple_spread",
            algo=algo,
            seeds=options.seeds,
            total_steps=options.total_steps,
            log_every=100 * EPISODE,
            callback=lambda row, algo=algo: say(f"{algo} {int(row['step'][0])} {row['return_agents'].mean()}"),
        )
        seconds[algo] = round(time.monotonic() - begun, 1)
        ours[algo] = result.metrics
    out.mkdir(parents=True, exist_ok=True)
    _write_curves(out / "curves.csv", ours)
    facts = {
        "machine": devices.description(),
        "versions": devices.versions(),
        "seconds": seconds,
        "settings": list(argv),
    }
    files.write_json(out / "machine.json", facts)
    report(out)
    return 0


def report(out: Path) -> None:
    """Figure and table from curves.csv in `out` and the authors' curves."""
    ours = {algo: blocks(*_ours(out / "curves.csv", algo)) for algo in ALGORITHMS}
    theirs = {algo: blocks(*_authors(algo)) for algo in ALGORITHMS}
    figure = Figure(figsize=(9.5, 3.8), layout="constrained")
    FigureCanvasAgg(figure)
    whose = (f"{name}: mean (sd, seeds)" for name in ("this project", "authors"))
    head, rows = ("algorithm", "episodes", *whose, "difference (95 %)"), []
    for axis, algo in zip(figure.subplots(1, 2, sharey=True), ALGORITHMS, strict=True):
        episodes, mine = ours[algo]
        axis.plot(theirs[algo][0], theirs[algo][1].T, color="black", linewidth=0.9, alpha=0.6)
        axis.plot([], [], color="black", linewidth=0.9, label=f"authors' program, {len(theirs[algo][1])} seeds, each")
        label = f"this project, {len(mine)} seeds, mean and 95 % interval"
        style.band(axis, episodes, t_interval(mine), style.SERIES[0], label, seeds=mine)
        style.dress(axis)
        axis.set_title(f"Cooperative Navigation: {ALGORITHMS[algo]}")
        axis.set_xlabel(f"episodes (mean over the last {BLOCK:,})")
        axis.legend(loc="lower right", frameon=False, fontsize=8)
        for k, episode in enumerate(episodes):
            if episode not in theirs[algo][0] or (episode // BLOCK) % 2 and episode != BLOCK:
                continue
            other = theirs[algo][1][:, list(theirs[algo][0]).index(episode)]
            other, a = other[~np.isnan(other)], mine[:, k]
            cells = [ALGORITHMS[algo], f"{int(episode):,}"]
            cells += [f"{v.mean():.1f} ({v.std(ddof=1):.1f}, {len(v)})" for v in (a, other)]
            test = compare(a, other)
            cells.append(plus_minus(float(test.difference), float(test.high - test.low) / 2, "+.1f", ".1f"))
            rows.append(cells)
    figure.axes[0].set_ylabel("training return, summed over agents")
    style.save(figure, out / "curves.png", dpi=130)
    lines = markdown.table(head, rows)
    files.write_text(out / "table.md", "\n".join(lines) + "\n")
    say("\n".join(lines))


def blocks(episode: np.ndarray, curves: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Means over blocks of `BLOCK` episodes: (last episode of each block, means [seeds, blocks]).

    Args:
        episode: [rows] last episode of each row; curves: [seeds, rows] mean returns; weights: [rows] episodes in a row.
    """
    ends = np.arange(BLOCK, episode[-1] + 1, BLOCK)
    inside = (episode[None] > ends[:, None] - BLOCK + weights / 2) & (episode[None] <= ends[:, None] + weights / 2)
    share = inside * weights
    return ends, curves @ (share / share.sum(axis=1, keepdims=True)).T


def _ours(path: Path, algo: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    with path.open(newline="", encoding="utf-8") as file:
        rows = [row for row in csv.DictReader(file) if row["algo"] == algo]
    seeds = sorted({int(row["seed"]) for row in rows})
    by_seed = [[row for row in rows if int(row["seed"]) == seed] for seed in seeds]
    episode = np.array([int(row["step"]) / EPISODE for row in by_seed[0]])
    weights = np.array([float(row["episodes"]) for row in by_seed[0]])
    return episode, np.array([[float(row["return"]) for row in rows] for rows in by_seed]), weights


def _authors(algo: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Up to 10,000 episodes, which all four seeds played."""
    with (HERE / "reference" / f"simple_spread_{algo}.csv").open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if int(row["episode"]) <= 10_000]
    seeds = sorted({row["seed"] for row in rows})
    curves = np.array([[float(row["mean_return_sum"]) for row in rows if row["seed"] == seed] for seed in seeds])
    episode = np.array([int(row["episode"]) for row in rows if row["seed"] == seeds[0]])
    return episode, curves, np.full(len(episode), 100.0)


def _write_curves(path: Path, metrics: dict[str, dict[str, np.ndarray]]) -> None:
    rows: list[tuple[object, ...]] = [("algo", "seed", "step", "episodes", "return")]
    for algo, columns in metrics.items():
        for i, k in np.ndindex(columns["step"].shape):
            cells = [columns[name][i, k] for name in ("seed", "step", "episodes")]
            rows.append((algo, *cells, f"{columns['return_agents'][i, k]:.4f}"))
    files.write_csv(path, rows)


if __name__ == "__main__":
    sys.argv[0] = "cooperative_navigation"
    command.run(main, COMMAND)
