"""`python -m experiments.ant`: MATD3 beside MADDPG, IL-TD3 and single-agent TD3 on a robot shared out among agents.

    python -m experiments.ant [env=ant] [algos=[matd3,maddpg,iltd3,td3]] [seeds=6] [train=true]
                              [runs=runs/ENV] [out=experiments/results/ENV] [key=value ...]

Trains each algorithm as a run of its own in the folder `runs`, with the settings that the robot brings and the given
ones on top; a finished run is used as it is and an interrupted one goes on where it was. Then writes into `out`: the
deterministic evaluations of all seeds (curves.csv), a figure of mean and standard deviation as in the paper
(curves.png), a table (table.md), and settings, machine and times of every run (runs.json). `train=false` reports what
the runs have so far.
"""

import csv
import importlib
import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from matd3_jax import checkpoint, command, config
from matd3_jax.errors import UserError
from matd3_jax.runs import RunDirectory
from matd3_jax.statistics import mean_interval

HERE = Path(__file__).parent
NAMES = {"matd3": "MATD3", "maddpg": "MADDPG", "iltd3": "IL-TD3", "td3": "SA-TD3", "iddpg": "IDDPG", "ddpg": "DDPG"}
COLOURS = {  # Okabe and Ito's, told apart by the colour-blind
    "matd3": "#0072B2",
    "maddpg": "#E69F00",
    "iltd3": "#009E73",
    "td3": "#CC79A7",
    "iddpg": "#56B4E9",
    "ddpg": "#D55E00",
}
COLUMNS = {"eval_return_agents": "return", "eval_forward_velocity": "forward velocity (m/s)"}
DEFAULTS: dict[str, Any] = {
    "env": "ant",
    "algos": ["matd3", "maddpg", "iltd3", "td3"],
    "train": True,
    "runs": None,
    "out": None,
}


def main(argv: Sequence[str]) -> int:
    taken, overrides = config.take(argv, tuple(DEFAULTS))
    options = {**DEFAULTS, **taken}
    for algo in options["algos"]:
        if algo not in NAMES:
            raise UserError(f"algos={options['algos']}: {algo!r} is not one of {', '.join(NAMES)}")
    folder = Path(options["runs"] or Path("runs") / options["env"])
    out = Path(options["out"] or HERE / "results" / options["env"])
    if not any(override.startswith("seeds=") for override in overrides):
        overrides = [*overrides, "seeds=6"]
    if options["train"]:
        for algo in options["algos"]:
            code = _train(folder, algo, [f"env={options['env']}", f"algo={algo}", *overrides])
            if code:
                return code
    report(out, {algo: folder / algo for algo in options["algos"] if (folder / algo / "metrics.csv").exists()})
    return 0


def report(out: Path, runs: Mapping[str, Path]) -> None:
    """Data, figure and table of the runs (by algorithm) into `out`."""
    if not runs:
        raise UserError("there is no run to report")
    out.mkdir(parents=True, exist_ok=True)
    tables = {algo: RunDirectory(path).read_metrics() for algo, path in runs.items()}
    settings = {algo: RunDirectory.open(path)[1] for algo, path in runs.items()}
    _write_curves(out / "curves.csv", tables)
    figure = Figure(figsize=(10, 4), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, len(COLUMNS))
    for axis, (column, label) in zip(axes, COLUMNS.items(), strict=True):
        for algo, table in tables.items():
            steps, curves = evaluations(table, column)
            mean, spread = curves.mean(axis=0), curves.std(axis=0, ddof=1) if len(curves) > 1 else 0
            axis.fill_between(steps, mean - spread, mean + spread, color=COLOURS[algo], alpha=0.2, linewidth=0)
            axis.plot(steps, mean, color=COLOURS[algo], label=f"{NAMES[algo]} ({_seeds(curves)})")
        axis.set_xlabel("env steps of each seed")
        axis.set_ylabel(f"evaluation: {label}")
        axis.grid(alpha=0.25)
        axis.spines[["top", "right"]].set_visible(False)
    axes[0].legend(frameon=False, fontsize=8, loc="upper left")
    env = next(iter(settings.values())).env
    if env["name"] in ("ant", "brax_ant"):  # paid 1 for each env step on its feet
        axes[0].axhline(1000, color="grey", linewidth=0.8, linestyle=":")
        label = {"xytext": (-2, 3), "textcoords": "offset points", "ha": "right", "color": "grey", "fontsize": 8}
        axes[0].annotate("standing still", (1, 1000), xycoords=("axes fraction", "data"), **label)
    figure.suptitle(f"{env['name']} ({env.get('physics', env.get('backend'))}, {env['split']}): mean ± sd over seeds")
    figure.savefig(out / "curves.png", dpi=130)

    lines = [
        "| algorithm | seeds | env steps | last return: mean ± sd (95 % interval of the mean) | best | velocity, m/s |",
        "|---|---|---|---|---|---|",
    ]
    for algo, table in tables.items():
        steps, returns = evaluations(table, "eval_return_agents")
        _, velocity = evaluations(table, "eval_forward_velocity")
        final = returns[:, -1]
        mean, half = mean_interval(final)
        interval = f" ± {final.std(ddof=1):.0f} ({mean - half:.0f} to {mean + half:.0f})" if len(final) > 1 else ""
        lines.append(
            f"| {NAMES[algo]} | {len(final)} | {int(steps[-1]):,} | {mean:.0f}{interval} | "
            f"{returns.mean(axis=0).max():.0f} | {velocity[:, -1].mean():.2f} |"
        )
    (out / "table.md").write_text("\n".join(lines) + "\n")
    print("\n".join(lines))
    facts = {}
    for algo, path in runs.items():
        summary = path / "summary.json"
        facts[algo] = {
            "settings": {k: v for k, v in settings[algo].to_dict().items() if k not in ("out", "name")},
            "machine": json.loads((path / "machine.json").read_text()),
            "summary": json.loads(summary.read_text()) if summary.exists() else "not finished",
        }
    (out / "runs.json").write_text(json.dumps(facts, indent=1) + "\n")


def evaluations(table: Mapping[str, np.ndarray], column: str) -> tuple[np.ndarray, np.ndarray]:
    """(env steps [points], values [seeds, points]) of the rows with an evaluation."""
    seeds = np.unique(table["seed"])
    there = ~np.isnan(table["eval_return_agents"])
    steps = table["step"][there & (table["seed"] == seeds[0])]
    return steps, np.stack([table[column][there & (table["seed"] == seed)] for seed in seeds])


def _train(folder: Path, algo: str, overrides: Sequence[str]) -> int:
    """Train, go on with, or leave alone the run of one algorithm; the exit code."""
    train: Any = importlib.import_module("matd3_jax.train")
    path = folder / algo
    if (path / "summary.json").exists():
        return 0
    if checkpoint.steps(path / "checkpoints"):
        return train.main([f"resume={path}"])
    if path.exists():
        raise UserError(f"{path} has no checkpoint to go on from: remove it")
    return train.main([*overrides, f"out={folder}", f"name={algo}"])


def _seeds(curves: np.ndarray) -> str:
    return f"{len(curves)} seeds" if len(curves) > 1 else "one seed"


def _write_curves(path: Path, tables: Mapping[str, Mapping[str, np.ndarray]]) -> None:
    """Every evaluation: one row for each algorithm, seed and evaluation."""
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        names = [n for n in next(iter(tables.values())) if n.startswith("eval_")]
        writer.writerow(("algo", "seed", "step", "updates", *names))
        for algo, table in tables.items():
            for k in np.flatnonzero(~np.isnan(table["eval_return_agents"])):
                head = (algo, *(int(table[name][k]) for name in ("seed", "step", "updates")))
                writer.writerow((*head, *(f"{table[name][k]:.6g}" for name in names)))


if __name__ == "__main__":
    sys.argv[0] = "ant"
    command.run(main)
