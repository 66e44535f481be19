"""How the figures and tables of the studies look: names and colors of the algorithms, bands, bars, tables."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from experiments import markdown, tidy
from experiments.tidy import Table
from matd3_jax.figures import style
from matd3_jax.figures.style import web
from matd3_jax.stats.intervals import mean_interval, t_interval
from matd3_jax.stats.text import NOTHING, ends, number, seeds

NAMES = {"matd3": "MATD3", "maddpg": "MADDPG", "iltd3": "IL-TD3", "td3": "SA-TD3", "iddpg": "IDDPG", "ddpg": "DDPG"}
COLORS = {
    "matd3": web(style.BLUE),
    "maddpg": web(style.ORANGE),
    "iltd3": web(style.GREEN),
    "td3": web(style.PURPLE),
    "iddpg": web(style.SKY_BLUE),
    "ddpg": web(style.VERMILION),
}

TASKS = {
    "simple_spread": "Cooperative Navigation",
    "simple_speaker_listener": "Cooperative Communication",
    "simple_crypto": "Covert Communication",
    "simple_push": "Keep-away",
    "simple_adversary": "Physical Deception",
    "simple_tag": "Predator-Prey",
}
"""The paper's names."""


def task(env: str) -> str:
    """The paper's name of an environment, where it has one."""
    return TASKS.get(env, env)


def canvas(
    panels: int, columns: int | None = None, width: float = 4.4, height: float = 3.5
) -> tuple[Figure, list[Axes]]:
    """A figure of panels side by side, or in rows of `columns`, without its spare frames."""
    columns = columns or panels
    rows = -(-panels // columns)
    figure = Figure(figsize=(width * columns, height * rows), layout="constrained")
    FigureCanvasAgg(figure)
    axes: list[Axes] = []
    for k in range(panels):
        axis = figure.add_subplot(rows, columns, k + 1)
        style.dress(axis)
        axes.append(axis)
    return figure, axes


def band(axis: Axes, x: np.ndarray, curves: np.ndarray, color: str, label: str, dashes: str = "solid") -> None:
    """Draw the mean of curves [seeds, points] with its 95 % interval, the number of seeds in the legend."""
    style.band(axis, x, t_interval(curves), color, f"{label} ({seeds(len(curves))})", dashes)


def bar(axis: Axes, position: float, values: np.ndarray, color: str, width: float = 0.8) -> None:
    """Mean of values [seeds] with its 95 % interval, and each of them as a dot."""
    mean, half = mean_interval(values)
    axis.bar(position, mean, width, color=color, alpha=0.75, zorder=2)
    if len(values) > 1:
        axis.errorbar(position, mean, half, color="black", capsize=3, linewidth=1.2, zorder=4)
    across = position + np.linspace(-0.25, 0.25, len(values)) * width if len(values) > 1 else [position]
    axis.plot(across, values, ".", color="black", markersize=3, alpha=0.45, zorder=3)


def point(axis: Axes, row: float, values: np.ndarray, color: str, offset: float = 0.0) -> None:
    """Draw the mean of values [seeds] along x with its 95 % interval, and each of them as a dot `offset` above."""
    mean, half = mean_interval(values)
    axis.errorbar(mean, row, xerr=half if len(values) > 1 else 0.0, fmt="o", color=color, capsize=3)
    axis.plot(values, np.full(len(values), row + offset), ".", color="black", markersize=3, alpha=0.5)


def cross(axis: Axes, x: np.ndarray, y: np.ndarray, color: str, marker: str, label: str) -> None:
    """Draw the means of two quantities [seeds] against each other with their 95 % intervals; label: in the legend."""
    (across, width), (up, height) = (mean_interval(values) for values in (x, y))
    bars = {"xerr": width, "yerr": height} if len(x) > 1 else {}
    axis.errorbar(across, up, fmt=marker, color=color, capsize=2, linewidth=1, label=label, **bars)


def legend_above(axis: Axes, columns: int = 2) -> None:
    """Draw the legend over the panel, and the title over that: neither lies on what is drawn, nor looks like it."""
    entries = len(axis.get_legend_handles_labels()[1])
    if entries:
        frame = {"loc": "lower center", "bbox_to_anchor": (0.5, 1.0), "frameon": False, "columnspacing": 1.2}
        axis.legend(ncols=columns, fontsize="small", handlelength=1.8, **frame)
    axis.set_title(axis.get_title(), pad=8 + 14 * -(-entries // columns))


def save(figure: Figure, path: Path) -> None:
    style.save(figure, path, dpi=130)


def learning(axis: Axes, table: Table, name: str, color: str, label: str) -> None:
    """The mean return of the last episodes along training of ONE setting, a band over episodes in thousands."""
    episodes, means = tidy.trailing(table, name)
    band(axis, episodes / 1000, means, color, label)
    axis.set_xlabel("episodes (thousands)")


def finals_table(table: Table, keys: Sequence[str], columns: Mapping[str, str]) -> list[str]:
    """A Markdown table: for each setting seeds, env steps, and mean final returns with their 95 % intervals.

    columns: headings, and the columns that they stand for; one that a setting lacks is left open.
    """
    head = (*keys, "seeds", "env steps", *(f"{heading} (95 % interval)" for heading in columns), "sd over seeds")
    rows = []
    for values in dict.fromkeys(zip(*(table[key].tolist() for key in keys), strict=True)):
        part = table.where(**dict(zip(keys, values, strict=True)))
        cells = [NAMES.get(value, value) if isinstance(value, str) else f"{value:g}" for value in values]
        cells += [str(len(part.values("seed"))), f"{part.by_seed('step')[0, -1]:,.0f}"]
        finals = [tidy.final(part, name) for name in columns.values()]
        cells += [interval(final) for final in finals]
        spreads = [NOTHING if f is None or len(f) < 2 or np.isnan(f).any() else f"{f.std(ddof=1):.3g}" for f in finals]
        rows.append([*cells, ", ".join(spreads)])
    return markdown.table(head, rows)


def interval(values: np.ndarray | None) -> str:
    """Mean of values [seeds] and its 95 % interval in words."""
    if values is None or np.isnan(values).all():
        return NOTHING
    if np.isnan(values).any():
        return f"{np.isnan(values).sum()} of {len(values)} seeds diverged"
    mean, low, high = t_interval(values)
    return f"{number(float(mean))} ({ends(float(low), float(high)) if len(values) > 1 else seeds(1)})"
