"""Statistics over seeds without resampling: Student's intervals and the tests of A against B (see docs/statistics.md).

A nan (a seed that diverged) is never left out: what it enters becomes nan. Give it a score first, say the worst
possible one, if it is to count as one. Where there is one seed only, there is no interval: its ends are nan.
"""

import warnings
from typing import NamedTuple

import numpy as np
from scipy.special import stdtrit


class Estimate(NamedTuple):
    """A value with the ends of its confidence interval, three arrays of one shape."""

    value: np.ndarray
    low: np.ndarray
    high: np.ndarray


class Comparison(NamedTuple):
    """How much larger the mean of A is than that of B; arrays of one shape, or numbers."""

    difference: np.ndarray
    """mean(A) - mean(B)."""
    low: np.ndarray
    high: np.ndarray
    """Ends of the confidence interval of the difference."""
    p: np.ndarray
    """Probability of a difference at least as large, either way, if the true means were equal."""
    n_a: int
    n_b: int

    @property
    def clear(self) -> np.ndarray:
        """Whether the interval leaves zero out; False where there is none."""
        return (self.low > 0) | (self.high < 0)


def mean_interval(values: np.ndarray, axis: int = 0, confidence: float = 0.95) -> tuple[np.ndarray, np.ndarray]:
    """Mean over `axis` (seeds) and the half width of its confidence interval (Student's t), for any other axes at once.

    Raises ValueError without seeds or with an impossible confidence.

    Example:
        Three seeds of returns at two points of a curve; Student's quantile of 2 degrees of freedom is 4.303.

        >>> mean, half = mean_interval(np.array([[1.0, 10.0], [2.0, 10.0], [3.0, 10.0]]))
        >>> mean.tolist(), half.round(3).tolist()
        ([2.0, 10.0], [2.484, 0.0])
    """
    values = samples(values, axis, confidence)
    n, mean = len(values), values.mean(axis=0)
    if n == 1:
        return mean, np.full_like(mean, np.nan)
    return mean, stdtrit(n - 1, (1 + confidence) / 2) * values.std(axis=0, ddof=1) / np.sqrt(n)


def t_interval(values: np.ndarray, axis: int = 0, confidence: float = 0.95) -> Estimate:
    """`mean_interval` with the ends of the interval."""
    mean, half = mean_interval(values, axis, confidence)
    return Estimate(mean, mean - half, mean + half)


def compare(a: np.ndarray, b: np.ndarray, paired: bool = False, confidence: float = 0.95) -> Comparison:
    """A against B: difference of the means over the first axis (seeds), its confidence interval and the p-value.

    Not paired: Welch's t-test, which asks for neither equal variances nor equal numbers. Paired: the t-test of the
    differences a[k] - b[k]; right only where k is the same thing in both, such as one seed's policies under two
    conditions (own and foreign opponents, estimate and truth). Two algorithms trained with the same seed number are no
    pair: they share the first random numbers, and soon nothing but those.

    With one seed on a side (or one pair) there is a difference, but no interval and no p-value: nan. Where neither side
    varies at all the interval has no width, and p is 0, or 1 if the means are equal: the limit of little variance.

    Args:
        a, b: [seeds, ...], [other seeds, ...], equal in the trailing axes; a learning curve is tested at each point.

    Raises:
        ValueError: no seeds, shapes that do not go together, impossible confidence.

    Example:
        >>> found = compare(np.array([3.0, 4.0, 5.0]), np.array([1.0, 1.5, 2.0, 1.5]))
        >>> float(found.difference), bool(found.clear)
        (2.5, True)
    """
    a, b = samples(a, 0, confidence), samples(b, 0, confidence)
    if a.shape[1:] != b.shape[1:]:
        raise ValueError(f"a [seeds, ...] and b differ in the trailing axes: {a.shape}, {b.shape}")
    if paired and len(a) != len(b):
        raise ValueError(f"paired samples have equal numbers: {len(a)}, {len(b)}")
    difference = a.mean(axis=0) - b.mean(axis=0)
    if min(len(a), len(b)) == 1:
        nothing = np.full_like(difference, np.nan)
        return Comparison(difference, nothing, nothing, nothing, len(a), len(b))
    import scipy.stats  # slow to import, and only tests need it

    with warnings.catch_warnings(), np.errstate(all="ignore"):  # no variance: put right below
        warnings.simplefilter("ignore", RuntimeWarning)
        test = scipy.stats.ttest_rel(a, b) if paired else scipy.stats.ttest_ind(a, b, equal_var=False)
        low, high = test.confidence_interval(confidence)
    still = np.ptp(a - b, axis=0) == 0 if paired else (np.ptp(a, axis=0) == 0) & (np.ptp(b, axis=0) == 0)
    low, high = (np.where(still, difference, end) for end in (low, high))
    p = np.where(still, np.where(difference == 0, 1.0, 0.0), test.pvalue)
    return Comparison(difference, low, high, p, len(a), len(b))


def samples(values: np.ndarray, axis: int, confidence: float = 0.95) -> np.ndarray:
    """float64 values with the seeds in front. Raises ValueError for what no interval can be had of."""
    values = np.asarray(values, dtype=float)
    if values.ndim == 0 or values.shape[axis] == 0:
        raise ValueError(f"no seeds along axis {axis} of values of shape {values.shape}")
    if not 0 < confidence < 1:
        raise ValueError(f"confidence={confidence!r}: must lie between 0 and 1")
    return np.moveaxis(values, axis, 0)
