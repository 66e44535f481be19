"""What a run directory holds and what is damaged in it. Nothing is changed."""

import dataclasses
import json
from pathlib import Path

from matd3_jax.config import Config
from matd3_jax.errors import OptionError, UserError
from matd3_jax.runs import lock
from matd3_jax.runs.directory import FORMAT, RunDirectory
from matd3_jax.runs.metrics_table import MetricsTable
from matd3_jax.runtime import files
from matd3_jax.training import checkpoint
from matd3_jax.training.session import TrainingSession


@dataclasses.dataclass(frozen=True)
class Condition:
    """Of one run directory."""

    run: RunDirectory
    settings: Config
    whole: tuple[int, ...]
    """Env steps of the checkpoints that can be read, ascending."""
    damaged: dict[int, str]
    """Env steps of those that cannot, and why."""
    table: MetricsTable
    gaps: tuple[tuple[int, int], ...]
    """Pairs of env steps between which the metrics table lacks rows."""
    holder: str | None
    """The process that works in the directory."""
    problems: tuple[str, ...]
    """What is damaged, a line each."""

    @property
    def finished(self) -> bool:
        """Whether the run has come to its end and has its summary."""
        return self.run.summary() is not None

    @property
    def resumable_from(self) -> int | None:
        """Env step of the last checkpoint that is whole; None: the run starts anew."""
        return self.whole[-1] if self.whole else None

    @property
    def needs_step(self) -> bool:
        """Whether that checkpoint has to be named, as a later one is damaged."""
        return bool(self.whole and self.damaged) and max(self.damaged) > self.whole[-1]

    def lines(self) -> list[str]:
        """What the directory holds, a line each."""
        settings, table, run = self.settings, self.table, self.run
        state = "free" if self.holder is None else f"held: {self.holder} works in it"
        steps = [f"{step:,}" for step in self.whole]
        rows = f"{len(table.rows):,} rows to env step {int(table.rows[-1][0]):,}" if table.rows else "none yet"
        partial = [path.name for path in (*files.partial(run.path), *run.checkpoints.glob(".*.partial"))]
        aside = sorted(path.name for path in run.checkpoints.glob(f"*{checkpoint.ASIDE}"))
        lines = [
            f"settings: {settings.env['name']}, {settings.algo.name}, seeds {settings.seed} to "
            f"{settings.seed + settings.seeds - 1}, {settings.total_steps:,} env steps each",
            f"format: {run.format} (this version writes {FORMAT})",
            f"checkpoints: {', '.join(steps) or 'none'}",
            f"metrics: {rows}",
            f"summary: {'there' if self.finished else 'none: the run has not come to its end'}",
            f"lock: {state}",
        ]
        if aside:
            lines.append(f"set aside, until the next checkpoint: {', '.join(aside)}")
        if partial:
            lines.append(f"left by a write that was cut short, removed by the next resume: {', '.join(partial)}")
        return lines


def of_run(path: Path) -> Condition:
    """The condition of a run. Raises UserError where there is none, or its settings cannot be read."""
    run, settings = RunDirectory.open(path)
    found = {step: checkpoint.damage(run.checkpoints / str(step)) for step in checkpoint.steps(run.checkpoints)}
    damaged = {step: why for step, why in found.items() if why is not None}
    whole = tuple(step for step, why in found.items() if why is None)
    table = run.table()
    problems = [f"checkpoint {step:,} is damaged ({why})" for step, why in damaged.items()]
    if table.damaged:
        problems.append(f"{run.metrics}: {table.damaged} damaged line{'s' * (table.damaged > 1)}, left out by a resume")
    gaps = tuple(_gaps(settings, table, whole[-1] if whole else 0))
    problems += [f"{run.metrics} lacks rows between env steps {a:,} and {b:,}" for a, b in gaps]
    if (run.path / "summary.json").exists() and run.summary() is None:
        problems.append(f"{run.path / 'summary.json'} is not whole: a resume makes it anew")
    if not _readable(run.path / "machine.json"):
        problems.append(f"{run.path / 'machine.json'} is missing or not whole: versions and devices are lost")
    for link in run.in_place:
        if link.is_symlink():
            problems.append(f"{link} is a link: a resume writes nothing through it")
    return Condition(run, settings, whole, damaged, table, gaps, lock.holder(run.path), tuple(problems))


def _gaps(settings: Config, table: MetricsTable, done: int) -> list[tuple[int, int]]:
    """Where rows are missing up to the checkpoint of env step `done`, as a resume will say."""
    if not done:
        return []
    try:
        training = TrainingSession(settings)
    except (UserError, OptionError):  # an environment of one's own, or one that is not installed here
        return table.gaps(0, done, done, settings.seeds) if not table.rows else []
    first, interval = training.trainer.schedule.warmup_steps, training.interval_steps
    return table.until(done).gaps(first, done, interval, settings.seeds)


def _readable(path: Path) -> bool:
    try:
        return isinstance(json.loads(path.read_text(encoding="utf-8")), dict)
    except (OSError, ValueError, RecursionError):
        return False
