"""Numbers and words of overestimation: columns against SciPy, summaries and lines by hand."""

import re

import numpy as np
import pytest
import scipy.stats
from ledger import HYPER
from overestimation_cases import metrics_of

from matd3_jax.core.q_bias import Values
from matd3_jax.runs import overestimation


def test_columns():
    """Means over the pairs and Student's intervals, for each seed and agent."""
    rng = np.random.default_rng(7)
    estimate, truth = rng.normal(size=(2, 3, 10, 2))
    got = overestimation.columns(("a", "b"), Values(estimate, truth), 3)
    assert set(got) == {f"{agent}_{name}" for agent in "ab" for name in overestimation.COLUMNS}
    for i, agent in enumerate("ab"):
        np.testing.assert_allclose(got[f"{agent}_q_estimate"], estimate[:, :, i].mean(axis=1))
        for name, values in (("q_true", truth), ("overestimation", estimate - truth)):
            low, high = scipy.stats.ttest_1samp(values[:, :, i], 0, axis=1).confidence_interval(0.95)
            np.testing.assert_allclose(got[f"{agent}_{name}"], (low + high) / 2)
            np.testing.assert_allclose(got[f"{agent}_{name}_interval"], (high - low) / 2)
    none = overestimation.columns(("a", "b"), None, 3)
    assert list(none) == list(got) and np.isnan(list(none.values())).all()


@pytest.mark.parametrize(("gamma", "steps", "words"), [
    (0.95, 100, None),
    (np.array([0.95, 0.99]), 100, "leaves out 37 % .*; diagnostics.q_bias_steps=390 leaves out 2 %"),
    (0.99, 390, None),
    (1.0, 1000, r"leaves out 100 % .*positive$"),
])  # fmt: skip
def test_too_short_rollouts_are_reported(gamma, steps, words):
    note = overestimation.tail_note([HYPER._replace(gamma=0.5), HYPER._replace(gamma=gamma)], steps)
    assert (note is None) if words is None else re.search(words, note)


@pytest.mark.parametrize("seeds", [1, 2])
def test_summary_and_lines_of_any_number_of_seeds(seeds):
    """One seed: the interval is that of its pairs."""
    metrics = metrics_of(seeds)
    assert overestimation.summary(metrics, "c")["c"]["overestimation_mean"][0] == 13  # not the untrained critics' 11
    head, *lines = overestimation.lines(metrics, "abc", 200)
    assert ("200 rollouts)" if seeds == 1 else "2 seeds)") in head
    assert lines[0] == f"  a: estimate 3, truth 4, overestimation 6 ± {'7' if seeds == 1 else '0'}"
    steps, values = overestimation.team_values(metrics, ["a", "b"], "q_true")
    np.testing.assert_array_equal(steps, [10, 30])
    np.testing.assert_array_equal(values, [[4.5, 6.5]] * seeds)
