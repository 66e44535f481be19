"""Statistics against rliable's recorded values, full enumeration, SciPy, textbook formulae and simulated coverage.

tests/data/rliable.json was made once with rliable 1.2.0 (arch 7.2.0, pandas 2.3, NumPy 2.3), by

    rng = np.random.default_rng(7)
    level = np.array([0.1, 0.5, 0.9, 1.6])
    x = np.round(level + rng.normal(0.1, [0.05, 0.3, 0.1, 0.4], (10, 4)), 2)
    y = np.round(level + rng.standard_t(3, (7, 4)) * [0.05, 0.2, 0.1, 0.3], 2)
    np.random.seed(0)
    four = lambda s: np.array([metrics.aggregate_mean(s), metrics.aggregate_median(s), metrics.aggregate_iqm(s),
                               metrics.aggregate_optimality_gap(s)])
    points, ends = library.get_interval_estimates({"x": x, "y": y, "x_first_task": x[:, :1]}, four, reps=50000)
    improvement = library.get_interval_estimates({"p": (x, y)}, metrics.probability_of_improvement, reps=50000)
    profile, bands = library.create_performance_profile({"x": x, "y": y}, np.linspace(-0.1, 2.5, 14), reps=20000)
"""

import itertools
import json
from pathlib import Path

import numpy as np
import pytest
import scipy.stats

from matd3_jax.stats import bootstrap
from matd3_jax.stats.bootstrap import aggregate, average, performance_profile, probability_of_improvement
from matd3_jax.stats.intervals import compare, mean_interval, t_interval

RLIABLE = json.loads((Path(__file__).parents[1] / "data" / "rliable.json").read_text())
X, Y = np.array(RLIABLE["x"]), np.array(RLIABLE["y"])
SCORES = {"x": X, "y": Y, "x_first_task": X[:, :1]}


def noise(low, high, *resamples):
    """Four standard deviations of the difference of two bootstrap ends made of so many resamples each.

    The p-quantile of B draws has the standard deviation sqrt(p (1 - p) / B) / density; for a bell with these 2.5 % and
    97.5 % points the density there is 0.0584 * 3.92 / (high - low).
    """
    spread = np.sqrt(0.025 * 0.975 * sum(1 / b for b in resamples)) / 0.0584
    return 4 * spread * (np.asarray(high) - np.asarray(low)) / 3.92


# ---- against rliable -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", SCORES)
@pytest.mark.parametrize("kind", RLIABLE["aggregates"])
def test_aggregates_are_rliables(name, kind):
    i = RLIABLE["aggregates"].index(kind)
    found = aggregate(SCORES[name], kind, resamples=20_000)
    low, high = np.array(RLIABLE["ends"][name])[:, i]
    np.testing.assert_allclose(found.value, RLIABLE["points"][name][i], rtol=1e-9)
    tolerance = noise(low, high, 20_000, 50_000)
    assert tolerance < 0.04 * (high - low)
    step = 0.01 / (SCORES[name].size / 2)  # scores go by hundredths, and the interquartile mean is over half of them
    np.testing.assert_allclose([found.low, found.high], [low, high], atol=tolerance + step)


def test_probability_of_improvement_is_rliables():
    value, low, high = RLIABLE["improvement"]
    found = probability_of_improvement(X, Y, resamples=20_000)
    np.testing.assert_allclose(found.value, value, rtol=1e-9)
    # One pair of runs more or less is a step of 1 / (10 * 7 * 4): the true quantile may lie between two.
    np.testing.assert_allclose([found.low, found.high], [low, high], atol=noise(low, high, 20_000, 50_000) + 1 / 280)


@pytest.mark.parametrize("name", ("x", "y"))
def test_performance_profiles_are_rliables(name):
    found = performance_profile(SCORES[name], np.array(RLIABLE["thresholds"]), resamples=20_000)
    low, high = np.array(RLIABLE["bands"][name])
    np.testing.assert_allclose(found.value, RLIABLE["profile"][name], atol=1e-9)
    step = 1.001 / SCORES[name].size  # one run more or less above the threshold
    assert (np.abs(found.low - low) <= step).all() and (np.abs(found.high - high) <= step).all()
    apart = [~np.isclose(found.low, low), ~np.isclose(found.high, high)]
    assert np.sum(apart) <= 4  # and few quantiles are so close to a step


def test_runs_are_drawn_from_their_own_task():
    """Tasks far apart whose runs agree: drawn from all scores together these would have a wide interval."""
    scores = np.array([0.0, 10.0, 50.0]) + np.linspace(0, 0.1, 6)[:, None]
    for kind in ("mean", "median"):
        found = aggregate(scores, kind)
        assert 0 < found.high - found.low < 0.1


# ---- bootstrap of averages -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", bootstrap.AVERAGES)
def test_averages_by_full_enumeration(kind):
    """All 5^5 resamples of five seeds, at two points of a curve; the averages by NumPy and SciPy."""
    values = np.array([[0.3, 9.0], [1.7, -2.0], [0.9, 3.5], [4.1, 0.4], [2.2, 1.1]])
    by = {"mean": np.mean, "median": np.median, "iqm": lambda v, axis: scipy.stats.trim_mean(v, 0.25, axis)}[kind]
    everything = values[np.array(list(itertools.product(range(5), repeat=5)))]
    distribution = by(everything, axis=1)
    found = average(values, kind, resamples=40_000)
    np.testing.assert_allclose(found.value, by(values, axis=0))
    for point in range(2):
        for end, share in ((found.low, 0.025), (found.high, 0.975)):
            # The share of the distribution that lies below the end, or on it: between them must be `share`.
            below, upto = (distribution[:, point] < end[point] - 1e-9), (distribution[:, point] <= end[point] + 1e-9)
            slack = 4 * np.sqrt(0.025 * 0.975 / 40_000)
            assert below.mean() - slack <= share <= upto.mean() + slack


def test_points_of_a_curve_see_the_same_seeds():
    """Two points that differ by a constant have intervals that differ by it; more axes, and another axis of seeds."""
    values = np.random.default_rng(3).normal(size=(6, 4))
    values[:, 1] = values[:, 0] + 5
    found = average(values, "median")
    np.testing.assert_allclose(found.low[1] - found.low[0], 5)
    np.testing.assert_allclose(found.high[1] - found.high[0], 5)
    cube = average(values.T.reshape(2, 2, 6), "median", axis=2)
    for part, flat in zip(cube, found, strict=True):
        np.testing.assert_array_equal(part, flat.reshape(2, 2))
    np.testing.assert_array_equal(average(values, seed=1).low, average(values, seed=1).low)
    assert (average(values, seed=1).low != average(values, seed=2).low).any()


# ---- Student and Welch -----------------------------------------------------------------------------------------------


def test_mean_interval_is_students():
    values = np.random.default_rng(0).normal(3, 2, size=(7, 5))
    found = t_interval(values)
    want = scipy.stats.ttest_1samp(values, 0).confidence_interval(0.95)
    np.testing.assert_allclose([found.low, found.high], want)
    mean, half = mean_interval(values.T, axis=1)
    np.testing.assert_allclose([mean, mean - half], [found.value, found.low])
    wide = t_interval(values, confidence=0.99)
    np.testing.assert_allclose(wide, (found.value, *scipy.stats.ttest_1samp(values, 0).confidence_interval(0.99)))


def test_welch_by_its_formula():
    """Welch's statistic and Satterthwaite's degrees of freedom as the textbooks print them."""
    a, b = np.array([3.1, 4.7, 2.2, 5.9, 4.4]), np.array([1.0, 1.4, 0.2, 8.0, 1.1, 0.9, 1.3])
    va, vb = a.var(ddof=1) / 5, b.var(ddof=1) / 7
    freedom = (va + vb) ** 2 / (va**2 / 4 + vb**2 / 6)
    t = (a.mean() - b.mean()) / np.sqrt(va + vb)
    half = scipy.stats.t(freedom).ppf(0.975) * np.sqrt(va + vb)
    found = compare(a, b)
    assert (found.n_a, found.n_b) == (5, 7)
    np.testing.assert_allclose(found.difference, a.mean() - b.mean())
    np.testing.assert_allclose([found.low, found.high], found.difference + np.array([-half, half]))
    np.testing.assert_allclose(found.p, 2 * scipy.stats.t(freedom).sf(abs(t)))


def test_paired_is_students_test_of_the_differences():
    rng = np.random.default_rng(1)
    a = rng.normal(0, 10, size=(6, 3))
    b = a + rng.normal(1, 0.5, size=(6, 3))
    found, unpaired = compare(a, b, paired=True), compare(a, b)
    want = t_interval(a - b)
    np.testing.assert_allclose([found.difference, found.low, found.high], want)
    np.testing.assert_allclose(found.p, scipy.stats.ttest_1samp(a - b, 0).pvalue)
    assert found.clear.all() and not unpaired.clear.any()


def test_intervals_cover_what_they_promise():
    """10,000 experiments each: 95 % of the intervals hold the true value, one test in twenty errs, up to chance."""
    rng = np.random.default_rng(5)
    few, many = rng.normal(2, 1, size=(4, 10_000)), rng.normal(2, 6, size=(9, 10_000))
    chance = 4 * np.sqrt(0.95 * 0.05 / 10_000)
    found = t_interval(few)
    assert abs(((found.low < 2) & (2 < found.high)).mean() - 0.95) < chance
    for test in (compare(few, many), compare(few, many[:4], paired=True)):
        assert abs(((test.low < 0) & (0 < test.high)).mean() - 0.95) < chance + 0.005  # Welch's is an approximation
        assert abs((test.p < 0.05).mean() - 0.05) < chance + 0.005
        np.testing.assert_array_equal(test.clear, test.p < 0.05)


# ---- edges -----------------------------------------------------------------------------------------------------------


@pytest.mark.filterwarnings("error")
def test_one_seed_has_no_interval():
    for found in (t_interval(np.ones((1, 3))), average(np.ones((1, 3)), "iqm")):
        assert (found.value == 1).all() and np.isnan(found.low).all() and np.isnan(found.high).all()
    found = compare(np.array([3.0]), np.array([1.0, 2.0]))
    assert found.difference == 1.5 and np.isnan([found.low, found.high, found.p]).all() and not found.clear
    # A task with one run alone among others with more: its spread is not known, so neither is that of all.
    found = aggregate([np.array([1.0, 2.0, 3.0]), np.array([4.0])], "mean")
    assert found.value == 3 and np.isnan(found.low)


@pytest.mark.filterwarnings("error")
def test_seeds_that_do_not_vary():
    same, other = np.full(4, 2.0), np.full(3, 1.5)
    assert compare(same, same) == (0, 0, 0, 1, 4, 4)
    assert compare(same, other) == (0.5, 0.5, 0.5, 0, 4, 3)
    assert compare(same, same - 1, paired=True) == (1, 1, 1, 0, 4, 4)
    columns = compare(np.stack([same, [1, 2, 3, 4.0]], axis=1), np.stack([same, [1, 2, 3, 4.0]], axis=1))
    assert columns.p.tolist() == [1, 1] and columns.low[0] == 0 > columns.low[1]
    for found in (average(same, "median"), aggregate(same), t_interval(same)):
        assert found == (2, 2, 2)


@pytest.mark.filterwarnings("error")
def test_a_diverged_seed_is_not_left_out():
    curves = np.array([[1.0, 2.0], [3.0, 5.0], [2.0, np.nan], [2.0, 3.0], [4.0, 1.0]])
    for found in (*(average(curves, kind) for kind in bootstrap.AVERAGES), t_interval(curves), compare(curves, curves)):
        assert np.isfinite([found.low[0], found.high[0]]).all()
        assert np.isnan([found[0][1], found.low[1], found.high[1]]).all()
    assert np.isnan(aggregate(curves)).all()
    # Where scores are only compared, it is worse than all numbers.
    better = probability_of_improvement(np.array([np.nan, 2.0]), np.array([1.0, -1e300]))
    assert better.value == 0.5
    assert probability_of_improvement(np.array([np.nan, 1]), np.array([np.nan, 1])).value == 0.5
    assert performance_profile(np.array([np.nan, 2.0, 3.0, 4.0]), np.array([-1e300, 2.0])).value.tolist() == [0.75, 0.5]


def test_tasks_with_different_numbers_of_runs():
    rng = np.random.default_rng(2)
    x, y = [rng.normal(size=n) for n in (3, 6)], [rng.normal(size=n) for n in (5, 2)]
    assert aggregate(x, "mean").value == pytest.approx((x[0].mean() + x[1].mean()) / 2)
    assert aggregate(x, "iqm").value == pytest.approx(scipy.stats.trim_mean(np.concatenate(x), 0.25))
    u = [scipy.stats.mannwhitneyu(a, b).statistic / (len(a) * len(b)) for a, b in zip(x, y, strict=True)]
    assert probability_of_improvement(x, y).value == pytest.approx(np.mean(u))
    for part, flat in zip(aggregate([1.0, 2.0, 4.0]), aggregate(np.array([[1.0], [2.0], [4.0]])), strict=True):
        assert part == flat


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: mean_interval(np.ones((0, 3))), "no seeds"),
        (lambda: t_interval(np.ones(3), confidence=95), "confidence=95"),
        (lambda: compare(np.ones((3, 2)), np.ones((3, 4))), "trailing axes"),
        (lambda: compare(np.ones(3), np.ones(4), paired=True), "equal numbers: 3, 4"),
        (lambda: average(np.ones(3), "mode"), "mean, median, iqm"),
        (lambda: average(np.ones(3), resamples=0), "resamples=0"),
        (lambda: aggregate(np.ones(3), "mode"), "optimality_gap"),
        (lambda: aggregate(np.ones((2, 3, 4))), r"\[runs, tasks\]"),
        (lambda: aggregate([]), "scores"),
        (lambda: probability_of_improvement(np.ones((3, 2)), np.ones((3, 4))), "2 tasks and y 4"),
        (lambda: performance_profile(np.ones(3), np.array(0.5)), "thresholds"),
    ],
)
def test_impossible_input(call, message):
    with pytest.raises(ValueError, match=message):
        call()
