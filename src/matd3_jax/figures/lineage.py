"""The lineage of populations in one picture: scores, and every member's hyper-parameters along training."""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from matd3_jax.figures import style
from matd3_jax.sweep.lineage import Lineage

MOST = 4
"""Populations that are drawn, the first ones."""

SLANT = 0.4
"""Share of the time since the selection before that the line of a copy goes back."""


def draw(path: Path, lineage: Lineage, metric: str) -> None:
    """A column for each population: above the scores, the best one in blue, below each swept key.

    A member is a line at its value, colored by its score at the selection that follows, or in vermilion where it had
    diverged by then; a thin black line leads from the value of the member that was copied to the new value of the one
    that copied it.
    """
    shown = min(MOST, len(lineage.seeds))
    rows = 1 + len(lineage.keys)
    figure = Figure(figsize=(1.2 + 4.2 * shown, 0.6 + 2.4 * rows), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(rows, shown, sharex=True, sharey="row", squeeze=False)
    scores = np.array(lineage.scores)  # [selections, settings, seeds]
    finite = scores[np.isfinite(scores)]
    # Of the first networks the scores are far below all others, and nothing is seen of what distinguishes these.
    low, high = np.quantile(finite, (0.1, 1.0)) if finite.size else (0.0, 1.0)
    norm = Normalize(low, high if high > low else low + 1.0)
    for s in range(shown):
        _scores(axes[0, s], lineage, scores[:, :, s])
        axes[0, s].set_title(f"population {lineage.seeds[s]}", fontsize=10)
        axes[-1, s].set_xlabel("env steps of each member")
        for axis, k in zip(axes[1:, s], range(len(lineage.keys)), strict=True):
            _members(axis, lineage, k, s, norm)
    axes[0, 0].set_ylabel(metric)
    for axis, key in zip(axes[1:, 0], lineage.keys, strict=True):
        axis.set_ylabel(key)
    mapped = figure.colorbar(_mappable(norm), ax=axes[1:].ravel().tolist(), fraction=0.03, extend="min")
    mapped.set_label(metric)
    count = len(lineage.steps) - 1
    title = f"{len(lineage.settings)} members, {count} selection{'s' * (count != 1)}"
    title += f" (the first {shown} of {len(lineage.seeds)} populations)" if shown < len(lineage.seeds) else ""
    title += "; vermilion: diverged" if np.isnan(scores[1:, :, :shown]).any() else ""
    figure.suptitle(title, fontsize=10)
    style.save(figure, path, dpi=130)


def _mappable(norm: Normalize) -> Any:
    from matplotlib.cm import ScalarMappable

    return ScalarMappable(norm, colormaps["cividis"])


def _scores(axis: Any, lineage: Lineage, scores: np.ndarray) -> None:
    """Scores [selections, settings] of a population: every member's, and the best so far known at each selection."""
    axis.plot(lineage.steps, scores, color="0.75", linewidth=0.8)
    axis.plot(lineage.steps, best(scores), color=style.SERIES[0], linewidth=1.8, marker="o", markersize=2.5)
    there = scores[np.isfinite(scores)]
    if there.size and len(lineage.steps) > 2:
        late = scores[1:][np.isfinite(scores[1:])]
        low, high = (np.quantile(late, 0.05), late.max()) if late.size else (there.min(), there.max())
        room = 0.1 * ((high - low) or 1.0)
        axis.set_ylim(low - room, high + room)
    style.dress(axis)


def best(scores: np.ndarray) -> np.ndarray:
    """The best score of each selection [selections], of scores [selections, settings]; nan where there is none."""
    known = np.where(np.isnan(scores), -np.inf, scores).max(axis=1)
    return np.where(np.isfinite(known), known, np.nan)


def positions(lineage: Lineage, key: int) -> tuple[np.ndarray, list[str] | None, bool]:
    """Where values are drawn: ([selections, settings, seeds], the names of the places 0, 1, ... of what are no numbers
    or None, whether on a logarithmic scale)."""
    texts = np.array([[[own[key] for own in member] for member in values] for values in lineage.values], dtype=object)
    try:
        numbers = texts.astype(np.float64)
    except ValueError:
        names = sorted(set(texts.ravel().tolist()))
        return np.vectorize(names.index)(texts).astype(np.float64), names, False
    return numbers, None, bool((numbers > 0).all() and numbers.max() > 5 * numbers.min())


def segments(lineage: Lineage, at: np.ndarray, s: int) -> tuple[np.ndarray, np.ndarray]:
    """The lines [lines, 2, (x, y)] of a population's members between selections, and of the copies.

    Args:
        at: [selections, settings] where the values are drawn.
        s: place of the population.
    """
    steps, members, copies = lineage.steps, [], []
    for e in range(len(steps) - 1):
        members += [[(steps[e], y), (steps[e + 1], y)] for y in at[e]]
    for e in range(1, len(steps)):
        back = steps[e] - SLANT * (steps[e] - steps[e - 1])
        for k, parent in enumerate(lineage.parents[e][:, s]):
            if parent != k:
                copies.append([(back, at[e - 1, parent]), (steps[e], at[e, k])])
    return np.array(members).reshape(-1, 2, 2), np.array(copies).reshape(-1, 2, 2)


def _members(axis: Any, lineage: Lineage, key: int, s: int, norm: Normalize) -> None:
    at, names, logarithmic = positions(lineage, key)
    if logarithmic:
        axis.set_yscale("log")
    members, copies = segments(lineage, at[:, :, s], s)
    colors = np.concatenate([scores[:, s] for scores in lineage.scores[1:]] or [np.empty(0)])
    map_ = colormaps["cividis"].with_extremes(bad=style.web(style.VERMILION))
    axis.add_collection(LineCollection(list(members), array=np.ma.masked_invalid(colors), cmap=map_, norm=norm, lw=1.6))
    axis.add_collection(LineCollection(list(copies), colors="black", linewidths=0.6, alpha=0.7))
    last = at[-1, :, s]
    axis.plot(np.full(len(last), lineage.steps[-1]), last, "o", color="black", markersize=2.5)
    if names is not None:
        axis.set_yticks(range(len(names)), names)
    axis.autoscale_view()
    style.dress(axis)
