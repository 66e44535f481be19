"""The study of training against the others' worst case, on made-up returns."""

import itertools

import numpy as np
import pictures
import pytest
from PIL import Image

from experiments import minimax, study
from experiments.tidy import Table
from matd3_jax.evaluation.cross_play_table import Pairings
from matd3_jax.runtime import files

written = pytest.fixture(pictures.written)

NAMES = list(minimax.SETTINGS)
SEEDS = 3


def played(rng):
    """Every seed of every run with every seed of every run: agents gain by their number, lose by their opponent's."""
    pairs = list(itertools.product(range(len(NAMES)), range(SEEDS), range(len(NAMES)), range(SEEDS)))
    runs, seeds = np.array([(i, j) for i, _, j, _ in pairs]), np.array([(s, t) for _, s, _, t in pairs])
    returns = np.array([(10 * i - j, j - 2 * i) for i, _, j, _ in pairs]) + rng.normal(scale=0.5, size=(len(pairs), 2))
    return Pairings(runs, seeds, returns, matched=False)


def test_differences_are_those_of_strangers():
    """By hand: the mean over all opponents' cells without the pairs that were trained together."""
    pairings = played(np.random.default_rng(0))
    for plus, minus, team in ((1, 0, 0), (5, 3, 1), (2, 0, 0)):

        def mean(one, team=team):
            cells = []
            for other in range(len(NAMES)):
                here = (pairings.runs[:, team] == one) & (pairings.runs[:, 1 - team] == other) & ~pairings.own
                assert here.sum() == (SEEDS**2 - SEEDS if one == other else SEEDS**2)
                cells.append(pairings.returns[here, team].mean())
            return np.mean(cells)

        found = minimax.contrast(pairings, team, plus, minus)
        assert found.estimate == pytest.approx(mean(plus) - mean(minus))
        assert found.low < found.estimate < found.high < found.estimate + 5
    claims = minimax.cross_claims(pairings, NAMES)
    assert [claim.verdict for claim in claims] == ["same"] * len(claims)
    assert all(claim.verdict == "not yet run" for claim in minimax.cross_claims(pairings, NAMES[:1]))


def test_what_was_played_is_read_and_reported(tmp_path, capsys):
    pairings = played(np.random.default_rng(1))
    rows = [("agents", "agents_seed", "adversaries", "adversaries_seed", "return_agents", "return_adversaries")]
    for runs, seeds, returns in zip(pairings.runs, pairings.seeds, pairings.returns, strict=True):
        rows.append((NAMES[runs[0]], seeds[0], NAMES[runs[1]], seeds[1], *(f"{value:.6g}" for value in returns)))
    files.write_csv(tmp_path / "cross_play.csv", rows, line_end="\n")
    again, names = minimax.read(tmp_path)
    assert names == NAMES
    np.testing.assert_array_equal(again.runs, pairings.runs)
    np.testing.assert_allclose(again.returns, pairings.returns, rtol=1e-5)
    minimax.report(tmp_path)
    said = capsys.readouterr().out
    assert said.count("**same**") == 2 * len(minimax.PAIRS) and all(f"against {name}" in said for name in NAMES)
    assert np.asarray(Image.open(tmp_path / "cross_play.png")).std() > 10


def test_settings_are_told_apart_in_the_table(written, tmp_path):
    options = minimax.MinimaxOptions()
    settings = minimax.settings("small", options)
    parts = {name: study.key_values(minimax.KEYS, settings[minimax.label(name)]) for name in NAMES}
    assert [tuple(part.values()) for part in parts.values()] == list(minimax.SETTINGS.values())
    steps, columns = np.arange(5_000, 250_001, 5_000), []
    for k, part in enumerate(parts.values()):
        for seed in range(SEEDS):
            rows = {key: np.full(len(steps), value) for key, value in part.items()}
            rows |= {"seed": np.full(len(steps), seed), "step": steps, "episodes": np.full(len(steps), 200)}
            columns.append(Table({**rows, "return_agents": np.full(len(steps), 10.0 * k + 0.1 * seed)}))
    table = minimax.tidy.concatenate(columns)
    claims = minimax.claims(table)
    assert [claim.difference.estimate for claim in claims] == pytest.approx([10, 20, 10, 20])
    assert all(claim.verdict == "not yet run" for claim in minimax.claims(Table({})))
    minimax.draw(table, tmp_path / "figure.png")
    axis = written[tmp_path / "figure.png"].axes[0]
    drawn = {name: line[1, -1] for name, line in pictures.lines(axis).items()}
    wanted = {f"{name} ({SEEDS} seeds)": 10 * k + 0.1 for k, name in enumerate(NAMES)}
    assert drawn == pytest.approx(wanted)
