"""Statistics over seeds."""

import numpy as np
from scipy.special import stdtrit


def mean_interval(values: np.ndarray, axis: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Mean over `axis` (seeds) and the half width of its 95 % confidence interval (Student's t); NaN for one seed."""
    n = values.shape[axis]
    mean = values.mean(axis=axis)
    if n == 1:
        return mean, np.full_like(mean, np.nan, dtype=float)
    return mean, stdtrit(n - 1, 0.975) * values.std(axis=axis, ddof=1) / np.sqrt(n)


def welch_interval(a: np.ndarray, b: np.ndarray) -> float:
    """Half width of the 95 % confidence interval of the difference of the means of a [n] and b [m] (Welch)."""
    va, vb = a.var(ddof=1) / len(a), b.var(ddof=1) / len(b)
    freedom = (va + vb) ** 2 / (va**2 / (len(a) - 1) + vb**2 / (len(b) - 1))
    return float(stdtrit(freedom, 0.975) * np.sqrt(va + vb))
