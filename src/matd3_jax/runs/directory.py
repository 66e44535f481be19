"""The run directory: settings, versions, the metrics table, checkpoints and pictures of one run."""

import errno
import itertools
import json
import os
import shlex
import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from matd3_jax import config as configuration
from matd3_jax.config import Config
from matd3_jax.config.diff import differing, learning, text
from matd3_jax.errors import UserError
from matd3_jax.runs import metrics_table, table_digest
from matd3_jax.runs.metrics_table import MetricsTable
from matd3_jax.runs.missing import Expected
from matd3_jax.runs.paths import check_directory
from matd3_jax.runtime import files

FORMAT = 1
"""Of what a run directory holds, in its machine.json; directories without it are of format 0, and are read, too."""

START = "start.npz"
"""What a run begins with from other runs (`training.starting`)."""


PLANS = ("batches", "pieces")
"""What a sweep's file of its batches, and their folder, are called; in older ones the latter."""


class RunDirectory:
    """Where a run leaves its files.

    config.yaml (all resolved settings), machine.json (versions and devices), metrics.csv (one row an interval and
    seed), checkpoints/, learning_curve.png, summary.json (written at the end), on request q_bias.png, tensorboard/,
    videos/, and of W&B and MLflow wandb/, wandb.json and mlflow.json (what they call the run), start.npz of a run that
    begins with networks of others.
    """

    def __init__(self, path: Path):
        self.path = path
        self.checkpoints = path / "checkpoints"
        self.metrics = path / "metrics.csv"
        self.curve = path / "learning_curve.png"
        self.q_bias = path / "q_bias.png"
        self.tensorboard = path / "tensorboard"
        self.videos = path / "videos"
        self.wandb = path / "wandb"

    @staticmethod
    def check_new(path: Path, or_another: bool = False) -> None:
        """Raise UserError where no directory for a run, or a sweep, can be made. Makes nothing.

        or_another: another one (see `create`) will do where this is there.
        """
        check_directory(path, "directory")
        if "\\" in str(path.absolute()) and os.sep == "/":  # which Orbax would take for a slash
            raise UserError(f"{str(path.absolute())!r}: checkpoints cannot be kept where a path has a backslash")
        if path.exists() and not or_another:
            raise UserError(_there(path))

    @classmethod
    def create(
        cls,
        path: Path,
        config: Config,
        machine: Mapping[str, Any],
        or_another: bool = False,
        more: Callable[[Path], object] | None = None,
    ) -> "RunDirectory":
        """Make the directory, which gets its name with its settings in it: a kill leaves none without.

        Args:
            or_another: make the first of PATH, PATH-2, PATH-3, ... that is not there yet, even while others do the
                same.
            more: writes further files into the directory before it gets its name.

        Raises UserError if it is there already or cannot be made.
        """
        new = path.with_name(f".run.{os.getpid()}.partial")
        try:
            shutil.rmtree(new, ignore_errors=True)
            new.mkdir(parents=True)
            configuration.write(config, new / "config.yaml")
            files.write_json(new / "machine.json", {"format": FORMAT, **machine})
            if more is not None:
                more(new)
            for number in itertools.count(1):
                tried = path if number == 1 else path.with_name(f"{path.name}-{number}")
                if not os.path.lexists(tried):
                    try:
                        new.rename(tried)
                    except OSError as error:
                        if error.errno not in (errno.ENOTEMPTY, errno.EEXIST, errno.ENOTDIR):
                            raise  # else another process was quicker
                    else:
                        files.sync_folder(path.parent)
                        files.remove_abandoned(path.parent, ".run.*.partial")
                        return cls(tried)
                if not or_another:
                    raise UserError(_there(path))
        except OSError as error:
            raise UserError(f"cannot make the run directory {path}: {error.strerror}") from error
        finally:
            shutil.rmtree(new, ignore_errors=True)
        raise AssertionError("counting ends nowhere")

    @classmethod
    def open(cls, path: Path) -> tuple["RunDirectory", Config]:
        """An existing run and its settings. Raises UserError if there is none, or one of a newer format."""
        if not path.is_dir():
            raise UserError(f"there is no run directory {path}")
        if not (path / "config.yaml").is_file():
            raise UserError(f"{path} is no run directory: it has no config.yaml")
        run = cls(path)
        if run.format > FORMAT:
            raise UserError(
                f"{path} has the format {run.format} of run directories, this version reads up to {FORMAT}: "
                "use the version of matd3_jax that wrote it, or a newer one"
            )
        return run, configuration.read(path / "config.yaml")

    @property
    def format(self) -> int:
        """Of what the directory holds: 0 where machine.json does not say."""
        number = self.machine().get("format", 0)
        return number if isinstance(number, int) else 0

    @property
    def sweep(self) -> Path | None:
        """The directory of the sweep that plans this run, and trains it with others; None: it is no sweep's."""
        path = self.path.resolve()
        folder = path.parent.parent
        for plan in (folder / f"{name}.json" for name in PLANS if path.parent.name == "runs"):
            try:
                batches = json.loads(plan.read_text(encoding="utf-8"))
                if any(path.name in batch for batch in batches):
                    return folder
            except (OSError, ValueError, TypeError, RecursionError):
                continue
        return None

    @property
    def bare(self) -> bool:
        """Whether the directory was made, and nothing has been trained in it."""
        if self.path.is_symlink() or not self.path.is_dir():
            return False
        own = {"config.yaml", "machine.json", START, *(left.name for left in files.partial(self.path))}
        return {found.name for found in self.path.iterdir()} <= own

    @property
    def in_place(self) -> tuple[Path, ...]:
        """What is written without being replaced as a whole."""
        return self.metrics, self.checkpoints, self.tensorboard, self.videos, self.wandb

    def clean(self) -> None:
        """Take away what killed writes left, while the directory's lock is held.

        Raises UserError where what is written in place is a link: what is behind it is not the run's.
        """
        for path in self.in_place:
            if path.is_symlink():
                raise UserError(f"{path} is a link: nothing is written through it")
        files.remove_partial(self.path)

    def append(self, row: Mapping[str, np.ndarray]) -> None:
        """Add one row for each seed to the metrics table. row: columns [seeds], the same ones every time."""
        new = not self.metrics.exists() or not self.metrics.stat().st_size
        files.append(self.metrics, metrics_table.row_lines(row, header=new).encode())

    def sync(self) -> None:
        """Bring the metrics table to the disk, before a checkpoint that has its rows behind it gets its name."""
        if self.metrics.exists():
            files.sync(self.metrics)
            files.sync_folder(self.path)

    def clear(self) -> None:
        """Take away all but settings and machine: the run starts again."""
        for path in (self.metrics, self.curve, self.path / "summary.json"):
            path.unlink(missing_ok=True)
        shutil.rmtree(self.checkpoints, ignore_errors=True)

    def cut(
        self, step: int, expected: Expected | None = None, checkpoint: Path | None = None, number: int = 0
    ) -> list[str]:
        """Drop the rows after env step `step`, which will be written again, and the lines that are not whole.

        Args:
            expected: of the table: gives it the columns of the rows to come.
            checkpoint, number: the checkpoint of that env step, and which of its runs this one is.

        Returns:
            What the table lacks, a line for each kind of loss.
        """
        kept = self.table()
        lines = self.losses(kept, step, expected, checkpoint, number)
        kept = kept.until(step)
        if expected is not None:
            kept = expected.seen(kept).with_columns(expected.columns)
        if kept.rows:
            files.write_text(self.metrics, kept.text())
        else:
            self.metrics.unlink(missing_ok=True)
        return lines

    def losses(
        self, table: MetricsTable, step: int, expected: Expected | None, checkpoint: Path | None, number: int = 0
    ) -> list[str]:
        """What its metrics table lacks up to env step `step`, or has otherwise than it was at the checkpoint."""
        lines = [] if expected is None else [f"{self.metrics}: {line}" for line in expected.lines(table, step)]
        if not lines and checkpoint is not None and table_digest.is_changed(checkpoint, self.metrics, number):
            lines = [f"{self.metrics}: its rows up to env step {step:,} are not those that the checkpoint knows"]
        return lines

    def table(self) -> MetricsTable:
        """The whole rows of the metrics table; none where there is no file."""
        return metrics_table.parse(self.metrics.read_bytes() if self.metrics.is_file() else b"")

    def read_metrics(self) -> dict[str, np.ndarray]:
        """The table as columns [rows], without intervals that not all seeds have, as one that is just being written.

        Raises UserError if there is none yet.
        """
        table = self.table()
        columns = table.columns()
        if not table.rows and not table.damaged:
            raise UserError(f"{self.path} has no metrics yet: its first row comes when learning starts")
        if not columns or not columns["step"].size:
            raise UserError(f"no row of {self.metrics} can be read: it is damaged")
        return columns

    def machine(self) -> dict[str, Any]:
        """What machine.json says of devices and versions; nothing where it cannot be read."""
        return self._facts("machine.json")

    def write_summary(self, summary: Mapping[str, Any]) -> None:
        files.write_json(self.path / "summary.json", summary)

    def summary(self) -> dict[str, Any] | None:
        """What a finished run left; None where there is none, or none that is whole."""
        found = self._facts("summary.json")
        return found if "total_steps" in found else None

    def _facts(self, name: str) -> dict[str, Any]:
        """What a JSON file says; nothing where it is not there or damaged."""
        try:
            found = json.loads((self.path / name).read_text(encoding="utf-8"))
        except (OSError, ValueError, RecursionError):
            return {}
        return found if isinstance(found, dict) else {}


def _there(path: Path) -> str:
    return f"{path} is there already: choose another name=, or resume it with {shlex.quote(f'resume={path}')}"


def together(paths: Sequence[Path]) -> dict[str, np.ndarray]:
    """The metrics of runs that differ only in their seeds, as one table: columns [rows], by env step, then by seed.

    Columns that only some of the runs have (evaluations, say) are left out. How long runs go and what they leave behind
    (`schema.RECORDS`) may differ, too: then not every seed has every step.

    Raises UserError where there is no run or no metrics yet, where runs differ otherwise, or two have the same seed.
    """
    opened = [RunDirectory.open(path) for path in paths]
    owner: dict[int, Path] = {}
    first = learning(opened[0][1])
    for run, settings in opened:
        for key in differing([first, learning(settings)])[:1]:
            here, there = text(learning(settings).get(key)), text(first.get(key))
            raise UserError(f"{run.path} is no run with other seeds of {paths[0]}: {key}={here}, not {there}")
        for seed in settings.seed_numbers:
            if seed in owner:
                raise UserError(f"{owner[seed]} and {run.path} have the same settings and both the seed {seed}")
            owner[seed] = run.path
    tables = [run.read_metrics() for run, _ in opened]
    columns = [name for name in tables[0] if all(name in table for table in tables)]
    joined = {name: np.concatenate([table[name] for table in tables]) for name in columns}
    order = np.lexsort((joined["seed"], joined["step"]))
    return {name: column[order] for name, column in joined.items()}
