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
from matd3_jax.config.diff import text
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
        """Take the rows and facts of a setting. Whether they were taken.

        Unfinished ones do not take the place of finished ones. Seeds of the settings that are there already join them;
        of other settings take their place.
        """
        if label in self.rows and not self.unfinished(label):
            if facts["summary"] == UNFINISHED:
                return False
            there = self.seeds(label)
            if not differences(self.facts[label]["settings"], facts["settings"]):
                new = {int(seed) for seed in rows.values("seed")} - there
                if not new:
                    return False
                rows = tidy.concatenate([self.rows[label], rows.take(np.isin(rows["seed"], list(new)))])
                facts = joined([self.facts[label], {**facts, "parts": _only(facts, new)}], there | new)
        self.rows[label], self.facts[label] = rows, facts
        return True

    def adopt(self, other: "Data", wanted: Mapping[str, Config]) -> bool:
        """Take finished rows of another study of wanted settings whose seeds are missing. Whether any were taken."""
        taken = False
        for label, settings in wanted.items():
            for name, fact in other.facts.items():
                new = set(self.missing(label, settings)) & other.seeds(name)
                if not new or other.unfinished(name) or differences(fact["settings"], settings.to_dict()):
                    continue
                rows = other.rows[name].take(np.isin(other.rows[name]["seed"], list(new)))
                measured = {column: rows[column] for column in rows.columns if column not in other.keys}
                values = key_values(self.keys, fact["settings"])
                rows = Table({**{key: np.full(len(rows), value) for key, value in values.items()}, **measured})
                if new < other.seeds(name):
                    fact = joined([{**fact, "parts": _only(fact, new)}], new)
                taken |= self.offer(label, rows, fact)
        return taken

    def has(self, label: str, wanted: Config) -> bool:
        """Whether there are finished data of these settings with all these seeds."""
        return not self.missing(label, wanted)

    def missing(self, label: str, wanted: Config) -> list[int]:
        """The seeds of these settings of which there are no finished data."""
        asked = wanted.seed_numbers
        if label not in self.rows or self.unfinished(label):
            return [*asked]
        if differences(self.facts[label]["settings"], wanted.to_dict()):
            return [*asked]
        return [seed for seed in asked if seed not in self.seeds(label)]


def read(table: Path, facts: Path, keys: Mapping[str, str]) -> Data:
    """What `write` left; nothing if there are no such files. Raises UserError if they cannot be read, or do not belong
    together."""
    data = Data(keys, {}, {})
    if not (table.exists() and facts.exists()):
        return data
    try:
        rows, kept = tidy.read(table), json.loads(facts.read_text(encoding="utf-8"))
        of_label = {label: key_values(keys, fact["settings"]) for label, fact in kept.items()}
    except (OSError, ValueError, LookupError, TypeError, AttributeError) as error:
        raise UserError(f"cannot read {table} with {facts}: {error}; mend or remove both") from error
    for label, values in of_label.items():
        data.facts[label] = kept[label]
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
    whole = config.completed(settings)
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
        first = list(other.items())[:3]
        words = ", ".join(f"{key} {text(was)} there, {text(asked)} here" for key, (was, asked) in first)
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
    rows, facts, owned, seeds = [], [], [], set[int]()
    for path in paths:
        run, settings = RunDirectory.open(path)
        table = tidy.from_metrics(run.read_metrics(), key_values(keys, settings.to_dict()), **how)
        table = table.take(~np.isin(table["seed"], list(seeds)))
        own = {int(seed) for seed in table.values("seed")}
        seeds |= own
        rows.append(table)
        fact = {
            "command": command,
            "settings": {k: v for k, v in settings.to_dict().items() if k not in ("out", "name")},
            "machine": run.machine(),
            "summary": run.summary() or UNFINISHED,
        }
        facts.append(fact)
        owned.append(own)
    if len(facts) == 1:
        return rows[0], facts[0]
    parts = [{**fact, "parts": _only(fact, own)} for fact, own in zip(facts, owned, strict=True)]
    return tidy.concatenate(rows), joined(parts, seeds)


PART = ("command", "machine", "summary")
"""What may differ between seeds of one setting that were trained apart."""


def parts_of(fact: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Which seeds of a setting were trained together, with `PART` of each."""
    if "parts" in fact:
        return fact["parts"]
    first, number = fact["settings"]["seed"], fact["settings"]["seeds"]
    own = {key: fact[key] for key in PART if key in fact}  # the first studies did not keep their commands
    summaries = fact["summary"].get("parts") if isinstance(fact["summary"], dict) else None
    if summaries is None:
        return [{"seeds": [*range(first, first + number)], **own}]
    # Of older data only the number of seeds is known, of which the parts have about as many each.
    ends = [first + number * k // len(summaries) for k in range(len(summaries) + 1)]
    pairs = zip(ends, ends[1:], summaries, strict=False)
    return [{"seeds": [*range(a, b)], **own, "summary": one} for a, b, one in pairs]


def joined(facts: Sequence[Mapping[str, Any]], seeds: set[int]) -> dict[str, Any]:
    """The facts of one setting whose `seeds` were trained apart."""
    parts = [part for fact in facts for part in parts_of(fact) if part["seeds"]]
    summaries = [part["summary"] for part in parts]
    summary = UNFINISHED if UNFINISHED in summaries else {"parts": summaries}
    settings = {**facts[0]["settings"], "seed": min(seeds), "seeds": len(seeds)}
    return {**facts[0], "settings": settings, "summary": summary, "parts": parts}


def _only(fact: Mapping[str, Any], seeds: set[int]) -> list[dict[str, Any]]:
    """The parts of a setting with no other seeds than these."""
    parts = parts_of(fact)
    if len(parts) == 1:
        return [{**parts[0], "seeds": sorted(seeds)}]
    return [{**part, "seeds": [seed for seed in part["seeds"] if seed in seeds]} for part in parts]
