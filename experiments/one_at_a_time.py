"""Studies in which one part of a base is changed at a time: settings, rows, claims, figure and table."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from experiments import evaluations, figures, markdown, study, verdict
from experiments.study import StudyOptions
from experiments.tidy import Table
from experiments.verdict import Claim
from matd3_jax import config
from matd3_jax.figures.style import SERIES
from matd3_jax.stats.text import seeds

QUANTITY = "mean evaluation in the last third"


@dataclasses.dataclass(frozen=True)
class OneAtATime:
    """A base and what is changed in it.

    Attributes:
        base: its name, without changes in `changes`.
        changes: what each setting has instead of the base's, by its name.
        common: scale -> overrides of the base.
        keys: columns that tell the settings apart, and where each stands in the resolved settings.
        claim: (name of a change, values of the base and of the change with their names) -> what is claimed of it.
        title: of the figure.
    """

    base: str
    changes: Mapping[str, Sequence[str]]
    common: Callable[[str], list[str]]
    keys: Mapping[str, str]
    claim: Callable[[str, tuple, tuple], Claim]
    title: str

    def settings(self, scale: str, options: StudyOptions) -> dict[str, list[str]]:
        lines = {}
        for name, changes in self.changes.items():
            lines[label(name)] = config.merge(self.common(scale), changes)
        return lines

    def parts(self, table: Table) -> dict[str, Table]:
        """The rows of each setting that has been trained to the end, by its name in `changes`."""
        lines = zip(self.changes, self.settings("paper", StudyOptions()).values(), strict=True)
        found = {name: table.where(**study.key_values(self.keys, line)) for name, line in lines}
        end = table["step"].max() if len(table) else 0
        return {name: part for name, part in found.items() if len(part) and part["step"].max() > 0.99 * end}

    def claims(self, table: Table) -> list[Claim]:
        found = dict.fromkeys(self.changes) | {name: evaluations.late(p) for name, p in self.parts(table).items()}
        return against_base(found, self.base, self.claim)

    def draw(self, table: Table, path: Path) -> None:
        there = {name: evaluations.late(part) for name, part in self.parts(table).items()}
        figure, (axis,) = figures.canvas(1, width=8.0, height=1.3 + 0.4 * len(there))
        for position, (name, values) in enumerate(reversed(list(there.items()))):
            assert values is not None
            figures.point(axis, position, values, SERIES[1 if name == self.base else 0], offset=0.2)
        axis.set_yticks(range(len(there)), [f"{name} ({seeds(len(there[name]))})" for name in reversed(there)])
        axis.set_xlabel("evaluations in the last third: mean and its 95 % interval over seeds")
        axis.set_ylim(-0.6, len(there) - 0.4)
        figure.suptitle(self.title, fontsize=10)
        figures.save(figure, path)

    def details(self, table: Table) -> list[str]:
        rows = [
            [name, figures.interval(evaluations.late(part)), *evaluations.row(part)]
            for name, part in self.parts(table).items()
        ]
        return markdown.table(("changed", QUANTITY.replace("evaluation ", ""), *evaluations.HEAD), rows)


def against_base(
    found: Mapping[str, np.ndarray | None], base: str, claim: Callable[[str, tuple, tuple], Claim]
) -> list[Claim]:
    """What is claimed of each setting beside the base, of values [seeds] by name; `claim`: as in `OneAtATime`."""
    return [claim(name, (base, found[base]), (name, values)) for name, values in found.items() if name != base]


def better(text: str) -> Callable[[str, tuple, tuple], Claim]:
    """The claim, `text` with {} for its name, that a setting leads to more than the base."""
    return lambda name, base, changed: verdict.compare(text.format(name), QUANTITY, changed, base)


def label(name: str) -> str:
    """A name as that of a run directory."""
    return name.replace(",", "").replace(" ", "_")


def no_difference(margin: float) -> Callable[[str, tuple, tuple], Claim]:
    """The claim that a change makes no difference beyond `margin`."""
    return lambda name, base, changed: verdict.compare(
        f"{name} instead of the base's makes no difference", QUANTITY, changed, base, "no difference", margin
    )


def needed(name: str, base: tuple, changed: tuple) -> Claim:
    """The claim that the base is better than with the change."""
    return verdict.compare(f"The recipe is better than with {name} (ours)", QUANTITY, base, changed)
