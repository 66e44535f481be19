"""What a run directory holds and what is damaged in it. Nothing is changed."""

import dataclasses
from pathlib import Path

from matd3_jax.config import Config
from matd3_jax.errors import OptionError, UserError
from matd3_jax.runs import lock
from matd3_jax.runs.directory import FORMAT, RunDirectory
from matd3_jax.runs.metrics_table import MetricsTable
from matd3_jax.runs.missing import Expected
from matd3_jax.runtime import files
from matd3_jax.training import best, checkpoint, checksums, starting
from matd3_jax.training.session import TrainingSession

SHOWN = 4
"""Best evaluations of seeds, at most."""


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
        """Env step of the last checkpoint that is whole; None: the run starts again."""
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
            *self._best(),
            f"metrics: {rows}",
            f"summary: {'there' if self.finished else 'none: the run has not come to its end'}",
            f"lock: {state}",
        ]
        if aside:
            lines.append(f"set aside, until the next checkpoint: {', '.join(aside)}")
        if partial:
            lines.append(f"left by a write that was cut short, removed by the next resume: {', '.join(partial)}")
        return lines

    def _best(self) -> list[str]:
        """The best evaluations that the last whole checkpoint has."""
        if not self.whole:
            return []
        seeds = range(self.settings.seed, self.settings.seed + self.settings.seeds)
        found = best.facts(self.run.checkpoints / str(self.whole[-1]), seeds)
        shown = [f"seed {seed} {one}" for seed, one in found.items()]
        more = [f"and {len(shown) - SHOWN} more"] if len(shown) > SHOWN else []
        return [f"best evaluations: {', '.join([*shown[:SHOWN], *more])}"] if found else []


def of_run(path: Path) -> Condition:
    """The condition of a run. Raises UserError where there is none, or its settings cannot be read."""
    run, settings = RunDirectory.open(path)
    found = {step: checksums.damage(run.checkpoints / str(step)) for step in checkpoint.steps(run.checkpoints)}
    damaged = {step: why for step, why in found.items() if why is not None}
    whole = tuple(step for step, why in found.items() if why is None)
    table, done = run.table(), whole[-1] if whole else 0
    expected = _expected(settings, table)
    problems = [f"checkpoint {step:,} is damaged ({why})" for step, why in damaged.items()]
    problems += run.losses(table, done, expected, run.checkpoints / str(done))
    gaps = tuple(expected.gaps(table, done))
    if (run.path / "summary.json").exists() and run.summary() is None:
        problems.append(f"{run.path / 'summary.json'} is not whole: a resume makes it again")
    if not run.machine():
        problems.append(f"{run.path / 'machine.json'} is missing or not whole: versions and devices are lost")
    if starting.needed(settings) and not whole:
        try:
            starting.read(run.path)
        except UserError as error:
            problems.append(str(error))
    for link in run.in_place:
        if link.is_symlink():
            problems.append(f"{link} is a link: a resume writes nothing through it")
    return Condition(run, settings, whole, damaged, table, gaps, lock.holder(run.path), tuple(problems))


def _expected(settings: Config, table: MetricsTable) -> Expected:
    """What the metrics table should have, as a resume will say."""
    try:
        return TrainingSession(settings).expected_table(settings)
    except (UserError, OptionError):  # an environment of one's own, or one that is not installed here
        return Expected(table.header, settings.seed_numbers, first=0, interval=0)
