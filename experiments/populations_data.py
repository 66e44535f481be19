"""Evaluations of populations and of random search: files, the best member along training, the ratio of compute."""

import csv
import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import scipy.stats

from matd3_jax.cli.sweep import open_sweep
from matd3_jax.errors import UserError
from matd3_jax.runs.directory import RunDirectory
from matd3_jax.runs.metrics import by_seed
from matd3_jax.runtime import files

METRIC = "eval_return_agents"
FILES = ("data.csv", "runs.json")
HEAD = ("task", "method", "population", "member", "step", METRIC)

RANDOM = "random search"
"""What all other methods are compared with."""

LATE = 10
"""One part in so many of a run, over which evaluations are averaged."""

Key = tuple[str, str]
"""Task and method."""


def label(task: str, method: str) -> str:
    """The name of a sweep."""
    return f"{task}-{method.replace(',', '').replace(' ', '_').lower()}"


@dataclasses.dataclass
class Data:
    """Evaluations of finished sweeps.

    Attributes:
        steps: [points] env steps by task and method; values: [populations, members, points].
        facts: the arguments of each sweep, by its label.
    """

    steps: dict[Key, np.ndarray]
    values: dict[Key, np.ndarray]
    facts: dict[str, list[str]]

    def take(self, key: Key, line: list[str], place: Path) -> None:
        """Read the run directories of the sweep in `place`, which these arguments trained."""
        members = []
        for name in open_sweep(place)[1]["settings"]:
            table = RunDirectory(place / "runs" / name).read_metrics()
            there = np.isfinite(table["eval_episode_length"])
            steps, values = by_seed({column: values[there] for column, values in table.items()}, METRIC)
            members.append(values)
        self.steps[key], self.values[key] = steps.astype(int), np.stack(members, axis=1)
        self.facts[label(*key)] = line

    def write(self, out: Path) -> None:
        rows: list[Sequence[Any]] = [HEAD]
        for key, values in self.values.items():
            for (p, m, k), value in np.ndenumerate(values):
                rows.append((*key, p, m, int(self.steps[key][k]), f"{value:.6g}"))
        out.mkdir(parents=True, exist_ok=True)
        files.write_csv(out / FILES[0], rows, line_end="\n")
        files.write_json(out / FILES[1], self.facts)

    @classmethod
    def read(cls, out: Path) -> "Data":
        """What `write` left; nothing where there is nothing. Raises UserError where it cannot be read."""
        found = cls({}, {}, {})
        if not all((out / name).is_file() for name in FILES):
            return found
        try:
            found.facts = json.loads((out / FILES[1]).read_text())
            with (out / FILES[0]).open(newline="") as file:
                rows = list(csv.DictReader(file))
            for key in dict.fromkeys((row["task"], row["method"]) for row in rows):
                own = [row for row in rows if (row["task"], row["method"]) == key]
                populations, members = (len({row[name] for row in own}) for name in ("population", "member"))
                steps = list(dict.fromkeys(int(row["step"]) for row in own))
                found.steps[key] = np.array(steps)
                flat = np.array([float(row[METRIC]) for row in own])
                found.values[key] = flat.reshape(populations, members, len(steps))
        except (OSError, ValueError, LookupError) as error:
            raise UserError(f"cannot read {out / FILES[0]}: {error}") from error
        return found


def late(steps: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Means of values [..., points] over the last tenth of the run before each point, itself included."""
    window = steps[-1] / LATE
    found = [values[..., (steps > step - window) & (steps <= step)].mean(axis=-1) for step in steps]
    return np.stack(found, axis=-1)


def best(steps: np.ndarray, values: np.ndarray) -> np.ndarray:
    """The best member's `late` evaluations [populations, points], of values [populations, members, points]; members
    that are not finite are none."""
    means = late(steps, values)
    return np.where(np.isfinite(means), means, -np.inf).max(axis=1)


def reached(steps: np.ndarray, curve: np.ndarray, level: float) -> float:
    """Env steps at which a curve [points] is first at `level` or above; inf where it never is."""
    there = np.flatnonzero(curve >= level)
    return float(steps[there[0]]) if there.size else np.inf


def ratios(data: Data, task: str, method: str) -> np.ndarray:
    """For each population the env steps at which the method's best has what random search's ends with, divided by
    those at which random search's best has it; inf where it never has. The untrained networks do not count."""
    base, own = (task, RANDOM), (task, method)
    found = []
    for ours, theirs in zip(*(best(data.steps[key], data.values[key])[:, 1:] for key in (own, base)), strict=True):
        level = theirs[-1]
        found.append(reached(data.steps[own][1:], ours, level) / reached(data.steps[base][1:], theirs, level))
    return np.array(found)


def median_interval(values: np.ndarray, confidence: float = 0.95) -> tuple[float, float, float]:
    """Median of values [n], and the ends of its interval: the order statistics nearest to it that hold the true median
    with at least this probability (the sign test's); nan below six values, which hold it with less."""
    ordered, n = np.sort(values), len(values)
    k = int(scipy.stats.binom.ppf((1 - confidence) / 2, n, 0.5))  # how many may lie outside at each end
    if 2 * scipy.stats.binom.cdf(k, n, 0.5) > 1 - confidence:
        k -= 1
    middle = float(np.median(values))
    return (middle, np.nan, np.nan) if k < 0 else (middle, float(ordered[k]), float(ordered[n - 1 - k]))


def compared(data: Data) -> list[Key]:
    """Tasks and methods that can be compared with random search of as many members and populations."""
    return [
        key for key, values in data.values.items()
        if key[1] != RANDOM and (key[0], RANDOM) in data.values
        and values.shape[:2] == data.values[key[0], RANDOM].shape[:2]
    ]  # fmt: skip
