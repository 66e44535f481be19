"""Learning curves."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from matd3_jax.errors import UserError
from matd3_jax.figures import style
from matd3_jax.runs.divergence import Divergence, which
from matd3_jax.runs.metrics import by_seed
from matd3_jax.stats.intervals import Estimate, t_interval

FORMATS = (".png", ".pdf", ".svg")


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
    lines: Sequence[Line | None]
    """None keeps a color and dashes for a line that another panel has."""


def check(path: Path) -> Path:
    """`path` if a picture can be written there. Raises UserError."""
    if path.suffix.lower() not in FORMATS:
        raise UserError(f"out={path}: must end with one of {', '.join(FORMATS)}")
    if not path.parent.is_dir():
        raise UserError(f"out={path}: there is no directory {path.parent}")
    return path


def compare(
    path: Path,
    panels: Sequence[Panel],
    x_label: str,
    title: str = "",
    caption: str = "",
    each: bool = False,
    legend: bool = True,
    dark: bool = False,
) -> None:
    """Draw lines with bands, side by side in panels, in colors and dashes that can be distinguished.

    The legend is to the right of the panels where there are many lines or panels, or else in a free corner.

    Args:
        caption: over the legend.
        each: every seed, too, thin.
        legend: False: none, for a page that has its own (`style.SERIES`, `style.STYLES`).
        dark: for a dark page.
    """
    columns = min(len(panels), 2)
    rows = math.ceil(len(panels) / columns)
    width, height = 3.3 * columns + 1.2, 0.4 + 2.6 * rows
    with matplotlib.rc_context({**style.PRINTED, **(style.DARK if dark else {})}):
        figure = Figure(figsize=(width, height), layout="constrained")
        FigureCanvasAgg(figure)
        axes = figure.subplots(rows, columns, squeeze=False, sharex=True).ravel()
        for k, (axis, panel) in enumerate(zip(axes, panels, strict=False)):
            for i, line in enumerate(panel.lines):
                if line is None:
                    continue
                color, dashes = style.SERIES[i % len(style.SERIES)], style.STYLES[i % len(style.STYLES)]
                color = style.web(style.WHITE) if dark and color == style.web(style.BLACK) else color
                style.band(axis, line.x, line.estimate, color, line.label, dashes, line.seeds if each else None)
            style.dress(axis)
            axis.set_ylabel(panel.y_label)
            axis.xaxis.set_major_formatter(EngFormatter(sep=""))
            if k + columns >= len(panels):
                axis.set_xlabel(x_label)
                axis.tick_params(labelbottom=True)
        for axis in axes[len(panels) :]:
            axis.set_visible(False)
        if title:
            (figure.suptitle if len(panels) > 1 else axes[0].set_title)(title, fontsize=style.PRINTED["axes.titlesize"])
        if legend:
            _add_legend(figure, axes[0], caption, outside=len(panels[0].lines) > 4 or len(panels) > 1)
        try:
            style.save(figure, path, dpi=200)
        except OSError as error:
            raise UserError(f"cannot write {path}: {error.strerror}") from error


def _add_legend(figure: Figure, axis: Axes, caption: str, outside: bool) -> None:
    """Write a legend into a free corner, or to the right of all panels, which keep their size."""
    frame: dict[str, Any] = {"title": caption or None, "frameon": False, "handlelength": 3, "alignment": "left"}
    if outside:
        added = figure.legend(*axis.get_legend_handles_labels(), loc="outside right upper", **frame)
    else:
        added = axis.legend(loc="best", **frame)
    added.get_title().set_fontsize(style.PRINTED["legend.fontsize"])
    if outside:
        width, height = figure.get_size_inches()
        extent = added.get_window_extent()
        figure.set_size_inches(width + extent.width / figure.dpi, max(height, extent.height / figure.dpi + 0.2))


def learning_curve(
    path: Path, metrics: Mapping[str, np.ndarray], title: str, diverged: Mapping[int, Divergence]
) -> None:
    """Draw the return of every team over env steps, in training and (where there are any) in evaluations: each seed,
    the mean of those that did not diverge, and its 95 % interval.

    Args:
        metrics: columns [rows] of the metrics table.
    """
    teams = [name for name in metrics if name.startswith("return_")]
    figure = Figure(figsize=(7, 2.6 + 1.9 * len(teams)), layout="constrained")
    FigureCanvasAgg(figure)
    axes = np.atleast_1d(np.asarray(figure.subplots(len(teams), sharex=True), dtype=object))
    seeds = np.unique(metrics["seed"])
    sound = ~np.isin(seeds, list(diverged))
    who = f"mean of {sound.sum()}{f' of {len(seeds)}' if diverged else ''} seeds, 95 % interval"
    if len(seeds) == 1:
        who = "one seed" + (", diverged" if diverged else "")
    elif not sound.any():
        who = f"all {len(seeds)} seeds diverged"
    elif diverged:
        title = f"{title} ({which(diverged)})"
    for axis, team in zip(axes, teams, strict=True):
        color = style.web(style.TEAM.get(team.removeprefix("return_"), style.BLUE))
        evaluated = f"eval_{team}" in metrics
        kinds = [(team, "training (exploring)", style.web(style.GREY) if evaluated else color)]
        kinds += [(f"eval_{team}", "evaluation (deterministic)", color)] if evaluated else []
        for name, kind, shade in kinds:
            steps, curves = by_seed(metrics, name)
            nothing = np.full(len(steps), np.nan)
            shown = curves[sound] if len(seeds) > 1 else curves
            estimate = t_interval(shown) if len(shown) else Estimate(nothing, nothing, nothing)
            style.band(axis, steps, estimate, shade, f"{kind}, {who}", seeds=curves)
        style.dress(axis)
        axis.set_ylabel(f"return\n{team.removeprefix('return_')}")
        axis.legend(loc="lower right", frameon=False)
    axes[-1].set_xlabel("env steps of each seed")
    axes[0].set_title(title)
    style.save(figure, path, dpi=120)
