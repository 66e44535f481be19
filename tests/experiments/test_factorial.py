"""Effects of a grid's factors are those of least squares."""

import itertools

import numpy as np
import pytest
from scipy import stats

from experiments import factorial

RNG = np.random.default_rng(3)


def test_of_two_cells_it_is_students_test():
    a, b = RNG.normal(size=5), RNG.normal(1.0, size=7)
    found = factorial.effect({(1.0,): a, (2.0,): b}, 0, 2.0, 1.0)
    wanted = stats.ttest_ind(b, a, equal_var=True)
    low, high = wanted.confidence_interval()
    assert found.p == pytest.approx(wanted.pvalue) and found.estimate == pytest.approx(b.mean() - a.mean())
    assert (found.low, found.high) == pytest.approx((low, high))


def test_of_a_grid_it_is_a_contrast_of_least_squares():
    """Cells of several sizes, one of them missing, one with a seed that diverged."""
    sizes = itertools.cycle([3, 4, 6])
    cells = {
        (x, y): RNG.normal(x * y, 2.0, size=next(sizes)) for x, y in itertools.product((1.0, 2.0, 3.0), (0.1, 0.2, 0.3))
    }
    del cells[2.0, 0.1]
    cells[3.0, 0.2][0] = np.nan
    there = [point for point in cells if point != (3.0, 0.2)]
    rows = [(there.index(point), value) for point in there for value in cells[point]]
    design = np.eye(len(there))[[k for k, _ in rows]]
    y = np.array([value for _, value in rows])
    means, rest, *_ = np.linalg.lstsq(design, y, rcond=None)
    variance = rest[0] / (len(y) - len(there))
    covariance = variance * np.linalg.inv(design.T @ design)
    contrast = np.zeros(len(there))
    for level in (0.2, 0.3):  # where both 2 and 1 are there
        contrast[there.index((2.0, level))] += 0.5
        contrast[there.index((1.0, level))] -= 0.5
    found = factorial.effect(cells, 0, 2.0, 1.0)
    assert found.estimate == pytest.approx(contrast @ means)
    half = stats.t.ppf(0.975, len(y) - len(there)) * np.sqrt(contrast @ covariance @ contrast)
    assert (found.high - found.low) / 2 == pytest.approx(half)


def test_nothing_to_compare():
    assert factorial.effect({}, 0, 2.0, 1.0) is None
    assert factorial.effect({(1.0, 1.0): np.ones(3), (2.0, 2.0): np.ones(3)}, 0, 2.0, 1.0) is None
    assert factorial.effect({(1.0,): np.ones(1), (2.0,): np.ones(1)}, 0, 2.0, 1.0) is None
    assert factorial.neighbors([3.0, 1.0, 2.0, 1.0]) == [(2.0, 1.0), (3.0, 2.0)]
