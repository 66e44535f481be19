"""Who copied whom in a population, and what hyper-parameters everybody had: the table `pbt.csv` of a sweep."""

import csv
import dataclasses
import io
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from matd3_jax.errors import UserError
from matd3_jax.runtime import files

FILE = "pbt.csv"
BEFORE, AFTER = ("step", "seed", "setting", "parent"), ("score",)
"""Columns around those of the swept keys."""


class Stage(NamedTuple):
    """Hyper-parameters that networks were trained with from an env step on, and the setting in whose run."""

    step: int
    setting: str
    values: tuple[str, ...]

    def facts(self, keys: Sequence[str]) -> dict[str, int | str]:
        """As JSON has it; keys: what the values are of."""
        return {"step": self.step, "setting": self.setting, **dict(zip(keys, self.values, strict=True))}


@dataclasses.dataclass
class Lineage:
    """Of all populations of a sweep, at the start and after each selection.

    Attributes:
        keys: the swept keys.
        settings: names of the members of a population.
        seeds: numbers of the populations.
        steps: [selections] env steps.
        parents: [selections][settings, seeds] whose networks a member has from then on, by places in `settings`.
        values: [selections][settings][seeds] values of `keys` from then on, in Hydra's grammar.
        scores: [selections][settings, seeds] by which was selected; nan of those that had diverged.
    """

    keys: tuple[str, ...]
    settings: tuple[str, ...]
    seeds: tuple[int, ...]
    steps: list[int] = dataclasses.field(default_factory=list)
    parents: list[np.ndarray] = dataclasses.field(default_factory=list)
    values: list[list[list[tuple[str, ...]]]] = dataclasses.field(default_factory=list)
    scores: list[np.ndarray] = dataclasses.field(default_factory=list)

    def add(self, step: int, parents: np.ndarray, values: list[list[tuple[str, ...]]], scores: np.ndarray) -> None:
        """Note a selection."""
        self.steps.append(step)
        self.parents.append(parents)
        self.values.append(values)
        self.scores.append(scores)

    def copied(self) -> dict[str, dict[int, int]]:
        """For each setting and seed, by their names and numbers, the env step at which it last copied another."""
        found: dict[str, dict[int, int]] = {}
        for step, parents in zip(self.steps, self.parents, strict=True):
            moved = parents != np.arange(len(self.settings))[:, None]
            for k, s in np.argwhere(moved):
                found.setdefault(self.settings[k], {})[self.seeds[s]] = step
        return found

    def schedule(self, setting: int, seed: int) -> list[Stage]:
        """What the networks that a member has now were trained with, from the start on, through all copies.

        Args:
            setting, seed: places.
        """
        found: list[Stage] = []
        for step, parents, values in zip(self.steps[::-1], self.parents[::-1], self.values[::-1], strict=True):
            found.append(Stage(step, self.settings[setting], values[setting][seed]))
            setting = int(parents[setting, seed])
        found.reverse()
        return [one for k, one in enumerate(found) if not k or one[1:] != found[k - 1][1:]]

    # ---- the table ---------------------------------------------------------------------------------------------------

    def table(self) -> list[list[str]]:
        """Rows of the table, the columns' names first."""
        rows = [[*BEFORE, *self.keys, *AFTER]]
        for step, parents, values, scores in zip(self.steps, self.parents, self.values, self.scores, strict=True):
            for (k, s), parent in np.ndenumerate(parents):
                who = [str(step), str(self.seeds[s]), self.settings[k], self.settings[parent]]
                rows.append([*who, *values[k][s], f"{scores[k, s]:.9g}"])
        return rows

    def write(self, path: Path) -> None:
        """Leave the table."""
        files.write_csv(path, self.table())

    @classmethod
    def of_table(cls, rows: Sequence[Sequence[str]]) -> "Lineage":
        """What `table` gave. Raises ValueError, LookupError for anything else."""
        header, *body = rows
        keys = tuple(header[len(BEFORE) : -len(AFTER)])
        if [*BEFORE, *keys, *AFTER] != list(header) or not body:
            raise ValueError("it has other columns, or no rows")
        settings = tuple(dict.fromkeys(row[2] for row in body))
        seeds = tuple(dict.fromkeys(int(row[1]) for row in body))
        found, size, number = cls(keys, settings, seeds), len(settings) * len(seeds), len(seeds)
        place = {name: k for k, name in enumerate(settings)}
        for k in range(0, len(body), size):
            part = body[k : k + size]
            who = [(row[2], int(row[1])) for row in part]
            if who != [(name, seed) for name in settings for seed in seeds] or len({row[0] for row in part}) > 1:
                raise ValueError("rows are missing")
            cells = [tuple(row[len(BEFORE) : -1]) for row in part]
            found.add(
                int(part[0][0]),
                np.array([place[row[3]] for row in part]).reshape(len(settings), number),
                [cells[j : j + number] for j in range(0, size, number)],
                np.array([float(row[-1]) for row in part]).reshape(len(settings), number),
            )
        return found

    @classmethod
    def read(cls, path: Path) -> "Lineage":
        """The lineage in a file. Raises UserError where it is not there, or damaged."""
        try:
            return cls.of_table(list(csv.reader(io.StringIO(path.read_text(encoding="utf-8")))))
        except (OSError, ValueError, LookupError, csv.Error) as error:
            raise UserError(f"cannot read the lineage {path}: {error}") from error


def lines(stages: Sequence[Stage], keys: Sequence[str]) -> list[str]:
    """A schedule in words, a line for each stage."""
    values = [", ".join(f"{key}={value}" for key, value in zip(keys, one.values, strict=True)) for one in stages]
    return [f"from env step {one.step:,}: {text} ({one.setting})" for one, text in zip(stages, values, strict=True)]
