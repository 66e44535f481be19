"""Learning curves."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from matd3_jax.errors import UserError
from matd3_jax.runs.metrics import by_seed
from matd3_jax.stats.intervals import Estimate, mean_interval

COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
"""Told apart by all kinds of color vision: Okabe and Ito 2008, without the yellow, which is faint on white."""

STYLES = ("solid", (0, (5, 1.5)), (0, (1, 1)), (0, (5, 1.5, 1, 1.5)), (0, (8, 2)))
"""As many as stand apart; 5 and the 7 colors have no common factor, so 35 lines differ in one or the other."""

FORMATS = (".png", ".pdf", ".svg")

PAPER: dict[Any, Any] = {
    "font.size": 9,
    "axes.titlesize": 9,
    "legend.fontsize": 8,
    "pdf.fonttype": 42,
    "svg.fonttype": "none",
}
"""Sizes in points, for a picture that is printed at its own size; letters stay letters in PDF and SVG."""


class Line(NamedTuple):
    """A curve with its band."""

    label: str
    x: np.ndarray
    """[points]."""
    estimate: Estimate
    """[points]; no band where the ends are nan."""
    seeds: np.ndarray
    """[seeds, points]."""


class Panel(NamedTuple):
    """What stands in one pair of axes; the lines of all panels have the same labels in the same order."""

    y_label: str
    lines: Sequence[Line]


def check(path: Path) -> Path:
    """`path` if a picture can be written there. Raises UserError."""
    if path.suffix.lower() not in FORMATS:
        raise UserError(f"out={path}: must end with one of {', '.join(FORMATS)}")
    if not path.parent.is_dir():
        raise UserError(f"out={path}: there is no directory {path.parent}")
    return path


def compare(
    path: Path, panels: Sequence[Panel], x_label: str, title: str = "", caption: str = "", each: bool = False
) -> None:
    """Draw lines with bands, side by side in panels, in colors and dashes that can be told apart.

    The legend stands beside the panels where there are many lines or panels, or else in a free corner.

    Args:
        caption: over the legend.
        each: every seed, too, thin.
    """
    columns = min(len(panels), 2)
    rows = math.ceil(len(panels) / columns)
    width, height = 3.3 * columns + 1.2, 0.4 + 2.6 * rows
    with matplotlib.rc_context(PAPER):
        figure = Figure(figsize=(width, height), layout="constrained")
        FigureCanvasAgg(figure)
        axes = figure.subplots(rows, columns, squeeze=False, sharex=True).ravel()
        for k, (axis, panel) in enumerate(zip(axes, panels, strict=False)):
            for i, line in enumerate(panel.lines):
                _draw(axis, line, COLORS[i % len(COLORS)], STYLES[i % len(STYLES)], each)
            _dress(axis)
            axis.set_ylabel(panel.y_label)
            axis.xaxis.set_major_formatter(EngFormatter(sep=""))
            if k + columns >= len(panels):
                axis.set_xlabel(x_label)
                axis.tick_params(labelbottom=True)
        for axis in axes[len(panels) :]:
            axis.set_visible(False)
        if title:
            (figure.suptitle if len(panels) > 1 else axes[0].set_title)(title, fontsize=PAPER["axes.titlesize"])
        style = {"title": caption or None, "frameon": False, "handlelength": 3, "alignment": "left"}
        if len(panels[0].lines) > 4 or len(panels) > 1:
            legend = figure.legend(*axes[0].get_legend_handles_labels(), loc="outside right upper", **style)
        else:
            legend = axes[0].legend(loc="best", **style)
        legend.get_title().set_fontsize(PAPER["legend.fontsize"])
        if legend.axes is None:  # beside the panels: they keep their size
            extent = legend.get_window_extent(figure.canvas.get_renderer())
            figure.set_size_inches(width + extent.width / figure.dpi, max(height, extent.height / figure.dpi + 0.2))
        try:
            figure.savefig(path, dpi=200)
        except OSError as error:
            raise UserError(f"cannot write {path}: {error.strerror}") from error


def _draw(axis, line: Line, color: str, style, each: bool) -> None:
    middle, low, high = line.estimate
    dot = {"marker": "o", "markersize": 3} if len(line.x) == 1 else {}  # or nothing would be seen
    if each and len(line.seeds) > 1:
        axis.plot(line.x, line.seeds.T, color=color, linewidth=0.5, alpha=0.35, **dot)
    axis.fill_between(line.x, low, high, color=color, alpha=0.2, linewidth=0)
    axis.plot(line.x, middle, color=color, linestyle=style, linewidth=1.4, label=line.label, **dot)


def _dress(axis) -> None:
    axis.spines[["top", "right"]].set_visible(False)
    axis.grid(alpha=0.25)


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
    for axis, team, color in zip(axes, teams, ("tab:blue", "tab:red"), strict=False):
        evaluated = f"eval_{team}" in metrics
        kinds = [(team, "training (exploring)", "tab:gray" if evaluated else color)]
        kinds += [(f"eval_{team}", "evaluation (deterministic)", color)] if evaluated else []
        for name, kind, shade in kinds:
            steps, curves = by_seed(metrics, name)
            curve(axis, steps, curves, shade, f"{kind}, {who}", each=True)
        axis.set_ylabel(f"return\n{team.removeprefix('return_')}")
        axis.legend(loc="lower right", frameon=False)
    axes[-1].set_xlabel("env steps of each seed")
    axes[0].set_title(title)
    figure.savefig(path, dpi=120)


def curve(axis, steps: np.ndarray, curves: np.ndarray, color: str, label: str, each: bool = False) -> None:
    """One line: the mean of curves [seeds, points] with the 95 % interval of the mean; `each`: every seed too, thin."""
    mean, half = mean_interval(curves)
    if each and len(curves) > 1:
        axis.plot(steps, curves.T, color=color, linewidth=0.5, alpha=0.35)
    if len(curves) > 1:
        axis.fill_between(steps, mean - half, mean + half, color=color, alpha=0.25, linewidth=0)
    axis.plot(steps, mean, color=color, label=label if len(curves) > 1 else "one seed")
    _dress(axis)
