"""The picture of populations: colors of who diverged, values that are no numbers, logarithmic scales, many populations.

What it shows of a sweep is in tests/sweep/test_population_runs.py.
"""

import numpy as np
import pictures
import pytest

from matd3_jax.figures import lineage as figure
from matd3_jax.figures import style
from matd3_jax.sweep.lineage import Lineage

written = pytest.fixture(pictures.written)


def made_up(populations, scores):
    found = Lineage(("algo.lr", "noise"), ("a", "b"), tuple(range(populations)))
    own = np.tile([[0], [1]], (1, populations))
    found.add(100, own, [[("0.001", "[0,1]")] * populations, [("0.1", "[0,2]")] * populations], scores)
    return found, own


def test_who_diverged_is_vermilion_and_values_have_their_scales(written, tmp_path):
    lineage, own = made_up(1, np.array([[1.0], [2.0]]))
    lineage.add(200, 0 * own, [[("0.001", "[0,1]")], [("0.0012", "[0,2]")]], np.array([[3.0], [np.nan]]))
    figure.draw(tmp_path / "pbt.png", lineage, "return_agents")
    drawn = written[tmp_path / "pbt.png"]
    scores, rate, noise = drawn.axes[:3]
    assert scores.get_ylabel() == "return_agents" and rate.get_ylabel() == "algo.lr"
    np.testing.assert_array_equal(scores.lines[-1].get_data(), [[100, 200], [2, 3]])
    assert rate.get_yscale() == "log" and noise.get_yscale() == "linear"
    assert [label.get_text() for label in noise.get_yticklabels()] == ["[0,1]", "[0,2]"]
    members, copies = (collection.get_segments() for collection in rate.collections)
    np.testing.assert_allclose(members, [[(100, 0.001), (200, 0.001)], [(100, 0.1), (200, 0.1)]])
    np.testing.assert_allclose(copies, [[(160, 0.001), (200, 0.0012)]])
    assert "1 selection; vermilion: diverged" in drawn.get_suptitle()
    assert style.web(style.VERMILION) in pictures.colors(tmp_path / "pbt.png")


def test_the_first_four_populations_are_drawn(written, tmp_path):
    """Before any selection, and where nobody has a score."""
    lineage, _ = made_up(6, np.full((2, 6), np.nan))
    figure.draw(tmp_path / "pbt.png", lineage, "return_agents")
    drawn = written[tmp_path / "pbt.png"]
    titles = [axis.get_title() for axis in drawn.axes if axis.get_title()]
    assert titles == [f"population {k}" for k in range(4)]
    assert drawn.get_suptitle() == "2 members, 0 selections (the first 4 of 6 populations)"
