"""The study of estimators on made-up evaluations: which rows are whose, the bias, and what is claimed."""

import numpy as np
import pictures
import pytest

from experiments import estimators, evaluations, study, tidy, verdict
from experiments.study import StudyOptions
from experiments.tidy import Table
from matd3_jax import config
from matd3_jax.core import critics

written = pytest.fixture(pictures.written)

STEPS = np.array([0, 100_000, 200_000, 300_000])
SEEDS = 4
NAMES = list(estimators.ESTIMATORS)


def made_up(bias):
    """Every estimator's true value is -20 and its return 10 times its number; `bias` [%] by name, from late on."""
    parts = []
    for task in estimators.TASKS:
        for k, name in enumerate(NAMES):
            keys = study.key_values(estimators.KEYS, estimators.line(task, name))
            for seed in range(SEEDS):
                rows = {key: np.full(len(STEPS), value) for key, value in keys.items()}
                rows |= {"seed": np.full(len(STEPS), seed), "step": STEPS, "updates": STEPS // 4}
                over = np.array([np.nan, 500.0, 500.0, bias[name] + seed - 1.5])
                rows |= {"q_true": np.full(len(STEPS), -20.0), "q_estimate": -20 + 0.2 * over}
                parts.append(Table({**rows, evaluations.RETURN: np.full(len(STEPS), 10.0 * k + 0.1 * seed)}))
    return tidy.concatenate(parts)


@pytest.fixture(scope="module")
def table():
    return made_up({name: 8.0 - 2 * k for k, name in enumerate(NAMES)})


def test_bias_is_late_and_relative(table):
    for task in estimators.TASKS:
        for k, name in enumerate(NAMES):
            found = estimators.bias(estimators.part(table, task, name))
            np.testing.assert_allclose(found, (8 - 2 * k + np.arange(SEEDS) - 1.5) / 100)


def test_what_is_claimed(table, tmp_path):
    claims = estimators.claims(table)
    each = len(NAMES)  # the trend, and every estimator but MATD3's against that
    assert len(claims) == each * len(estimators.TASKS)
    # Biases of 8, 6, 4 and 2 % with 1, 2, 3 and 5 critics: least squares, by hand -13 / 8.75.
    assert claims[0].difference.estimate == pytest.approx(0.13 / 8.75) and claims[0].verdict == "same"
    assert [claim.difference.estimate for claim in claims[1:each]] == pytest.approx([-10, 10, 20, 30, 40, 50, 60])
    words = verdict.lines(claims)[2]
    assert "1: +8.0 %, 2: +6.0 %, 3: +4.0 %, 5: +2.0 % | +0.01486 (" in words, words
    rising = made_up({name: 2.0 * k for k, name in enumerate(NAMES)})
    assert estimators.claims(rising)[0].verdict == "opposite"
    assert all(claim.verdict == "not yet run" for claim in estimators.claims(Table({})))
    assert len(estimators.details(table)) == 2 + 2 * len(NAMES) + 2
    assert "| half_cheetah | REDQ, 2 of 5 | 4 | 300,000 | 0" in "\n".join(estimators.details(table))


def test_each_estimator_stands_at_its_bias_and_return(table, written, tmp_path):
    estimators.draw(table, tmp_path / "figure.png")
    for axis in written[tmp_path / "figure.png"].axes:
        assert [text.get_text() for text in axis.get_legend().get_texts()] == NAMES
        looks = set()
        for k, (point, _, _) in enumerate(axis.containers):
            assert point.get_xydata()[0] == pytest.approx((8 - 2 * k, 10 * k + 0.15))
            looks.add((point.get_color(), point.get_marker()))
        assert len(looks) == len(axis.containers) == len(NAMES)


def test_settings_are_what_their_names_say():
    found = {}
    for label, line in estimators.settings("paper", StudyOptions()).items():
        algorithm = config.load(line).algo.algorithm()
        found[label.split("-", 1)[1]] = algorithm
        target = critics.of_target(algorithm)
        assert algorithm.name == "matd3" and algorithm.policy_delay == 2 and target.num_critics <= algorithm.num_critics
    assert critics.of_target(found["REDQ_2_of_5"]).num_critics == 2
    assert [found[f"minimum_of_{n}"].num_critics for n in (2, 3, 5)] == [2, 3, 5]
    assert [found[f"TQC_{n}_of_25_dropped"].dropped_quantiles for n in (0, 2, 5)] == [0, 2, 5]
    assert all(found[f"TQC_{n}_of_25_dropped"].critic_quantiles == 25 for n in (0, 2, 5))
