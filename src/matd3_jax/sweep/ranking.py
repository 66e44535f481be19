"""The settings of a sweep, ranked by their final returns."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from rich.table import Table

from matd3_jax.errors import UserError, nearest
from matd3_jax.runs import divergence
from matd3_jax.runs.directory import RunDirectory
from matd3_jax.runtime import files, terminal
from matd3_jax.stats.intervals import mean_interval
from matd3_jax.stats.text import plus_minus


@dataclasses.dataclass(frozen=True)
class Ranked:
    """The summary of one setting; arrays [seeds]."""

    name: str
    values: Mapping[str, str]
    """Swept keys."""
    seeds: np.ndarray
    final: np.ndarray
    """Mean of the metric over the last tenth of the run."""
    area: np.ndarray
    """Mean of the metric over the whole run after the first row: the area under the curve for each env step."""
    diverged: np.ndarray
    """Whether the seed's losses, values or returns were not finite at some time (`runs.divergence`)."""

    def interval(self, which: str) -> tuple[float, float]:
        """Mean and half width of its 95 % interval (t) of "final" or "area" over the seeds that did not diverge."""
        values = getattr(self, which)[~self.diverged]
        if not values.size:
            return np.nan, np.nan
        mean, half = mean_interval(values)
        return float(mean), float(half)


def rank(
    folder: Path,
    runs: Mapping[str, Sequence[str]],
    settings: Mapping[str, Mapping],
    metric: str,
    copied: Mapping[str, Mapping[int, int]] | None = None,
) -> list[Ranked]:
    """The settings of finished runs, best final mean first; settings with diverged seeds after those without.

    Args:
        folder: where the run directories are; runs: their names by setting.
        settings: swept values by setting.
        copied: by setting and seed the env step at which a member of a population last copied another: up to there it
            may have diverged.

    Raises UserError where the metrics tables have no column `metric`.
    """
    rows = []
    for name, values in settings.items():
        seeds, final, area, diverged = [], [], [], []
        after = (copied or {}).get(name, {})
        for run in runs[name]:
            table = RunDirectory(folder / run).read_metrics()
            if metric not in table:
                raise UserError(f"metric={metric}: the metrics table has no such column; {nearest(metric, table)}")
            summary = RunDirectory(folder / run).summary() or {}
            known = {int(seed): step for seed, step in (summary.get("diverged") or {}).items()}
            lost = {seed for seed, step in known.items() if step > after.get(seed, -1)}
            lost |= set(divergence.of_table(table, after))
            for seed in np.unique(table["seed"]):
                there = table["seed"] == seed
                steps, curve = table["step"][there], table[metric][there]
                late = steps > 0.9 * steps[-1]
                seeds.append(int(seed))
                final.append(_mean(curve[late]))
                area.append(_mean(curve[1:]))
                diverged.append(int(seed) in lost)
        rows.append(Ranked(name, values, np.array(seeds), np.array(final), np.array(area), np.array(diverged)))

    def order(row: Ranked) -> tuple[float, float]:
        mean = row.interval("final")[0]
        return float(row.diverged.mean()), -mean if np.isfinite(mean) else np.inf

    return sorted(rows, key=order)


def best_members(rows: Sequence[Ranked]) -> dict[int, tuple[float, str]]:
    """For each seed, which is a population, the best final value and the setting that has it, without those that
    diverged."""
    found: dict[int, tuple[float, str]] = {}
    for row in rows:
        for seed, value in zip(row.seeds[~row.diverged].tolist(), row.final[~row.diverged].tolist(), strict=True):
            if np.isfinite(value) and value > found.get(seed, (-np.inf, ""))[0]:
                found[seed] = (value, row.name)
    return found


def show(rows: Sequence[Ranked], title: str, most: int = 30) -> None:
    """Print the best `most` settings."""
    table = Table(title=f"{title}, mean ± 95 % interval over seeds")
    for heading in ("rank", *rows[0].values, "seeds", "diverged", "final", "area under the curve"):
        table.add_column(heading, justify="right")
    for k, row in enumerate(rows[:most]):
        cells = [plus_minus(*row.interval(which)) for which in ("final", "area")]
        diverged = str(row.diverged.sum()) if row.diverged.any() else "-"
        table.add_row(str(k + 1), *row.values.values(), str(len(row.seeds)), diverged, *cells)
    terminal.show(table, 200)
    if len(rows) > most:
        terminal.say(f"and {len(rows) - most} more settings")
    lost = [f"{row.name} seed {seed}" for row in rows for seed in row.seeds[row.diverged]]
    if lost:
        more = f", and {len(lost) - 10} more" if len(lost) > 10 else ""
        terminal.say(f"diverged, left out of all means: {', '.join(lost[:10])}{more}")


def write(folder: Path, rows: Sequence[Ranked]) -> None:
    """Leave table.csv (a row each setting) and seeds.csv (a row each setting and seed)."""
    keys = list(rows[0].values)
    intervals = ("final_mean", "final_interval", "area_mean", "area_interval")
    table: list[Sequence[object]] = [("rank", "setting", *keys, "seeds", "diverged", *intervals)]
    seeds: list[Sequence[object]] = [("rank", "setting", *keys, "seed", "diverged", "final", "area")]
    for k, row in enumerate(rows):
        numbers = [f"{x:.6g}" for which in ("final", "area") for x in row.interval(which)]
        table.append((k + 1, row.name, *row.values.values(), len(row.seeds), row.diverged.sum(), *numbers))
        for seed, diverged, final, area in zip(row.seeds, row.diverged, row.final, row.area, strict=True):
            seeds.append((k + 1, row.name, *row.values.values(), seed, int(diverged), f"{final:.6g}", f"{area:.6g}"))
    files.write_csv(folder / "table.csv", table)
    files.write_csv(folder / "seeds.csv", seeds)


def _mean(values: np.ndarray) -> float:
    there = values[~np.isnan(values)]  # no episode need have ended in an interval
    return float(there.mean()) if there.size else np.nan
