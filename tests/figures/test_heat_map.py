"""The heat map of a cross-play: colors, words and frames of its cells, in the figure and in the file's pixels."""

import matplotlib.image
import numpy as np
import pictures
import pytest

from matd3_jax.evaluation.cross_play_table import Pairings, pairs_of
from matd3_jax.figures import heat_map

RUNS, SEEDS = ("one", "other", "third"), 2


@pytest.fixture
def pairings() -> Pairings:
    """Three runs of two seeds, each with each: the agents get 10 i + j, the adversaries its negative; seeds that
    were trained together have a hundred more."""
    runs, seeds = [], []
    for i in range(len(RUNS)):
        for j in range(len(RUNS)):
            found = pairs_of(SEEDS, SEEDS, matched=False)
            runs += [(i, j)] * len(found)
            seeds += found.tolist()
    runs, seeds = np.array(runs), np.array(seeds)
    own = (runs[:, 0] == runs[:, 1]) & (seeds[:, 0] == seeds[:, 1])
    agents = 10.0 * runs[:, 0] + runs[:, 1] + 100 * own
    return Pairings(runs, seeds, np.stack([agents, -agents], axis=1), matched=False)


def test_every_cell_has_the_color_and_the_words_of_its_mean(pairings, monkeypatch, tmp_path):
    figures, path = pictures.written(monkeypatch), tmp_path / "heat_map.png"
    heat_map.draw(path, RUNS, pairings, "title")
    figure = figures[path]
    means = np.array([[10.0 * i + j for j in range(3)] for i in range(3)])  # of the others, not of one's own
    pixels = matplotlib.image.imread(path)
    for axis, sign, team in zip(figure.axes[:2], (1, -1), ("agents", "adversaries"), strict=True):
        assert axis.get_title() == f"return of {team}"
        assert axis.get_xlabel() == "adversaries of" and axis.get_ylabel() == "agents of"
        assert [label.get_text() for label in axis.get_xticklabels()] == list(RUNS)
        assert [label.get_text() for label in axis.get_yticklabels()] == list(RUNS)
        (image,) = axis.images
        np.testing.assert_array_equal(image.get_array(), sign * means)
        words = {text.get_position(): text.get_text() for text in axis.texts}
        assert len(words) == 9
        for i in range(3):
            for j in range(3):
                lines = words[j, i].split("\n")  # x is the column
                assert float(lines[0]) == sign * means[i, j]
                assert [line for line in lines if line.startswith("own")] == (
                    [f"own {sign * (100 + means[i, i]):.2f}"] if i == j else []
                )
        framed = {tuple(np.round(patch.get_xy()).tolist()) for patch in axis.patches}
        assert framed == {(0, 0), (1, 1), (2, 2)}
        # The file: next to a cell's corner is nothing but its color; rows run downwards.
        for i in range(3):
            for j in range(3):
                x, y = axis.transData.transform((j - 0.4, i - 0.4))
                found = pixels[round(len(pixels) - 1 - y * 120 / figure.dpi), round(x * 120 / figure.dpi), :3]
                wanted = image.cmap(image.norm(sign * means[i, j]))[:3]
                np.testing.assert_allclose(found, wanted, atol=0.02, err_msg=f"{team}, {i}, {j}")
