"""Learning curves of several seeds on one grid, from tables of metrics."""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from matd3_jax.runs import overestimation

AXES = ("step", "episodes", "updates")
"""What a curve can be drawn over; episodes: the number ended so far."""


@dataclasses.dataclass(frozen=True)
class Curves:
    """A column of the metrics table over steps, episodes or updates, as far as all seeds go."""

    x: np.ndarray
    """[points], ascending."""
    values: np.ndarray
    """[seeds, points], without nan."""
    seeds: np.ndarray
    """[seeds]."""
    ends: np.ndarray
    """Where each seed's own values end [seeds]; those that go further are cut at the shortest."""


@dataclasses.dataclass(frozen=True)
class Series:
    """The values of one seed: `y[k]` is for what lies between `x[k - 1]` (at first `start`) and `x[k]`."""

    start: float
    x: np.ndarray
    y: np.ndarray


def of_table(metrics: Mapping[str, np.ndarray], name: str, over: str = "step", window: float | None = None) -> Curves:
    """The column `name` of all seeds.

    Seeds with the same rows keep their numbers. Otherwise (other interval lengths, rows in which no episode of a seed
    ended, episodes of different lengths drawn over episodes) the seed with the fewest rows gives the points; of the
    others each point takes the mean over what lies between it and the point before, or, of evaluations, which are made
    at one moment, the value interpolated to it. A seed's nan are left out between its values; where it has nan to its
    end (it diverged, or no more episode has ended) its values end before.

    Args:
        metrics: columns [rows], each seed's rows ascending; as `directory.together` gives them.
        over: one of `AXES`.
        window: take the mean of the last `window` episodes at each point (of all, as long as they are fewer), each row
            counting with the episodes that ended in it.

    Raises:
        ValueError: a seed has no value at all, or the seeds' values do not overlap.
    """
    seeds, series = np.unique(metrics["seed"]), []
    for seed in seeds:
        rows = metrics["seed"] == seed
        episodes, y = metrics["episodes"][rows], metrics[name][rows]
        x = np.cumsum(episodes) if over == "episodes" else metrics[over][rows]
        there = ~np.isnan(y) if window is None else ~np.isnan(y) & (episodes > 0)
        if not there.any():
            raise ValueError(f"no values with seed {int(seed)}")
        first = int(np.argmax(there))
        if window is not None:
            y = running_mean(y[there], episodes[there], window)
        else:
            y = y[there]
        series.append(Series(float(x[first - 1]) if first else 0.0, x[there], y))
    x, values = on_one_grid(series, at_points=evaluated(name) or window is not None)
    return Curves(x, values, seeds, np.array([one.x[-1] for one in series]))


def evaluated(name: str) -> bool:
    """Whether a column comes from evaluations, which are made at one moment, and not from what lies between rows."""
    judged = tuple(f"_{column}" for column in overestimation.COLUMNS)
    return name.startswith("eval_") or "_eval_" in name or name.endswith(judged)


def running_mean(y: np.ndarray, episodes: np.ndarray, window: float) -> np.ndarray:
    """Means [rows] over the last `window` episodes up to each row's end; a row's episodes all count as its mean y."""
    ends = np.concatenate([[0], np.cumsum(episodes)])
    sums = np.concatenate([[0], np.cumsum(y * episodes)])
    begins = np.maximum(ends[1:] - window, 0)
    return (sums[1:] - np.interp(begins, ends, sums)) / (ends[1:] - begins)


def on_one_grid(series: Sequence[Series], at_points: bool) -> tuple[np.ndarray, np.ndarray]:
    """Points [points] and values [series, points] of series, as far as all go; see `of_table`.

    Args:
        at_points: values stand for the moment x, not for what lies between it and the x before: interpolate.

    Raises:
        ValueError: one ends before another begins.
    """
    first, last = max(one.x[0] for one in series), min(one.x[-1] for one in series)
    inside = [one.x[(one.x >= first) & (one.x <= last)] for one in series]
    coarse = min(range(len(series)), key=lambda i: inside[i].size)
    grid = inside[coarse]
    if not grid.size:
        raise ValueError(f"the values of one seed end at {last:,.10g}, before those of another begin ({first:,.10g})")
    before = series[coarse].x[series[coarse].x < first]
    edges = np.concatenate([[before[-1] if before.size else series[coarse].start], grid])
    values = []
    for one, own in zip(series, inside, strict=True):
        if np.array_equal(own, grid):
            values.append(one.y[(one.x >= first) & (one.x <= last)])
        elif at_points:
            values.append(np.interp(grid, one.x, one.y))
        else:
            values.append(_means(one, edges))
    return grid, np.stack(values)


def _means(one: Series, edges: np.ndarray) -> np.ndarray:
    """Means of a series between neighboring edges."""
    knots = np.concatenate([[min(one.start, one.x[0])], one.x])
    sums = np.concatenate([[0], np.cumsum(one.y * np.diff(knots))])
    low, high = np.maximum(edges[:-1], knots[0]), edges[1:]
    width = high - low
    total = np.interp(high, knots, sums) - np.interp(low, knots, sums)
    return np.where(width > 0, total / np.where(width > 0, width, 1), np.interp(high, one.x, one.y))
