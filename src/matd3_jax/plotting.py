"""Learning curves."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from matd3_jax.statistics import mean_interval


def learning_curve(path: Path, metrics: Mapping[str, np.ndarray], title: str) -> None:
    """Draw the return of every team over env steps, in training and (where there are any) in evaluations: each seed,
    their mean, and its 95 % interval.

    Args:
        metrics: columns [rows] of the metrics table.
    """
    teams = [name for name in metrics if name.startswith("return_")]
    figure = Figure(figsize=(7, 2.6 + 1.9 * len(teams)), layout="constrained")
    FigureCanvasAgg(figure)
    axes = np.atleast_1d(np.asarray(figure.subplots(len(teams), sharex=True), dtype=object))
    seeds = np.unique(metrics["seed"])
    who = f"mean of {len(seeds)} seeds, 95 % interval" if len(seeds) > 1 else "one seed"
    for axis, team, colour in zip(axes, teams, ("tab:blue", "tab:red"), strict=False):
        evaluated = f"eval_{team}" in metrics
        kinds = [(team, "training (exploring)", "tab:gray" if evaluated else colour)]
        kinds += [(f"eval_{team}", "evaluation (deterministic)", colour)] if evaluated else []
        for name, kind, shade in kinds:
            steps, curves = by_seed(metrics, name)
            curve(axis, steps, curves, shade, f"{kind}, {who}", each=True)
        axis.set_ylabel(f"return\n{team.removeprefix('return_')}")
        axis.legend(loc="lower right", frameon=False)
    axes[-1].set_xlabel("env steps of each seed")
    axes[0].set_title(title)
    figure.savefig(path, dpi=120)


def by_seed(metrics: Mapping[str, np.ndarray], name: str) -> tuple[np.ndarray, np.ndarray]:
    """Env steps [points] and values [seeds, points] of a column where it is not nan for all seeds."""
    seeds = np.unique(metrics["seed"])
    values = np.stack([metrics[name][metrics["seed"] == seed] for seed in seeds])
    there = ~np.isnan(values).all(axis=0)
    return metrics["step"][metrics["seed"] == seeds[0]][there], values[:, there]


def curve(axis, steps: np.ndarray, curves: np.ndarray, colour: str, label: str, each: bool = False) -> None:
    """One line: the mean of curves [seeds, points] with the 95 % interval of the mean; `each`: every seed too, thin."""
    mean, half = mean_interval(curves)
    if each and len(curves) > 1:
        axis.plot(steps, curves.T, color=colour, linewidth=0.5, alpha=0.35)
    if len(curves) > 1:
        axis.fill_between(steps, mean - half, mean + half, color=colour, alpha=0.25, linewidth=0)
    axis.plot(steps, mean, color=colour, label=label if len(curves) > 1 else "one seed")
    axis.spines[["top", "right"]].set_visible(False)
    axis.grid(alpha=0.25)
