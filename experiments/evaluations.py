"""Deterministic evaluations along training: curves, bands and rows of tables, for the studies of robots."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import EngFormatter

from experiments import figures, markdown
from experiments.tidy import Table
from matd3_jax.figures import style
from matd3_jax.stats.intervals import Estimate, t_interval
from matd3_jax.stats.text import NOTHING, ends, plus_minus, seeds

RETURN, VELOCITY = "eval_return_agents", "eval_forward_velocity"
COLUMNS = {RETURN: "return", VELOCITY: "forward velocity (m/s)"}


def curve(part: Table, column: str = RETURN) -> tuple[np.ndarray, np.ndarray] | None:
    """(env steps [points], values [seeds, points]) of the evaluations of ONE setting; None without any."""
    return (part.by_seed("step")[0], part.by_seed(column)) if len(part) and column in part else None


def late(part: Table, share: float = 1 / 3, column: str = RETURN) -> np.ndarray | None:
    """Mean [seeds] over the evaluations in the last `share` of the training."""
    found = curve(part, column)
    if found is None:
        return None
    steps, values = found
    return values[:, steps > (1 - share) * steps[-1]].mean(axis=1)


def draw(axis: Axes, part: Table, column: str, color: str, label: str, dashes: str = "solid") -> None:
    """Mean and standard deviation over the seeds of ONE setting."""
    found = curve(part, column)
    assert found is not None
    steps, curves = found
    mean = curves.mean(axis=0)
    deviation = curves.std(axis=0, ddof=1) if len(curves) > 1 else np.full_like(mean, np.nan)
    estimate = Estimate(mean, mean - deviation, mean + deviation)
    style.band(axis, steps, estimate, color, f"{label} ({seeds(len(curves))})", dashes)
    axis.set_xlabel("env steps of each seed")
    axis.xaxis.set_major_formatter(EngFormatter(sep=""))
    axis.set_ylabel(f"evaluation: {COLUMNS[column]}")


HEAD = ("seeds", "env steps", "last return: mean ± sd (95 % interval of the mean)", "best", "velocity, m/s")


def row(part: Table) -> list[str]:
    """Cells under `HEAD` of ONE setting."""
    found = curve(part)
    assert found is not None
    steps, returns = found
    speed, final = curve(part, VELOCITY), returns[:, -1]
    mean, low, high = t_interval(final)
    last = plus_minus(mean, None, ".0f")
    if len(final) > 1:
        last = f"{plus_minus(mean, final.std(ddof=1), '.0f', '.0f')} ({ends(low, high, '.0f')})"
    return [
        str(len(final)),
        f"{int(steps[-1]):,}",
        last,
        f"{returns.mean(axis=0).max():.0f}",
        NOTHING if speed is None else f"{speed[1][:, -1].mean():.2f}",
    ]


# ---- of several settings by name, in one task ------------------------------------------------------------------------


def draw_each(parts: Mapping[str, Table], title: str, path: Path) -> None:
    """Write the figure of the curves of all settings that have been run."""
    figure, (axis,) = figures.canvas(1, width=6.4, height=4.2)
    for k, (name, part) in enumerate(parts.items()):
        if late(part) is not None:
            draw(axis, part, RETURN, style.SERIES[k], name)
    axis.set_title(title)
    axis.legend(frameon=False, loc="best")
    figures.save(figure, path)


def details_of_each(what: str, quantity: str, parts: Mapping[str, Table]) -> list[str]:
    """The table of all settings that have been run: `quantity`, and the last returns."""
    found = {name: part for name, part in parts.items() if late(part) is not None}
    rows = [[name, figures.interval(late(part)), *row(part)[:-1]] for name, part in found.items()]
    return markdown.table((what, quantity, *HEAD[:-1]), rows)
