"""What a report says of runs, read from their directories."""

import dataclasses
import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from matd3_jax.config import Config, diff
from matd3_jax.runs import alike, directory, divergence
from matd3_jax.runs.directory import RunDirectory
from matd3_jax.runs.divergence import Divergence
from matd3_jax.stats import intervals
from matd3_jax.stats.intervals import Comparison, Estimate

ALL_PAIRS = 6
"""Settings up to which all pairs are compared; of more, the best with each of the others."""


@dataclasses.dataclass(frozen=True)
class Run:
    """One run directory."""

    directory: RunDirectory
    settings: Config
    summary: Mapping[str, Any] | None
    """None where the run has not come to its end."""
    machine: Mapping[str, Any]
    last_step: int
    """Of its metrics table."""

    @property
    def name(self) -> str:
        return str(self.directory.path)


@dataclasses.dataclass(frozen=True)
class Setting:
    """Runs with the same settings, their seeds together."""

    label: str
    settings: Config
    """Of the first run."""
    runs: tuple[Run, ...]
    table: Mapping[str, np.ndarray]
    """Columns [rows] of the metrics table of all seeds."""
    diverged: Mapping[int, Divergence]
    """Seeds that have, by their numbers."""

    @property
    def seeds(self) -> list[int]:
        return [int(seed) for seed in np.unique(self.table["seed"])]

    @property
    def teams(self) -> list[str]:
        return [name.removeprefix("return_") for name in self.table if name.startswith("return_")]

    @property
    def end(self) -> float:
        """The env step up to which all seeds that did not diverge have come."""
        sound = divergence.without(self.table, self.diverged)
        ends = [sound["step"][sound["seed"] == seed].max() for seed in np.unique(sound["seed"])]
        return float(min(ends, default=self.table["step"].max(initial=0)))

    def final(self, column: str) -> np.ndarray:
        """Of each seed that did not diverge, [seeds]: the mean of a column over the last tenth of the run, where it is
        of evaluations its last value. Seeds without one are left out."""
        sound, found = divergence.without(self.table, self.diverged), []
        for seed in np.unique(sound["seed"]):
            own = (sound["seed"] == seed) & (sound["step"] <= self.end) & ~np.isnan(sound[column])
            values = sound[column][own]
            if column.startswith("eval_"):
                values = values[-1:]
            else:
                values = values[sound["step"][own] > 0.9 * self.end]
            if values.size:
                found.append(values.mean())
        return np.array(found)

    def estimate(self, column: str) -> Estimate | None:
        """Mean of `final` with its 95 % interval; None where no seed has a value."""
        values = self.final(column) if column in self.table else np.array([])
        return intervals.t_interval(values) if values.size else None


@dataclasses.dataclass(frozen=True)
class Difference:
    """Of the final values of two settings."""

    a: Setting
    b: Setting
    column: str
    found: Comparison


def read(paths: Sequence[Path]) -> list[Setting]:
    """Settings of runs, in the order of the runs.

    Raises UserError where there is no run, or no metrics yet, or two runs have the same seed of the same settings.
    """
    groups = alike.groups(paths)
    labels = diff.label_differences(list(groups.values()))
    found = []
    for label, (members, settings) in zip(labels, groups.items(), strict=True):
        table = directory.together(members)
        runs = tuple(map(_run, members))
        lost = divergence.of_table(table)
        for run in runs:
            lost = divergence.earliest(lost, _said(run))
        found.append(Setting(label, settings, runs, table, lost))
    return found


def columns(settings: Sequence[Setting]) -> list[str]:
    """The returns of which there are final values: of each team in training, then in evaluations."""
    names = [f"{kind}return_{team}" for kind in ("", "eval_") for one in settings for team in one.teams]
    return [name for name in dict.fromkeys(names) if any(name in one.table for one in settings)]


def differences(settings: Sequence[Setting], column: str) -> list[Difference]:
    """Pairs of settings: all of them, or the best with each other one where there are more than `ALL_PAIRS`."""
    there = [one for one in settings if column in one.table and one.final(column).size]
    pairs = list(itertools.combinations(there, 2))
    if len(there) > ALL_PAIRS:
        best = max(there, key=lambda one: one.final(column).mean())
        pairs = [(best, one) for one in there if one is not best]
    return [Difference(a, b, column, intervals.compare(a.final(column), b.final(column))) for a, b in pairs]


def _run(path: Path) -> Run:
    run, settings = RunDirectory.open(path)
    last = int(run.read_metrics()["step"].max(initial=0))
    return Run(run, settings, run.summary(), run.machine(), last)


def _said(run: Run) -> dict[int, Divergence]:
    """Seeds whose divergence only the summary knows: of networks that are not finite."""
    said = (run.summary or {}).get("diverged")
    if not isinstance(said, dict):
        return {}
    there = {int(seed): step for seed, step in said.items() if seed.isdecimal() and isinstance(step, int)}
    return {seed: Divergence(step, divergence.NETWORKS) for seed, step in there.items()}
