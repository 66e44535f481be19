"""One tidy table for all settings of a study: from the metrics of runs, to CSV and back, and what is read off it.

A row is a setting, a seed and a point of its training: the setting's keys (`env`, `algo`, ...), `seed`, `step` (env
steps of this seed), `updates`, `episodes` (ended since the row before), then means over those episodes and what
evaluations gave.
"""

import csv
import fnmatch
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from matd3_jax.runtime import files

INDEX = ("seed", "step", "updates", "episodes")
WINDOW = 1000
"""Episodes in the means that the paper reports."""


class Table:
    """Columns of equal length, [rows]: numbers, or text where a value is none."""

    def __init__(self, columns: Mapping[str, np.ndarray]):
        self.columns = dict(columns)

    def __len__(self) -> int:
        return len(next(iter(self.columns.values()))) if self.columns else 0

    def __getitem__(self, name: str) -> np.ndarray:
        return self.columns[name]

    def __contains__(self, name: str) -> bool:
        return name in self.columns

    def where(self, **keys: Any) -> "Table":
        """The rows with these values: all rows of one setting, say."""
        chosen = np.ones(len(self), bool)
        for name, value in keys.items():
            column = self.columns.get(name)
            if column is None:
                chosen[:] = False
            elif column.dtype.kind == "U":  # also where numbers are mixed with texts
                chosen &= column == (value if isinstance(value, str) else f"{value:g}")
            else:
                chosen &= column == value
        return self.take(chosen)

    def take(self, chosen: np.ndarray) -> "Table":
        return Table({name: column[chosen] for name, column in self.columns.items()})

    def values(self, name: str) -> list[Any]:
        """The different values of a column, ascending; none of a column that is not there."""
        return sorted(set(self.columns[name].tolist())) if name in self.columns else []

    def by_seed(self, name: str) -> np.ndarray:
        """A column of ONE setting as [seeds, points], up to the point that all its seeds have."""
        curves = [self.columns[name][self.columns["seed"] == seed] for seed in self.values("seed")]
        points = min(map(len, curves), default=0)
        return np.array([curve[:points] for curve in curves], float).reshape(len(curves), points)


def concatenate(tables: Sequence[Table]) -> Table:
    """All rows, one table after another; columns that one lacks are nan there (text: empty)."""
    tables = [table for table in tables if len(table)]
    names = list(dict.fromkeys(name for table in tables for name in table.columns))

    def column(table: Table, name: str) -> np.ndarray:
        if name in table:
            return table[name]
        text = any(name in other and other[name].dtype.kind == "U" for other in tables)
        return np.full(len(table), "" if text else np.nan)

    return Table({name: np.concatenate([column(table, name) for table in tables]) for name in names})


# ---- from a run ------------------------------------------------------------------------------------------------------


def from_metrics(
    metrics: Mapping[str, np.ndarray], keys: Mapping[str, Any], keep: Sequence[str], points: int, evaluations: bool
) -> Table:
    """A run's metrics table as rows of a study.

    Args:
        metrics: columns [rows], as `RunDirectory.read_metrics` gives them.
        keys: values of the setting's columns.
        keep: patterns of the columns to keep. `q_estimate` and `q_true`, means over the agents, are added where the run
            measured them.
        points: rows of each seed before the last `WINDOW` episodes; more are merged (see `thin`).
        evaluations: keep the rows with an evaluation only.
    """
    metrics = dict(metrics)
    for name in ("q_estimate", "q_true"):
        agents = [column for column in metrics if column.endswith(f"_{name}")]
        if agents:
            metrics[name] = np.mean([metrics[column] for column in agents], axis=0)
    kept = [n for n in metrics if n not in INDEX and any(fnmatch.fnmatch(n, pattern) for pattern in keep)]
    names = [*(n for n in INDEX if n in metrics), *kept, *(n for n in ("q_estimate", "q_true") if n in metrics)]
    if evaluations:
        there = ~np.isnan(metrics[next(n for n in kept if n.startswith("eval_"))])
        metrics = {name: column[there] for name, column in metrics.items()}
    parts = [
        thin({name: metrics[name][metrics["seed"] == seed] for name in names}, points)
        for seed in np.unique(metrics["seed"])
    ]
    joined = {name: np.concatenate([part[name] for part in parts]) for name in names}
    rows = len(joined["seed"])
    return Table({**{key: np.full(rows, value) for key, value in keys.items()}, **joined})


def thin(metrics: Mapping[str, np.ndarray], points: int) -> dict[str, np.ndarray]:
    """One seed's rows, merged so that about `points` are left before the last `WINDOW` episodes.

    A merged row stands where its last one stood; returns are means over its episodes, other columns (evaluations) the
    last value that there is. The first row (the untrained policies) and those of the last `WINDOW` episodes stay.
    """
    rows = len(metrics["seed"])
    if "episodes" not in metrics or rows <= points + 2:
        return dict(metrics)
    after = metrics["episodes"].sum() - np.cumsum(metrics["episodes"])
    tail = max(1, int(np.argmax(after < WINDOW)))  # the first row that reaches into the last episodes
    size = max(1, -(-(tail - 1) // points))
    first = [0, *range(1, tail, size), *range(tail, rows)]
    groups = list(zip(first, [*first[1:], rows], strict=True))

    def merged(name: str, column: np.ndarray) -> np.ndarray:
        if name in INDEX:
            return np.array([column[a:b].sum() if name == "episodes" else column[b - 1] for a, b in groups])
        if name.startswith("return_"):
            return np.array([_mean(column[a:b], metrics["episodes"][a:b]) for a, b in groups])
        return np.array([_last(column[a:b]) for a, b in groups])

    return {name: merged(name, column) for name, column in metrics.items()}


def _mean(values: np.ndarray, weights: np.ndarray) -> float:
    there = weights > 0  # no episode ended: no mean
    return float((values[there] * weights[there]).sum() / weights.sum()) if there.any() else np.nan


def _last(values: np.ndarray) -> float:
    there = values[~np.isnan(values)]
    return float(there[-1]) if there.size else np.nan


# ---- files -----------------------------------------------------------------------------------------------------------


def write(table: Table, path: Path) -> None:
    """As CSV, numbers to six digits (whole ones in full)."""
    rows = zip(*(_texts(column) for column in table.columns.values()), strict=True)
    files.write_csv(path, [list(table.columns), *rows], line_end="\n")


def read(path: Path) -> Table:
    """What `write` left; an empty table if there is no such file. Raises ValueError where a row has too few or too many
    cells."""
    if not path.exists():
        return Table({})
    with path.open(newline="", encoding="utf-8") as file:
        header, *rows = csv.reader(file)
    for k, row in enumerate(rows):
        if len(row) != len(header):
            raise ValueError(f"line {k + 2} of {path.name} has {len(row)} cells, not {len(header)}")
    return Table({name: _typed([row[i] for row in rows]) for i, name in enumerate(header)})


def _texts(column: np.ndarray) -> list[str]:
    if column.dtype.kind == "U":
        return column.tolist()
    return [f"{v:.0f}" if v == np.round(v) and abs(v) < 1e15 else f"{v:.6g}" for v in column.astype(float)]


def _typed(texts: list[str]) -> np.ndarray:
    try:
        return np.array([float(text) for text in texts])
    except ValueError:
        return np.array(texts)


# ---- what is read off ------------------------------------------------------------------------------------------------


def window(table: Table) -> int:
    """Episodes that a mean of ONE setting goes over: `WINDOW`, or a fifth of all in shorter runs."""
    return int(min(WINDOW, max(1, table.by_seed("episodes").sum(axis=1).min() // 5)))


def trailing(table: Table, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Mean return over the last `window` episodes along ONE setting: (episodes so far [points], [seeds, points])."""
    episodes = table.by_seed("episodes")
    return np.cumsum(episodes, axis=1).mean(axis=0), trailing_mean(episodes, table.by_seed(name), window(table))


def trailing_mean(episodes: np.ndarray, values: np.ndarray, size: int) -> np.ndarray:
    """Mean over the last `size` episodes (at first over all so far) at each row: [seeds, rows].

    Args:
        episodes, values: [seeds, rows] episodes of each row and their mean; of a row that reaches only in part into
            the last `size` episodes that part counts.
    """
    found = []
    for weights, value in zip(episodes, values, strict=True):
        count = np.cumsum(weights)
        total = np.cumsum(np.where(weights > 0, weights * value, 0))
        back = np.maximum(count - size, 0)
        before = np.interp(back, [0, *count], [0, *total])
        with np.errstate(invalid="ignore", divide="ignore"):
            found.append((total - before) / (count - back))
    return np.array(found)


def final(table: Table, name: str) -> np.ndarray | None:
    """Mean return of the last `window` episodes of ONE setting, [seeds]; None without rows."""
    return trailing(table, name)[1][:, -1] if len(table) and name in table else None


def along(table: Table, name: str) -> np.ndarray | None:
    """Mean return over all episodes after the first update of ONE setting, [seeds]: the area under its learning curve
    over its length. None without rows."""
    if not len(table) or name not in table:
        return None
    weights, values = table.by_seed("episodes")[:, 1:], table.by_seed(name)[:, 1:]
    if not weights.size:
        return None
    return np.where(weights > 0, weights * values, 0).sum(axis=1) / weights.sum(axis=1)
