"""The critics' estimates and true values, and how far they overestimate."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from matd3_jax.figures import style
from matd3_jax.runs.metrics import by_seed
from matd3_jax.runs.overestimation import team_values
from matd3_jax.stats.intervals import t_interval


def draw(path: Path, metrics: Mapping[str, np.ndarray], teams: Mapping[str, Sequence[str]], title: str) -> None:
    """One column for each team: above, its agents' mean estimated and true values over env steps, each the mean over
    seeds with its 95 % interval; below, their overestimation, each agent's and the mean with its interval.

    Args:
        metrics: columns [rows] of the metrics table.
        teams: names of each team's agents.
    """
    figure = Figure(figsize=(1.5 + 5.5 * len(teams), 6.5), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(2, len(teams), sharex=True, squeeze=False)
    seeds = len(np.unique(metrics["seed"]))
    who = f"mean of {seeds} seeds, 95 % interval" if seeds > 1 else "one seed"
    for (values, bias), (team, agents) in zip(axes.T, teams.items(), strict=True):
        steps, truth = team_values(metrics, agents, "q_true")
        estimate, over = (team_values(metrics, agents, name)[1] for name in ("q_estimate", "overestimation"))
        _line(values, steps, estimate, style.BLUE, "estimate of the critics")
        _line(values, steps, truth, style.VERMILION, "true value of the policies", "dashed")
        for k, agent in enumerate(agents if len(agents) > 1 else ()):
            each = by_seed(metrics, f"{agent}_overestimation")[1].mean(axis=0)
            color = style.SERIES[(k + 2) % len(style.SERIES)]
            bias.plot(steps, each, color=color, linewidth=1, label=agent, zorder=3)
        _line(bias, steps, over, style.BLACK, f"mean of the {len(agents)} agents" if len(agents) > 1 else agents[0])
        bias.axhline(0, color="gray", linewidth=0.8)
        values.set_title(team if len(teams) > 1 else "")
        values.set_ylabel("discounted return" + (f", mean of {len(agents)} agents" if len(agents) > 1 else ""))
        bias.set_ylabel("overestimation (estimate - truth)")
        bias.set_xlabel("env steps of each seed")
        for axis in (values, bias):
            axis.legend(frameon=False)
    figure.suptitle(f"{title}; {who}")
    style.save(figure, path, dpi=120)


def _line(axis, steps: np.ndarray, curves: np.ndarray, color: style.Color, label: str, dashes: str = "solid") -> None:
    style.band(axis, steps, t_interval(curves), style.web(color), label, dashes, width=1.8)
    style.dress(axis)
