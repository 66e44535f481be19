"""The run directory: settings, versions, the metrics table, checkpoints and pictures of one run."""

import csv
import json
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from matd3_jax import config as configuration
from matd3_jax.config import Config
from matd3_jax.config.diff import differing, learning, text
from matd3_jax.errors import UserError


class RunDirectory:
    """Where a run leaves its files.

    config.yaml (all resolved settings), machine.json (versions and devices), metrics.csv (one row an interval and
    seed), checkpoints/, learning_curve.png, summary.json (written at the end), on request q_bias.png and tensorboard/.
    """

    def __init__(self, path: Path):
        self.path = path
        self.checkpoints = path / "checkpoints"
        self.metrics = path / "metrics.csv"
        self.curve = path / "learning_curve.png"
        self.q_bias = path / "q_bias.png"
        self.tensorboard = path / "tensorboard"

    @classmethod
    def create(cls, path: Path, config: Config, machine: Mapping[str, Any]) -> "RunDirectory":
        """Make the directory. Raises UserError if it is there already or cannot be made."""
        try:
            path.mkdir(parents=True)
        except FileExistsError:
            raise UserError(f"{path} is there already: choose another name=, or resume it with resume={path}") from None
        except OSError as error:
            raise UserError(f"cannot make the run directory {path}: {error.strerror}") from error
        run = cls(path)
        configuration.write(config, path / "config.yaml")
        (path / "machine.json").write_text(json.dumps(machine, indent=1) + "\n")
        return run

    @classmethod
    def open(cls, path: Path) -> tuple["RunDirectory", Config]:
        """An existing run and its settings. Raises UserError if there is none."""
        if not path.is_dir():
            raise UserError(f"there is no run directory {path}")
        if not (path / "config.yaml").is_file():
            raise UserError(f"{path} is no run directory: it has no config.yaml")
        return cls(path), configuration.read(path / "config.yaml")

    def append(self, row: Mapping[str, np.ndarray]) -> None:
        """Add one row for each seed to the metrics table. row: columns [seeds], the same ones every time."""
        new = not self.metrics.exists()
        with self.metrics.open("a", newline="") as file:
            writer = csv.writer(file)
            if new:
                writer.writerow(row)
            writer.writerows(zip(*(map(_text, column) for column in row.values()), strict=True))

    def clear(self) -> None:
        """Take away all but settings and machine: the run begins anew."""
        for path in (self.metrics, self.curve, self.path / "summary.json"):
            path.unlink(missing_ok=True)
        shutil.rmtree(self.checkpoints, ignore_errors=True)

    def cut(self, step: int) -> None:
        """Drop the rows after env step `step`: they will be written again."""
        if not self.metrics.exists():
            return
        with self.metrics.open(newline="") as file:
            header, *rows = csv.reader(file)
        kept = [row for row in rows if int(row[0]) <= step]
        partial = self.metrics.with_suffix(".partial")
        with partial.open("w", newline="") as file:
            csv.writer(file).writerows([header, *kept])
        partial.replace(self.metrics)

    def read_metrics(self) -> dict[str, np.ndarray]:
        """The table as columns [rows], without the rows of an interval that is just being written.

        Raises UserError if there is none yet.
        """
        written = self.metrics.read_text() if self.metrics.is_file() else ""
        header, *rows = csv.reader(written[: written.rfind("\n") + 1].splitlines() or [""])
        while rows and sum(row[0] == rows[-1][0] for row in rows) < sum(row[0] == rows[0][0] for row in rows):
            rows.pop()
        if not rows:
            raise UserError(f"{self.path} has no metrics yet: its first row comes when learning starts")
        return {name: np.array([float(row[i]) for row in rows]) for i, name in enumerate(header)}

    def write_summary(self, summary: Mapping[str, Any]) -> None:
        (self.path / "summary.json").write_text(json.dumps(summary, indent=1) + "\n")


def together(paths: Sequence[Path]) -> dict[str, np.ndarray]:
    """The metrics of runs that differ only in their seeds, as one table: columns [rows], by env step, then by seed.

    Columns that only some of the runs have (evaluations, say) are left out. How long runs go and what they leave behind
    (`diff.RECORDS`) may differ, too: then not every seed has every step.

    Raises UserError where there is no run or no metrics yet, where runs differ otherwise, or two have the same seed.
    """
    opened = [RunDirectory.open(path) for path in paths]
    owner: dict[int, Path] = {}
    first = learning(opened[0][1])
    for run, settings in opened:
        for key in differing([first, learning(settings)])[:1]:
            here, there = text(learning(settings).get(key)), text(first.get(key))
            raise UserError(f"{run.path} is no run with other seeds of {paths[0]}: {key}={here}, not {there}")
        for seed in range(settings.seed, settings.seed + settings.seeds):
            if seed in owner:
                raise UserError(f"{owner[seed]} and {run.path} have the same settings and both the seed {seed}")
            owner[seed] = run.path
    tables = [run.read_metrics() for run, _ in opened]
    columns = [name for name in tables[0] if all(name in table for table in tables)]
    joined = {name: np.concatenate([table[name] for table in tables]) for name in columns}
    order = np.lexsort((joined["seed"], joined["step"]))
    return {name: column[order] for name, column in joined.items()}


def _text(value: Any) -> str:
    # Nine digits give every float32 back exactly.
    return str(value) if isinstance(value, int | np.integer) else f"{value:.9g}"
