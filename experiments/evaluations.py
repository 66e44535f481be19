"""Deterministic evaluations along training: curves, bands and rows of tables, for the studies of robots."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes

from experiments import figures
from experiments.tidy import Table
from matd3_jax.stats.intervals import mean_interval

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


def draw(axis: Axes, part: Table, column: str, color: str, label: str, style: str = "-") -> None:
    """Mean and standard deviation over the seeds of ONE setting."""
    found = curve(part, column)
    assert found is not None
    steps, curves = found
    mean, spread = curves.mean(axis=0), curves.std(axis=0, ddof=1) if len(curves) > 1 else 0
    axis.fill_between(steps, mean - spread, mean + spread, color=color, alpha=0.2, linewidth=0)
    axis.plot(steps, mean, style, color=color, label=f"{label} ({figures.count(len(curves))})")
    axis.set_xlabel("env steps of each seed")
    axis.set_ylabel(f"evaluation: {COLUMNS[column]}")


HEAD = ("seeds", "env steps", "last return: mean ± sd (95 % interval of the mean)", "best", "velocity, m/s")


def row(part: Table) -> list[str]:
    """Cells under `HEAD` of ONE setting."""
    found = curve(part)
    assert found is not None
    steps, returns = found
    speed, final = curve(part, VELOCITY), returns[:, -1]
    mean, half = mean_interval(final)
    interval = f" ± {final.std(ddof=1):.0f} ({mean - half:.0f} to {mean + half:.0f})" if len(final) > 1 else ""
    return [
        str(len(final)),
        f"{int(steps[-1]):,}",
        f"{mean:.0f}{interval}",
        f"{returns.mean(axis=0).max():.0f}",
        "—" if speed is None else f"{speed[1][:, -1].mean():.2f}",
    ]


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Lines of a Markdown table."""
    return [f"| {' | '.join(cells)} |" for cells in (head, ["---"] * len(head), *rows)]
