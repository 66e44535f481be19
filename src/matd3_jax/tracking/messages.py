"""What the process that trains tells the process that tracks, and how rows become named numbers.

Imports neither JAX nor the rest of the package: the process that tracks starts quickly and touches no accelerator.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

Row = Mapping[str, np.ndarray]
Numbers = dict[str, float]
"""By name; what is nan is left out."""

FINISHED, STOPPED, FAILED = "finished", "stopped", "failed"
"""How a run was left: at its end; by a signal, to be resumed; by an error or a divergence."""


@dataclasses.dataclass(frozen=True)
class TrackedRun:
    """A run as trackers know it."""

    name: str
    folder: str
    """The run directory, an absolute path."""
    seeds: tuple[int, ...]
    settings: Mapping[str, Any]
    """Plain values, in groups."""
    sweep: str | None = None
    """The name of the sweep that it belongs to."""

    @property
    def title(self) -> str:
        """The run's name, with that of its sweep."""
        return self.name if self.sweep is None else f"{self.sweep}/{self.name}"

    @property
    def bands(self) -> bool:
        """Whether all seeds are one run of the tracker."""
        return self.settings["logger_seeds"] == "bands"


@dataclasses.dataclass(frozen=True)
class Logged:
    """A row of the metrics table of all runs: columns [seeds], those of the first run first."""

    row: Row
    diverged: frozenset[int]
    """Places of the seeds that have."""


@dataclasses.dataclass(frozen=True)
class Attached:
    """A file of the run number `run`."""

    run: int
    step: int
    path: str
    seed: int | None = None
    """Whose it is; None: of all."""


@dataclasses.dataclass(frozen=True)
class Summarized:
    """What the run number `run` left in its summary."""

    run: int
    step: int
    whole: Numbers
    seeds: Mapping[int, Numbers]
    """Of each seed by its number."""


@dataclasses.dataclass(frozen=True)
class Closed:
    """No message will come any more."""

    how: str
    """`FINISHED`, `STOPPED` or `FAILED`."""


COUNTERS = ("step", "seed")
"""Columns that say which row it is."""


def of_seed(row: Row, place: int) -> Numbers:
    """The numbers of one seed in a row."""
    return _there({name: float(values[place]) for name, values in row.items() if name not in COUNTERS})


def as_bands(row: Row, sound: Sequence[bool] | np.ndarray) -> Numbers:
    """The numbers of all seeds in a row: `COLUMN/seed_N` of each, and over those that are sound `COLUMN/mean` and the
    ends of its 95 % interval, `COLUMN/low` and `COLUMN/high`. Counts of updates, the same for all, are one number.

    Args:
        row: columns [seeds].
        sound: [seeds] which have not diverged.
    """
    from matd3_jax.stats.intervals import mean_interval

    found: Numbers = {"updates": float(row["updates"][0])} if "updates" in row else {}
    for name, values in row.items():
        if name in (*COUNTERS, "updates"):
            continue
        for seed, value in zip(row["seed"], values, strict=True):
            found[f"{name}/seed_{int(seed)}"] = float(value)
        kept = np.asarray(values, float)[np.asarray(sound, bool)]
        kept = kept[~np.isnan(kept)]
        if kept.size:
            with np.errstate(invalid="ignore"):
                mean, half = (float(part) for part in mean_interval(kept))
            found |= {f"{name}/mean": mean, f"{name}/low": mean - half, f"{name}/high": mean + half}
    return _there(found)


def flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Values in groups by their dotted keys."""
    found: dict[str, Any] = {}
    for key, value in values.items():
        found.update(flat(value, f"{prefix}{key}.") if isinstance(value, Mapping) else {f"{prefix}{key}": value})
    return found


def numbers(values: Mapping[str, Any], prefix: str = "") -> Numbers:
    """The numbers in a summary by their names: of a mean `last_tenth/agents/mean`, and of its 95 % interval
    `last_tenth/agents/half_width`."""
    found: Numbers = {}
    for key, value in values.items():
        name = f"{prefix}{key}"
        if isinstance(value, Mapping):
            found |= numbers(value, f"{name}/")
        elif isinstance(value, list | tuple) and len(value) == 2:
            found |= {f"{name}/mean": _number(value[0]), f"{name}/half_width": _number(value[1])}
        else:
            found[name] = _number(value)
    return _there(found)


def _number(value: Any) -> float:
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else math.nan


def _there(values: Numbers) -> Numbers:
    return {name: value for name, value in values.items() if not math.isnan(value)}
