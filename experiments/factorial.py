"""Effect of one factor of a grid, the others alike."""

from collections.abc import Mapping, Sequence

import numpy as np
from scipy import stats

from experiments.verdict import Difference

Point = tuple[float, ...]


def effect(cells: Mapping[Point, np.ndarray], factor: int, a: float, b: float) -> Difference | None:
    """Mean at value `a` of a factor minus mean at `b`, over all points of the other factors that have both.

    The test is Student's with the variance within cells pooled, as in an analysis of variance with all interactions.

    Args:
        cells: returns [seeds] by point of the grid; a cell with a seed that is nan is left out.
        factor: place of the factor in a point.

    Returns:
        None where no point has both, or no cell has two seeds.
    """
    whole = {point: values for point, values in cells.items() if len(values) and not np.isnan(values).any()}
    pairs = [
        (values, whole[other])
        for point, values in whole.items()
        if point[factor] == a and (other := (*point[:factor], b, *point[factor + 1 :])) in whole
    ]
    # Cells at further values of the factor know the variance, too.
    freedom = sum(len(values) - 1 for values in whole.values())
    if not pairs or not freedom:
        return None
    variance = sum(((values - values.mean()) ** 2).sum() for values in whole.values()) / freedom
    estimate = float(np.mean([x.mean() - y.mean() for x, y in pairs]))
    error = float(np.sqrt(variance * sum(1 / len(x) + 1 / len(y) for x, y in pairs))) / len(pairs)
    half = float(stats.t.ppf(0.975, freedom)) * error
    p = float(2 * stats.t.sf(abs(estimate) / error, freedom)) if error else float("nan")
    return Difference(estimate, estimate - half, estimate + half, p, float(np.sqrt(variance)))


def neighbors(values: Sequence[float]) -> list[tuple[float, float]]:
    """Pairs (larger, next smaller) of the values of a factor, from the smallest on."""
    ordered = sorted(set(values))
    return list(zip(ordered[1:], ordered, strict=False))
