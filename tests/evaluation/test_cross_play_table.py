"""Means over pairs and their intervals: against formulas for the plain cases, the jackknife done slowly, and by how
often they hold what they should."""

import numpy as np
import pytest
from scipy.stats import t as student

from matd3_jax.evaluation.cross_play_table import Pairings, pairs_of
from matd3_jax.stats.intervals import mean_interval


def everybody(seeds, matched=False, rng=None):
    """Pairings of runs with so many seeds each; returns at random."""
    cells = [(i, j, pairs_of(n, m, matched)) for i, n in enumerate(seeds) for j, m in enumerate(seeds)]
    runs = np.concatenate([np.broadcast_to((i, j), pairs.shape) for i, j, pairs in cells])
    places = np.concatenate([pairs for _, _, pairs in cells])
    returns = (rng or np.random.default_rng(0)).normal(size=(len(runs), 2))
    return Pairings(runs, places, returns, matched)


def slowly(pairings, cells):
    """[teams] half width by the jackknife, one sum after the other. cells: rows of each cell."""

    def mean(gone):
        values = []
        for cell in cells:
            kept = [
                pairings.returns[r]
                for r in cell
                if all(who != gone for who in zip(pairings.runs[r], pairings.seeds[r], strict=True))
            ]
            values.append(sum(kept) / len(kept))
        return sum(values) / len(values)

    playing = {who for cell in cells for r in cell for who in zip(pairings.runs[r], pairings.seeds[r], strict=True)}
    parts = {}
    for run in {run for run, _ in playing}:
        without = [mean(who) for who in playing if who[0] == run]
        n = len(without)
        parts[run] = n, (n - 1) / n * sum((w - sum(without) / n) ** 2 for w in without)
    variance = sum(v for _, v in parts.values())
    freedom = variance**2 / sum(v**2 / (n - 1) for n, v in parts.values())
    return student.ppf(0.975, freedom) * np.sqrt(variance)


def rows(pairings, i, j, own):
    return [
        r
        for r, (runs, seeds) in enumerate(zip(pairings.runs, pairings.seeds, strict=True))
        if tuple(runs) == (i, j) and own == (i == j and seeds[0] == seeds[1])
    ]


def test_pairs():
    assert pairs_of(2, 3, False).tolist() == [[0, 0], [0, 1], [0, 2], [1, 0], [1, 1], [1, 2]]
    assert pairs_of(3, 3, True).tolist() == [[0, 0], [1, 1], [2, 2]]


def test_own_and_matched_are_t_intervals():
    """One value a seed: the mean and Student's interval, as everywhere else."""
    pairings = everybody([4, 5])
    matched = everybody([5, 5, 5], matched=True)
    for found, table, chosen in [
        (pairings.cell(1, 1, own=True), pairings, rows(pairings, 1, 1, True)),
        (matched.cell(0, 2, own=False), matched, rows(matched, 0, 2, False)),
    ]:
        mean, half = mean_interval(table.returns[chosen])
        assert found.pairs == 5
        np.testing.assert_allclose(found.value, mean)
        np.testing.assert_allclose(found.half, half)
    # Of all runs, place by place: what shares a seed's number is one value.
    found = matched.summary(None, None, own=False)
    by_place = np.stack([matched.returns[~matched.own & (matched.seeds[:, 0] == k)].mean(axis=0) for k in range(5)])
    np.testing.assert_allclose(found.half, mean_interval(by_place)[1])
    assert matched.cell(0, 0, own=False) is None and matched.cell(0, 1, own=True) is None


def test_seeds_by_seeds():
    """Two runs: variances of the row means and of the column means, freedom by Welch and Satterthwaite."""
    pairings = everybody([4, 7])
    v = pairings.returns[rows(pairings, 0, 1, False)].reshape(4, 7, 2)
    found = pairings.cell(0, 1, own=False)
    a, b = v.mean(axis=1).var(axis=0, ddof=1) / 4, v.mean(axis=0).var(axis=0, ddof=1) / 7
    half = student.ppf(0.975, (a + b) ** 2 / (a**2 / 3 + b**2 / 6)) * np.sqrt(a + b)
    np.testing.assert_allclose(found.value, v.mean(axis=(0, 1)))
    np.testing.assert_allclose(found.half, half)
    assert found.pairs == 28


def test_every_mean_of_the_table():
    """A run against itself, one against all, all against all: by the slow jackknife, every cell weighing the same."""
    pairings = everybody([3, 4, 5])
    table = {(row.agents, row.adversaries, row.own): row.mean for row in pairings.table()}
    assert len(table) == 9 + 3 + 2 * (3 + 3 + 1)
    for (i, j, own), mean in table.items():
        runs = [range(3) if run is None else [run] for run in (i, j)]
        cells = [c for c in (rows(pairings, a, b, own) for a in runs[0] for b in runs[1]) if c]
        value = np.mean([pairings.returns[cell].mean(axis=0) for cell in cells], axis=0)
        np.testing.assert_allclose(mean.value, value, err_msg=f"{i} {j} {own}")
        np.testing.assert_allclose(mean.half, slowly(pairings, cells), err_msg=f"{i} {j} {own}")
        assert mean.pairs == sum(map(len, cells))


def test_too_few_seeds_have_no_interval():
    pairings = everybody([1, 3, 2])
    for i, j, own, known in [(0, 0, True, False), (0, 1, False, False), (2, 2, True, True), (2, 2, False, False)]:
        found = pairings.cell(i, j, own)
        assert np.isfinite(found.value).all() and np.isfinite(found.half).all() == known
    assert pairings.cell(0, 0, own=False) is None


@pytest.mark.parametrize("case", ["two runs", "a run against itself", "all runs"])
def test_intervals_hold_the_mean(case):
    """Of 95 % intervals some 95 % hold the true mean, with five seeds, teams and opponents of different strength
    that, trained together, go together. Intervals as if pairs were independent hold it in a third to two thirds."""
    rng, held, naive, trials = np.random.default_rng(1), 0, 0, 600
    pairings = everybody([5, 5, 5])
    i, j = {"two runs": (0, 1), "a run against itself": (1, 1), "all runs": (None, None)}[case]
    for _ in range(trials):
        agents = rng.normal(size=(3, 5, 2))
        adversaries = 0.7 * rng.normal(size=(3, 5, 2)) + 0.5 * agents
        strength = agents[pairings.runs[:, 0], pairings.seeds[:, 0]]
        strength = strength + adversaries[pairings.runs[:, 1], pairings.seeds[:, 1]]
        played = pairings._replace(returns=strength + 0.5 * rng.normal(size=strength.shape))
        found = played.summary(i, j, own=False)
        held += (np.abs(found.value) <= found.half).sum()
        chosen = ~pairings.own if i is None else rows(pairings, i, j, False)
        naive += (np.abs(found.value) <= mean_interval(played.returns[chosen])[1]).sum()
    # 1200 values: three standard deviations of a share of 0.95 are 0.02; a little conservative by construction.
    assert 0.925 < held / (2 * trials) < 0.985
    assert naive / (2 * trials) < 0.75
