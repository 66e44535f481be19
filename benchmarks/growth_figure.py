"""Time and memory over each axis of `benchmarks.growth`, in one picture."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, NullLocator

from matd3_jax.figures import style
from matd3_jax.figures.style import BLUE, GREEN, ORANGE, VERMILION, Color, web
from matd3_jax.stats.intervals import Estimate

LABELS = {"seeds": "seeds", "agents": "agents", "replay": "transitions in each replay", "batch": "minibatch"}
ORDERS = {"agents": (2, 3)}
"""Powers drawn for the eye; elsewhere the first."""
MEMORY = {
    "process": (VERMILION, "process at most"),
    "xla": (BLUE, "the interval's, by XLA"),
    "replay": (ORANGE, "of it the replay"),
}
GUIDES = {1: ("linear", (0, (5, 1.5))), 2: ("quadratic", (0, (5, 1.5, 1, 1.5))), 3: ("cubic", (0, (1, 1)))}
"""Names and dashes of powers."""


def draw(path: Path, axes: Mapping[str, Sequence[Mapping[str, Any]]]) -> None:
    """One column an axis: above, the time of an iteration, below, memory; both scales logarithmic.

    Args:
        axes: {axis: points} as `benchmarks.growth` reports them; points with an "error" are left out.
    """
    columns = {name: there for name, points in axes.items() if (there := [p for p in points if "error" not in p])}
    if not columns:
        return
    with matplotlib.rc_context(style.PRINTED):
        figure = Figure(figsize=(2.6 * len(columns) + 0.6, 5.2), layout="constrained")
        FigureCanvasAgg(figure)
        grid = figure.subplots(2, len(columns), squeeze=False, sharex="col", sharey="row")
        for (top, bottom), (name, points) in zip(grid.T, columns.items(), strict=True):
            x = np.array([point["value"] for point in points], float)
            times = 1000 * np.array([[p["cycle_seconds"], p["fastest"], p["slowest"]] for p in points])
            style.band(top, x, Estimate(*times.T), web(BLUE), width=1.4)
            flops = np.array([point["product_flops_of_a_cycle"] for point in points])
            expected = times[0, 0] * flops / flops[0]
            top.plot(x, expected, color=web(GREEN), linestyle=(0, (1, 1)), label="as the products")
            _line(top, x, times[:, 0], BLUE, "measured")
            for key, (color, label) in MEMORY.items():
                _line(bottom, x, np.array([point["memory"][key] / 1e6 for point in points]), color, label)
            memory = np.array([point["memory"]["xla"] / 1e6 for point in points])
            _guides(top, x, times[0, 0], ORDERS.get(name, (1,)))
            _guides(bottom, x, memory[0], ORDERS.get(name, (1,)))
            bottom.set_xlabel(LABELS[name])
        grid[0, 0].set_ylabel("ms an iteration, all seeds")
        grid[1, 0].set_ylabel("MB")
        _limits(grid[0], [[p["cycle_seconds"] * 1000] for points in columns.values() for p in points])
        _limits(grid[1], [[p["memory"][key] / 1e6 for key in MEMORY] for points in columns.values() for p in points])
        for row in grid:
            known = {
                label: handle for axis in row for handle, label in zip(*axis.get_legend_handles_labels(), strict=True)
            }
            guides = [name for name, _ in GUIDES.values()]
            order = sorted(known, key=lambda label: guides.index(label) if label in guides else -1)
            frame = {"loc": "center left", "bbox_to_anchor": (1, 0.5), "frameon": False, "handlelength": 2.5}
            row[-1].legend([known[label] for label in order], order, **frame)
        style.save(figure, path, dpi=200)


def _line(axis: Axes, x: np.ndarray, y: np.ndarray, color: Color, label: str) -> None:
    axis.loglog(x, y, color=web(color), linewidth=1.4, marker="o", markersize=3, label=label)
    axis.xaxis.set_minor_locator(NullLocator())
    axis.set_xticks(x, [f"{v:.0f}" if v < 10_000 else EngFormatter(sep="")(v) for v in x], rotation=45)
    style.dress(axis)


def _guides(axis: Axes, x: np.ndarray, first: float, orders: Sequence[int]) -> None:
    """Powers of x from the first point on, grey."""
    for order in orders:
        name, dashes = GUIDES[order]
        axis.plot(x, first * (x / x[0]) ** order, color="0.55", linewidth=0.9, linestyle=dashes, zorder=1, label=name)


def _limits(row: np.ndarray, values: Sequence[Sequence[float]]) -> None:
    """As high and low as what was measured, with room: a power may leave the picture."""
    flat = [value for some in values for value in some if value > 0]
    row[0].set_ylim(min(flat) / 1.5, max(flat) * 1.5)
