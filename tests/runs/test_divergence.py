"""Which entries of a metrics table are numbers that are not finite, and which are merely missing."""

import numpy as np
import pytest

from matd3_jax.runs import divergence
from matd3_jax.runs.divergence import Divergence

NAN, INF = np.nan, np.inf


def table(**changes):
    """Two seeds, four rows each: the warm-up, two intervals, of which the first ends no episode, an evaluation last."""
    columns = {
        "step": [100, 200, 300, 400],
        "updates": [0, 10, 20, 30],
        "episodes": [4, 0, 4, 4],
        "episode_length": [25, NAN, 25, 25],
        "return_agents": [1, NAN, 2, 3],
        "a_return": [1, NAN, 2, 3],
        "a_critic_loss": [NAN, 1, 1, 1],
        "a_q_value": [NAN, 1, 1, 1],
        "a_actor_loss": [NAN, NAN, 1, NAN],
        "eval_return_agents": [1, NAN, NAN, 1],
        "eval_episode_length": [25, NAN, NAN, 25],
        "a_eval_return": [1, NAN, NAN, 1],
        "a_q_estimate": [NAN, NAN, NAN, NAN],
        "eval_forward_velocity": [NAN, NAN, NAN, NAN],
    }
    rows = {name: np.repeat(np.array(values, float), 2) for name, values in columns.items()}
    rows["seed"] = np.tile([5.0, 6.0], 4)
    for name, (row, value) in changes.items():
        rows[name][2 * row + 1] = value
    return rows


def test_what_is_missing_is_no_divergence():
    assert divergence.of_table(table()) == {}


@pytest.mark.parametrize(
    ("name", "row", "value"),
    [
        *((name, row, value) for name in ("a_critic_loss", "a_q_value") for row in (1, 3) for value in (NAN, -INF)),
        *(("return_agents", row, value) for row in (0, 2) for value in (NAN, INF)),
        ("a_return", 2, NAN),
        ("a_actor_loss", 1, INF),
        ("eval_return_agents", 0, NAN),
        ("a_eval_return", 3, INF),
    ],
)
def test_a_number_that_is_not_finite_is_one(name, row, value):
    found = divergence.of_table(table(**{name: (row, value)}))
    assert found == {6: Divergence(100 * (row + 1), f"{name} is {value}")}


def test_the_first_counts():
    both = table(a_critic_loss=(2, NAN), return_agents=(3, NAN))
    assert divergence.of_table(both) == {6: Divergence(300, "a_critic_loss is nan")}
    networks = divergence.of_networks(np.array([False, False]), [5, 6], 400)
    found = divergence.earliest(networks, divergence.of_table(both))
    assert {seed: one.step for seed, one in found.items()} == {5: 400, 6: 300}


def test_cutting_leaves_counts_and_the_other_seeds():
    metrics = table(a_critic_loss=(2, NAN))
    cut = divergence.cut(metrics, divergence.of_table(metrics))
    lost = (metrics["seed"] == 6) & (metrics["step"] >= 300)
    for name, column in cut.items():
        np.testing.assert_array_equal(column[~lost], metrics[name][~lost])
        if name in ("step", "seed", "updates", "episodes"):
            np.testing.assert_array_equal(column, metrics[name])
        else:
            assert np.isnan(column[lost]).all()
    assert set(divergence.without(metrics, [6])["seed"]) == {5}


def test_in_words():
    lost = {seed: Divergence(100 * seed, "") for seed in range(10, 15)}
    assert divergence.of_seeds(4, {}) == "4 seeds" and divergence.of_seeds(1, {}) == "1 seed"
    assert divergence.of_seeds(4, {2: Divergence(4500, "")}) == "3 of 4 seeds, seed 2 diverged at 4,500"
    assert divergence.which(lost).endswith("seed 12 diverged at 1,200, and 2 more")
