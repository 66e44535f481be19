"""A sweep in one picture: the curves of its settings, and the final values over each swept key."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from matd3_jax.figures import style
from matd3_jax.runs import divergence
from matd3_jax.runs.directory import together
from matd3_jax.runs.metrics import by_seed
from matd3_jax.stats.intervals import t_interval
from matd3_jax.sweep.ranking import Ranked

BEST = style.SERIES[:5]
"""Of the best settings, in order."""


def draw(path: Path, folder: Path, runs: Mapping[str, Sequence[str]], rows: Sequence[Ranked], metric: str) -> None:
    """Curves of all settings (the best five in color) and, for each swept key, the final value of every setting.

    Args:
        folder: where the run directories are; runs: their names by setting.
        rows: best first.
    """
    keys = list(rows[0].values)
    figure = Figure(figsize=(9, 3.6 + 2.8 * -(-len(keys) // 3)), layout="constrained")
    FigureCanvasAgg(figure)
    top, *bottom = figure.subfigures(1 + bool(keys), 1, height_ratios=[3.6, 2.8 * -(-len(keys) // 3)][: 1 + bool(keys)],
                                     squeeze=False)[:, 0]  # fmt: skip
    _curves(top.subplots(), folder, runs, rows, metric)
    if keys:
        axes = bottom[0].subplots(-(-len(keys) // 3), min(3, len(keys)), squeeze=False).ravel()
        for axis, key in zip(axes, keys, strict=False):
            _values(axis, key, rows, metric)
        for axis in axes[len(keys) :]:
            axis.set_visible(False)
    style.save(figure, path, dpi=130)


def _curves(axis, folder: Path, runs: Mapping[str, Sequence[str]], rows: Sequence[Ranked], metric: str) -> None:
    means = []
    for k, row in reversed(list(enumerate(rows))):
        table = together([folder / run for run in runs[row.name]])
        sound = divergence.without(table, row.seeds[row.diverged].tolist())
        if not sound["step"].size:
            continue  # nothing is known of a setting that always diverged
        steps, curves = by_seed(sound, metric)
        means.append(curves.mean(axis=0))
        if k >= len(BEST):
            label = "others" if k == len(BEST) else None
            axis.plot(steps, means[-1], color="0.75", linewidth=0.8, label=label)
            continue
        style.band(axis, steps, t_interval(curves), BEST[k], f"{k + 1}: {row.name}")
    handles, labels = axis.get_legend_handles_labels()
    axis.legend(handles[::-1], labels[::-1], frameon=False, fontsize=8, loc="center left", bbox_to_anchor=(1, 0.5))
    axis.set_xlabel("env steps of each seed")
    axis.set_ylabel(metric)
    axis.set_title("mean over seeds, 95 % interval", fontsize=10)
    # A range that holds all means: intervals of few seeds reach far beyond what there is to see.
    finite = np.concatenate(means or [np.empty(0)])
    finite = finite[np.isfinite(finite)]
    if finite.size:  # not where everything diverged
        room = 0.1 * (np.ptp(finite) or 1.0)
        axis.set_ylim(finite.min() - room, finite.max() + room)
    style.dress(axis)


def _values(axis, key: str, rows: Sequence[Ranked], metric: str) -> None:
    """Final mean of every setting over its value of `key`: the best in blue, and a line at the median of each value."""
    texts = [row.values[key] for row in rows]
    finals = np.array([row.interval("final")[0] for row in rows])
    try:
        numbers = np.array([float(text) for text in texts])
    except ValueError:
        numbers = None
    listed = sorted(set(texts), key=float) if numbers is not None else sorted(set(texts))
    if len(listed) > 8 and numbers is not None:  # drawn from an interval
        at = numbers
        if (numbers > 0).all() and numbers.max() > 10 * numbers.min():
            axis.set_xscale("log")
    else:
        at = np.array([listed.index(text) for text in texts], float)
        axis.set_xticks(range(len(listed)), listed, rotation=30 if max(map(len, listed)) > 8 else 0)
        for k in range(len(listed)):
            axis.hlines(np.median(finals[at == k]), k - 0.25, k + 0.25, color="black", linewidth=1.2)
        axis.margins(x=0.15)
    axis.scatter(at, finals, s=14, color="0.5", alpha=0.7, linewidth=0)
    axis.scatter(at[:1], finals[:1], s=28, color=BEST[0], zorder=3)  # the best setting
    axis.set_xlabel(key)
    axis.set_ylabel(f"final {metric}", fontsize=8)
    style.dress(axis)
