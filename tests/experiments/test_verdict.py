"""The experiments' tests and words: against numbers that R prints for its own data sets, and case by case."""

import numpy as np
import pytest

from experiments import verdict
from experiments.verdict import Claim, Difference

# Student's sleep data (R: sleep) and the first of Anscombe's quartet (R: anscombe).
SLEEP = (
    np.array([0.7, -1.6, -0.2, -1.2, -0.1, 3.4, 3.7, 0.8, 0.0, 2.0]),
    np.array([1.9, 0.8, 1.1, 0.1, -0.1, 4.4, 5.5, 1.6, 4.6, 3.4]),
)
X = np.array([10.0, 8, 13, 9, 11, 14, 6, 4, 12, 7, 5])
Y = np.array([8.04, 6.95, 7.58, 8.81, 8.33, 9.96, 7.24, 4.26, 10.84, 4.82, 5.68])


def numbers(found):
    return [found.estimate, found.low, found.high, found.p]


def test_tests_agree_with_r():
    # t.test(extra ~ group, data = sleep)
    np.testing.assert_allclose(numbers(verdict.difference(*SLEEP)), [-1.58, -3.3654832, 0.2054832, 0.07939], rtol=1e-3)
    # t.test(group 1 - group 2)
    np.testing.assert_allclose(
        numbers(verdict.mean(SLEEP[0] - SLEEP[1])), [-1.58, -2.4598858, -0.7001142, 0.002833], rtol=1e-3
    )
    pairs = verdict.compare("paper", "extra", ("group 1", SLEEP[0]), ("group 2", SLEEP[1]), paired=True)
    assert pairs.quantity == "extra: group 1 minus group 2, seed by seed" and pairs.verdict == "opposite"
    assert numbers(pairs.difference) == numbers(verdict.mean(SLEEP[0] - SLEEP[1]))
    # cor.test(x1, y1)
    np.testing.assert_allclose(
        numbers(verdict.correlation(X, Y)), [0.8164205, 0.4243912, 0.9506933, 0.00217], rtol=1e-3
    )
    # confint(lm(y1 ~ x1))
    np.testing.assert_allclose(numbers(verdict.slope(X, Y)), [0.5000909, 0.2333701, 0.7668117, 0.00217], rtol=1e-3)
    assert numbers(verdict.negative(verdict.slope(X, Y)))[:3] == pytest.approx([-0.5000909, -0.7668117, -0.2333701])


def test_spreads_are_compared_as_levene_has_it():
    """Brown and Forsythe: Levene's statistic about the medians is the square of the t of equal variances."""
    from scipy import stats

    spreads = [verdict.spread(values) for values in SLEEP]
    t = stats.ttest_ind(*spreads).statistic
    assert t**2 == pytest.approx(stats.levene(*SLEEP, center="median").statistic)
    assert verdict.difference(*spreads).p == pytest.approx(stats.ttest_ind(*spreads, equal_var=False).pvalue)


def test_holm():
    assert verdict.holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    found = verdict.holm([0.6, np.nan, 0.7])
    assert found[::2] == [1.0, 1.0] and np.isnan(found[1])


def test_too_few_seeds_decide_nothing():
    one, two = np.array([1.0]), np.array([1.0, 3.0])
    for found in (verdict.difference(one, two), verdict.mean(one), verdict.correlation(two, two)):
        assert np.isnan([found.low, found.high, found.p]).all()
        for kind in ("greater", "no difference", "no gain"):
            assert Claim("paper", "quantity", found, kind, 10.0).verdict == "not shown"
    diverged = verdict.compare("paper", "return", ("A", np.array([1.0, np.nan])), ("B", two))
    assert diverged.verdict == "not shown"
    # Numbers without any spread are certain.
    assert numbers(verdict.difference(np.full(3, 2.0), np.full(2, 1.0))) == [1, 1, 1, 0]
    assert numbers(verdict.mean(np.zeros(3))) == [0, 0, 0, 1]


@pytest.mark.parametrize(
    ("low", "high", "kind", "word"),
    [
        (0.1, 3.0, "greater", "same"),
        (-0.1, 3.0, "greater", "not shown"),
        (-3.0, -0.1, "greater", "opposite"),
        (-0.9, 0.9, "no difference", "same"),
        (0.1, 0.9, "no difference", "same"),  # significant, but small
        (-0.9, 1.1, "no difference", "not shown"),
        (0.1, 1.1, "no difference", "opposite"),
        (-2.0, -0.1, "no difference", "opposite"),
        (-5.0, 0.9, "no gain", "same"),
        (-5.0, -2.0, "no gain", "same"),
        (-0.1, 1.1, "no gain", "not shown"),
        (0.1, 1.1, "no gain", "opposite"),
    ],
)
def test_the_words(low, high, kind, word):
    claim = Claim("the paper says", "a minus b", Difference((low + high) / 2, low, high, 0.02), kind, margin=1.0)
    assert claim.verdict == word
    row = verdict.lines([claim, Claim("other", "quantity")])[2]
    assert f"| **{word}** |" in row and f"({low:g} to {high:g})" in row
    assert ("margin 1" in row) == (kind != "greater")


def test_lines():
    claims = [
        verdict.compare("A is better", "return", ("A", SLEEP[1]), ("B", SLEEP[0])),
        Claim("never tried", "quantity"),
        Claim("better again", "quantity", Difference(1500.0, 1200.0, 1800.0, 0.00002)),
        Claim("humanoid 9|8", "quantity"),
    ]
    lines = verdict.lines(claims)
    assert lines[2] == (
        "| A is better | return: A minus B | A 2.33 (n = 10), B 0.75 (n = 10) | +1.58 (-0.2055 to 3.365) | 0.079 "
        "| 0.079 | **not shown** |"
    )
    assert lines[3].endswith("| — | — | — | — | **not yet run** |")
    assert "| +1,500 (1,200 to 1,800) | < 0.0001 | < 0.0001 | **same** |" in lines[4]
    assert lines[5].startswith("| humanoid 9\\|8 | quantity | — |")  # no column more
