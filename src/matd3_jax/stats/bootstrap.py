"""Statistics over seeds with intervals by the bootstrap (Efron 1979), stratified over tasks (Agarwal et al. 2021).

Intervals are percentiles of the statistic over resamples: each task's runs are resampled from that task's runs, with
replacement, as rliable does. The same seed gives the same interval. Fewer than two runs of a task say nothing about the
spread: the ends are nan then. Averages over a nan (a run that diverged) are nan, with their intervals; it is never left
out. In what only compares scores (probability of improvement, performance profiles) it loses against every number.

Scores are [runs, tasks], or [runs] for one task, or a list of [runs of that task] where tasks have different numbers.
"""

import warnings
from collections.abc import Callable, Sequence

import numpy as np
import scipy.stats

from matd3_jax.stats.intervals import Estimate, samples

Scores = np.ndarray | Sequence[np.ndarray]

AVERAGES = ("mean", "median", "iqm")

AGGREGATES = ("mean", "median", "iqm", "optimality_gap")

BATCH = 2**20
"""Numbers resampled at a time: the work stays in cache."""


def average(
    values: np.ndarray,
    kind: str = "mean",
    axis: int = 0,
    confidence: float = 0.95,
    resamples: int = 2000,
    seed: int = 0,
) -> Estimate:
    """Mean, median or interquartile mean over `axis` (seeds) with its bootstrap interval, for any other axes at once.

    All points of a curve see the same resampled seeds.

    Args:
        kind: "mean", "median" or "iqm" (`middle_mean` with a quarter cut off at each end).

    Raises:
        ValueError: no seeds, unknown kind, impossible confidence or number of resamples.

    Example:
        >>> found = average(np.array([1.0, 2.0, 3.0, 100.0]), "median")
        >>> float(found.value), float(found.low), float(found.high)
        (2.5, 1.0, 100.0)
    """
    values = np.moveaxis(samples(values, axis, confidence), 0, -1)
    cut = _cut(kind, values.shape[-1])
    return _bootstrap([values], lambda drawn: middle_mean(drawn, cut), confidence, resamples, seed)


def location(values: np.ndarray, kind: str = "mean", axis: int = 0) -> np.ndarray:
    """`average` without an interval."""
    values = np.moveaxis(samples(values, axis), 0, -1)
    return middle_mean(values, _cut(kind, values.shape[-1]))


def _cut(kind: str, n: int) -> int:
    """The median and the interquartile mean of n values are `middle_mean`s with this cut."""
    if kind not in AVERAGES:
        raise ValueError(f"kind={kind!r}: must be one of {', '.join(AVERAGES)}")
    return {"mean": 0, "median": (n - 1) // 2, "iqm": n // 4}[kind]


def middle_mean(values: np.ndarray, cut: int) -> np.ndarray:
    """Mean over the last axis without the `cut` smallest and the `cut` largest; nan where there is a nan."""
    if cut == 0:
        return values.mean(axis=-1)
    ordered = np.sort(values, axis=-1)  # nan last
    middle = ordered[..., cut : values.shape[-1] - cut].mean(axis=-1)
    return np.where(np.isnan(ordered[..., -1]), np.nan, middle)


def aggregate(
    scores: Scores,
    kind: str = "iqm",
    threshold: float = 1.0,
    confidence: float = 0.95,
    resamples: int = 10_000,
    seed: int = 0,
) -> Estimate:
    """One number for the scores of all tasks with its stratified bootstrap interval (Agarwal et al. 2021, section 4.3).

    Tasks should be on one scale: normalize returns first.

    Args:
        scores: [runs, tasks], [runs], or a list of [runs] (see above).
        kind: "mean" (of the tasks' means), "median" (of the tasks' means; with one task that is its mean: `average` has
            the median over runs), "iqm" (mean of the middle half of all scores together), "optimality_gap" (by how much
            the scores fall short of `threshold` on average; better scores count as `threshold`).

    Raises:
        ValueError: no scores, unknown kind, impossible confidence or number of resamples.
    """
    if kind not in AGGREGATES:
        raise ValueError(f"kind={kind!r}: must be one of {', '.join(AGGREGATES)}")
    tasks = _tasks(scores, confidence)
    count = sum(len(task) for task in tasks)

    def statistic(*drawn: np.ndarray) -> np.ndarray:
        if kind == "iqm":
            return middle_mean(np.concatenate(drawn, axis=-1), count // 4)
        if kind == "optimality_gap":
            return threshold - np.minimum(np.concatenate(drawn, axis=-1), threshold).mean(axis=-1)
        means = np.stack([task.mean(axis=-1) for task in drawn])
        return means.mean(axis=0) if kind == "mean" else np.median(means, axis=0)

    return _bootstrap(tasks, statistic, confidence, resamples, seed)


def probability_of_improvement(
    x: Scores, y: Scores, confidence: float = 0.95, resamples: int = 10_000, seed: int = 0
) -> Estimate:
    """P(X > Y) for a run of each on the same task, averaged over tasks, with its stratified bootstrap interval.

    On one task the share of the pairs (run of X, run of Y) in which X scores higher, ties counting half: Mann and
    Whitney's U over n m (Agarwal et al. 2021, section 4.3). Runs need not be equal in number.

    Raises:
        ValueError: no scores, different numbers of tasks, impossible confidence or number of resamples.

    Example:
        Of the six pairs of a run of X and a run of Y, X scores more in five.

        >>> round(float(probability_of_improvement(np.array([2.0, 4.0, 5.0]), np.array([1.0, 3.0])).value), 3)
        0.833
    """
    xs, ys = _tasks(x, confidence), _tasks(y, confidence)
    if len(xs) != len(ys):
        raise ValueError(f"x has {len(xs)} tasks and y {len(ys)}: they must be the same tasks")

    def statistic(*drawn: np.ndarray) -> np.ndarray:
        pairs = ((a[..., :, None], b[..., None, :]) for a, b in zip(drawn[: len(xs)], drawn[len(xs) :], strict=True))
        wins = [0.5 * ((a > b).mean(axis=(-2, -1)) + (a >= b).mean(axis=(-2, -1))) for a, b in pairs]
        return np.mean(wins, axis=0)

    worst = [np.where(np.isnan(task), -np.inf, task) for task in (*xs, *ys)]
    size = max(len(a) * len(b) for a, b in zip(xs, ys, strict=True))
    return _bootstrap(worst, statistic, confidence, resamples, seed, size)


def performance_profile(
    scores: Scores, thresholds: np.ndarray, confidence: float = 0.95, resamples: int = 2000, seed: int = 0
) -> Estimate:
    """Share of the runs that score more than each threshold, with its pointwise stratified bootstrap interval.

    The run-score distribution of Agarwal et al. 2021 (section 4.2): over all runs of all tasks together.

    Args:
        thresholds: [thresholds].

    Returns:
        Arrays [thresholds].

    Raises:
        ValueError: no scores, thresholds that are not [thresholds], impossible confidence or number of resamples.
    """
    thresholds = np.asarray(thresholds, dtype=float)
    if thresholds.ndim != 1 or thresholds.size == 0:
        raise ValueError(f"thresholds must be a list of numbers, not of shape {thresholds.shape}")
    above = [(task > thresholds[:, None]).astype(float) for task in _tasks(scores, confidence)]
    return _bootstrap(above, lambda *drawn: np.concatenate(drawn, axis=-1).mean(axis=-1), confidence, resamples, seed)


def _bootstrap(
    strata: Sequence[np.ndarray],
    statistic: Callable[..., np.ndarray],
    confidence: float,
    resamples: int,
    seed: int,
    size: int = 0,
) -> Estimate:
    """A statistic of strata [..., runs], which it reduces along the last axis, with its percentile interval.

    Args:
        size: numbers that the statistic makes of one resample, where these are more than the data.
    """
    if resamples < 1:
        raise ValueError(f"resamples={resamples}: must be at least 1")
    value = np.asarray(statistic(*strata))
    if min(stratum.shape[-1] for stratum in strata) < 2:
        return Estimate(value, np.full_like(value, np.nan), np.full_like(value, np.nan))
    size = max(size, *(stratum.size for stratum in strata))
    with warnings.catch_warnings(), np.errstate(invalid="ignore"):
        warnings.simplefilter("ignore", scipy.stats.DegenerateDataWarning)  # nan in, nan out
        found = scipy.stats.bootstrap(
            strata,
            lambda *drawn, axis: statistic(*drawn),
            vectorized=True,
            axis=-1,
            n_resamples=resamples,
            batch=max(1, BATCH // size),
            confidence_level=confidence,
            method="percentile",
            random_state=np.random.default_rng(seed),
        )
    return Estimate(value, *map(np.asarray, found.confidence_interval))


def _tasks(scores: Scores, confidence: float) -> list[np.ndarray]:
    """The scores [runs] of each task. Raises ValueError."""
    if isinstance(scores, np.ndarray) or all(np.ndim(task) == 0 for task in scores):
        scores = np.asarray(scores)
        if scores.ndim not in (1, 2) or scores.size == 0:
            raise ValueError(f"scores must be [runs, tasks] or [runs], not of shape {scores.shape}")
        return [samples(task, 0, confidence) for task in (scores.T if scores.ndim == 2 else scores[None])]
    tasks = [samples(np.asarray(task), 0, confidence) for task in scores]
    if not tasks or any(task.ndim != 1 for task in tasks):
        raise ValueError("scores must be [runs, tasks], or a list with the scores [runs] of each task")
    return tasks
