"""The data of a study: what its folder holds, what run directories have, and whether that is what was asked for.

`runs.json` next to the tidy table has, for each setting, the resolved settings, the machine with its versions, and the
run's summary ("not finished" without one).
"""

import dataclasses
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from experiments import tidy
from experiments.tidy import Table
from matd3_jax import config
from matd3_jax.config import Config
from matd3_jax.config.schema import UNREPORTED
from matd3_jax.errors import UserError
from matd3_jax.runs.directory import RunDirectory
from matd3_jax.runtime import files

UNFINISHED = "not finished"


@dataclasses.dataclass
class Data:
    """Rows and facts of a study's settings, by label."""

    keys: Mapping[str, str]
    """The table's columns that distinguish settings, and where each stands in the resolved settings (`algo.name`)."""
    rows: dict[str, Table]
    facts: dict[str, dict[str, Any]]

    @property
    def table(self) -> Table:
        """All rows."""
        return tidy.concatenate(list(self.rows.values()))

    @property
    def finished(self) -> Table:
        """The rows of finished settings."""
        return tidy.concatenate([self.rows[label] for label in self.rows if not self.unfinished(label)])

    def unfinished(self, label: str) -> bool:
        return self.facts[label]["summary"] == UNFINISHED

    def seeds(self, label: str) -> set[int]:
        return {int(seed) for seed in self.rows[label].values("seed")} if label in self.rows else set()

    def offer(self, label: str, rows: Table, facts: dict[str, Any]) -> bool:
        """Replace the rows and facts of a setting by these, unless these are better: finished where the new ones
        are not, or of the same settings with more seeds. Whether they were taken."""
        if label in self.rows and not self.unfinished(label):
            same = not differences(self.facts[label]["settings"], facts["settings"])
            if facts["summary"] == UNFINISHED or same and len(rows.values("seed")) < len(self.seeds(label)):
                return False
        self.rows[label], self.facts[label] = rows, facts
        return True

    def has(self, label: str, wanted: Config) -> bool:
        """Whether there are finished data of these settings with all these seeds."""
        if label not in self.rows or self.unfinished(label):
            return False
        asked = set(range(wanted.seed, wanted.seed + wanted.seeds))
        return not differences(self.facts[label]["settings"], wanted.to_dict()) and asked <= self.seeds(label)


def read(table: Path, facts: Path, keys: Mapping[str, str]) -> Data:
    """What `write` left; nothing if there are no such files. Raises UserError if they do not belong together."""
    data = Data(keys, {}, {})
    if not (table.exists() and facts.exists()):
        return data
    rows = tidy.read(table)
    for label, fact in json.loads(facts.read_text(encoding="utf-8")).items():
        data.facts[label] = fact
        values = key_values(keys, fact["settings"])
        part = rows.where(**{key: value for key, value in values.items() if key in rows})
        if not len(part):
            raise UserError(f"{facts} speaks of {label}, of which {table} has no rows: remove both")
        # A table from before a key was among the columns has one value of it.
        new = {key: np.full(len(part), value) for key, value in values.items() if key not in rows}
        data.rows[label] = Table({**new, **part.columns})
    return data


def write(data: Data, table: Path, facts: Path) -> None:
    tidy.write(data.table, table)
    files.write_json(facts, data.facts)


# ---- settings --------------------------------------------------------------------------------------------------------


def key_values(keys: Mapping[str, str], settings: Mapping[str, Any]) -> dict[str, Any]:
    """The values of a setting's columns (a list as its text); the opponents have the team's algorithm where none of
    their own was chosen."""
    flat = _flat(settings)
    found = {column: flat[path] for column, path in keys.items()}
    return {column: str(value) if isinstance(value, list) else value for column, value in found.items()}


def differences(found: Mapping[str, Any], wanted: Mapping[str, Any]) -> dict[str, tuple[Any, Any]]:
    """Settings that differ and matter, by name: (found, wanted)."""
    a, b = _flat(found), _flat(wanted)
    shared = (key for key in a if key in b and key.split(".")[0] not in UNREPORTED)
    return {key: (a[key], b[key]) for key in shared if a[key] != b[key]}


def _flat(settings: Mapping[str, Any]) -> dict[str, Any]:
    whole = {**config.ADDED_LATER, **config.renamed(settings)}
    whole["adversary"] = whole.get("adversary") or whole["algo"]
    flat: dict[str, Any] = {}
    for key, value in whole.items():
        if isinstance(value, Mapping):
            flat |= {f"{key}.{name}": part for name, part in value.items()}
        else:
            flat[key] = value
    return flat


def check(path: Path, wanted: Config) -> None:
    """Raise UserError if the run at `path` was made with other settings."""
    other = differences(RunDirectory.open(path)[1].to_dict(), wanted.to_dict())
    if other:
        words = ", ".join(f"{key} {was} there, {asked} here" for key, (was, asked) in list(other.items())[:3])
        raise UserError(f"{path} was made with other settings ({words}): remove it, or choose another runs=")


# ---- run directories -------------------------------------------------------------------------------------------------


def find(folder: Path, label: str, wanted: Config) -> list[Path]:
    """Run directories of a setting in `folder`: those with its settings or else the one of its name, finished ones
    before unfinished ones."""
    there = [path.parent for depth in ("*", "*/*") for path in sorted(folder.glob(f"{depth}/config.yaml"))]
    there = [path for path in there if (path / "metrics.csv").exists()]
    found = [p for p in there if not differences(RunDirectory.open(p)[1].to_dict(), wanted.to_dict())]
    found = found or [path for path in there if path == folder / label]
    return [path for path in found if (path / "summary.json").exists()] or found


def gather(keys: Mapping[str, str], paths: Sequence[Path], command: str, **how: Any) -> tuple[Table, dict[str, Any]]:
    """Rows and facts of run directories, which hold seeds of one setting (each seed of the first that has it).

    how: `keep`, `points` and `evaluations` of `tidy.from_metrics`.
    """
    parts, facts, seeds = [], [], set[int]()
    for path in paths:
        run, settings = RunDirectory.open(path)
        part = tidy.from_metrics(run.read_metrics(), key_values(keys, settings.to_dict()), **how)
        part = part.take(~np.isin(part["seed"], list(seeds)))
        seeds |= {int(seed) for seed in part.values("seed")}
        parts.append(part)
        summary = path / "summary.json"
        facts.append(
            {
                "command": command,
                "settings": {k: v for k, v in settings.to_dict().items() if k not in ("out", "name")},
                "machine": json.loads((path / "machine.json").read_text(encoding="utf-8")),
                "summary": json.loads(summary.read_text(encoding="utf-8")) if summary.exists() else UNFINISHED,
            }
        )
    whole = facts[0]
    if len(facts) > 1:
        summaries = [fact["summary"] for fact in facts]
        whole["summary"] = UNFINISHED if UNFINISHED in summaries else {"parts": summaries}
        whole["settings"] = {**whole["settings"], "seed": min(seeds), "seeds": len(seeds)}
    return tidy.concatenate(parts), whole
