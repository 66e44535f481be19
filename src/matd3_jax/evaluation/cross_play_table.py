"""Who played whom, what came of it, and the means over pairs with intervals that know which pairs share a seed.

In a matrix of seeds x seeds the numbers of a row share a team and those of a column its opponents, so they are not
independent: the interval of a mean is Student's with the standard error of the jackknife that leaves out one trained
seed at a time, on both sides wherever it plays (Efron and Stein 1981; degrees of freedom by Welch and Satterthwaite).
For one value a seed that is the usual t interval. Bootstraps over both sides are too narrow for few seeds: of 95 % some
85 % with four against four.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import stdtrit


class Mean(NamedTuple):
    """Of the returns of both teams over some pairs."""

    value: np.ndarray
    """[teams] (agents, adversaries)"""
    half: np.ndarray
    """[teams] half width of the 95 % interval; nan where a run has too few seeds."""
    pairs: int


class Row(NamedTuple):
    """A mean and what it is of; None: all runs, each weighing the same."""

    agents: int | None
    adversaries: int | None
    own: bool
    """Pairs that were trained together, or pairs that were not."""
    mean: Mean


def pairs_of(agents: int, adversaries: int, matched: bool) -> np.ndarray:
    """Indices [pairs, 2] of the seeds that meet: each with each; matched (of equally many): the first with the first,
    and so on."""
    if matched:
        return np.stack([np.arange(agents), np.arange(adversaries)], axis=1)
    return np.stack(np.meshgrid(np.arange(agents), np.arange(adversaries), indexing="ij"), axis=-1).reshape(-1, 2)


class Pairings(NamedTuple):
    """All that was played, one row for each pair of seeds."""

    runs: np.ndarray
    """[rows, teams] numbers of the agents' run and the adversaries' run."""
    seeds: np.ndarray
    """[rows, teams] indices of the seeds in them."""
    returns: np.ndarray
    """[rows, teams] mean returns over the episodes."""
    matched: bool

    @property
    def own(self) -> np.ndarray:
        """[rows] whether both were trained together: same run, same seed."""
        return (self.runs[:, 0] == self.runs[:, 1]) & (self.seeds[:, 0] == self.seeds[:, 1])

    def cell(self, agents: int, adversaries: int, own: bool) -> Mean | None:
        """Mean over the pairs of two runs, those trained together or the others; None where there are none."""
        return self.mean([self._rows(agents, adversaries, own)])

    def summary(self, agents: int | None, adversaries: int | None, own: bool) -> Mean | None:
        """Mean over the cells of a run (None: of all runs), each weighing the same; None where there are none."""
        numbers = range(int(self.runs.max()) + 1)
        chosen = [numbers if run is None else [run] for run in (agents, adversaries)]
        return self.mean([self._rows(i, j, own) for i in chosen[0] for j in chosen[1]])

    def table(self) -> Iterator[Row]:
        """Every mean: of each two runs, of each run's agents, of each run's adversaries, of all."""
        numbers = range(int(self.runs.max()) + 1)
        which: list[tuple[int | None, int | None]] = [(i, j) for i in numbers for j in numbers]
        which += [(i, None) for i in numbers]
        which += [(None, j) for j in numbers] + [(None, None)]
        for i, j in which:
            for own in (True, False):
                mean = self.summary(i, j, own)
                if mean is not None:
                    yield Row(i, j, own, mean)

    def _rows(self, agents: int, adversaries: int, own: bool) -> np.ndarray:
        return np.flatnonzero((self.runs == (agents, adversaries)).all(axis=1) & (self.own == own))

    def mean(self, cells: Sequence[np.ndarray]) -> Mean | None:
        """Mean of the means of `cells`, each the numbers of its rows; cells without rows do not count."""
        cells = [cell for cell in cells if len(cell)]
        if not cells:
            return None
        variance, squares = np.zeros(2), np.zeros(2)
        for without in self._without(cells):
            n = len(without)
            part = (n - 1) / n * ((without - without.mean(axis=0)) ** 2).sum(axis=0) if n > 1 else np.full(2, np.nan)
            variance += part
            squares += part**2 / max(1, n - 1)
        freedom = np.where(squares > 0, variance**2 / np.where(squares > 0, squares, 1), 1)
        half = np.where(np.isnan(variance), np.nan, stdtrit(freedom, 0.975) * np.sqrt(variance))
        value = np.stack([self.returns[cell].mean(axis=0) for cell in cells]).mean(axis=0)
        return Mean(value, half, sum(map(len, cells)))

    def _without(self, cells: Sequence[np.ndarray]) -> Iterator[np.ndarray]:
        """For each run (matched: for all as one) the mean without each of its seeds that plays in the cells
        [seeds, teams]; nan where that leaves a cell empty."""
        # Matched, everything with the same index shares a seed. Otherwise only the same seed of the same run does.
        strata = np.zeros_like(self.runs) if self.matched else self.runs
        width = int(self.seeds.max()) + 1
        units = strata * width + self.seeds
        size = int(units.max()) + 1

        def by_unit(rows: np.ndarray, weights: np.ndarray) -> np.ndarray:
            """Sum of the weights [rows] over the rows in which a unit plays, on one side or both: [units]."""
            both = units[rows, 0] == units[rows, 1]
            left = np.bincount(units[rows, 0], weights, size)
            return left + np.bincount(units[rows, 1], np.where(both, 0, weights), size)

        means = []
        for cell in cells:
            values = self.returns[cell]
            total = values.sum(axis=0) - np.stack([by_unit(cell, column) for column in values.T], axis=1)
            count = len(cell) - by_unit(cell, np.ones(len(cell)))
            means.append(np.divide(total, count[:, None], out=np.full_like(total, np.nan), where=count[:, None] > 0))
        mean = np.mean(means, axis=0)
        playing = np.unique(units[np.concatenate(cells)])
        for stratum in np.unique(playing // width):
            yield mean[playing[playing // width == stratum]]
