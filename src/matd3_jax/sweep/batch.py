"""Runs of a sweep that are trained side by side in one program."""

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from matd3_jax.config import Config
from matd3_jax.runs import divergence
from matd3_jax.runs.directory import RunDirectory
from matd3_jax.runtime import devices
from matd3_jax.runtime.multihost import SINGLE_PROCESS, Processes
from matd3_jax.runtime.signals import Stop
from matd3_jax.runtime.terminal import say
from matd3_jax.sweep.lineage import FILE as LINEAGE
from matd3_jax.sweep.population import Population, Rules
from matd3_jax.tracking.messages import FINISHED, STOPPED
from matd3_jax.training import best as best_evaluations
from matd3_jax.training import checkpoint, film, finish, host_states, hybrid, starting
from matd3_jax.training import run as training_run
from matd3_jax.training.film import Filmer
from matd3_jax.training.loggers import CallbackLogger, DivergenceLogger, Logger, TableLogger
from matd3_jax.training.memory import needed, of_replay
from matd3_jax.training.outputs import Outputs
from matd3_jax.training.progress import ProgressBar
from matd3_jax.training.rows import Row
from matd3_jax.training.session import TrainingSession
from matd3_jax.training.state import TrainState


class Start(NamedTuple):
    """Where a batch is trained from."""

    state: TrainState
    row: Row
    row_is_new: bool = False
    """Whether loggers have not had the row yet."""
    save_first: bool = False
    """Whether a checkpoint comes before anything else."""


class Batch:
    """Runs that share one program.

    Args:
        title: which of the sweep's batches it is, in words.
        runs, members: their directories and settings.
        checkpoints: the folder of the batch's checkpoints.
        group: the name of the sweep, by which loggers group its runs.
        processes: which train it together.
        keep_last: leave a checkpoint of all of it at its end.
        population: its runs are the members of populations.
        lineage: the file of these.
    """

    def __init__(
        self,
        title: str,
        runs: Sequence[RunDirectory],
        members: Sequence[Config],
        checkpoints: Path,
        group: str,
        processes: Processes = SINGLE_PROCESS,
        keep_last: bool = False,
        population: Rules | None = None,
        lineage: Path = Path(LINEAGE),
    ):
        self.keep_last = keep_last
        self.title, self.runs, self.members = title, list(runs), list(members)
        self.checkpoints, self.group, self.processes = checkpoints, group, processes
        self.training = TrainingSession(self.members[0], members=self.members, processes=processes)
        self.seeds = film.where(self.members)
        """Where each run's seeds are."""
        self.table = TableLogger(self.runs, self.seeds)
        self.watch = DivergenceLogger(
            self.training,
            say,
            names=[f"{c.name}: seed {seed}" for c in self.members for seed in c.seed_numbers],
        )
        self.population = None
        if population is not None:
            self.population = Population(population, self.training, self.watch.diverged, lineage)

    def train(self, stop: Stop) -> None:
        """From the last checkpoint, or from the start, to the end or until a signal comes."""
        training, begun = self.training, time.monotonic()
        training.check_memory(recorded=True)
        if self.processes.first:
            self._announce()
        start = self._begin(stop)
        if start is None:
            return
        with self._outputs() as out:
            self._train(stop, start, begun, out)

    def _outputs(self) -> Outputs:
        """Where rows go besides the directories; nowhere from other processes than the first."""
        there = slice(None) if self.processes.first else slice(0)
        parts = self.runs[there], self.members[there], self.seeds[there]
        return Outputs(*parts, say, say, self.watch.diverged, self.group)

    def _train(self, stop: Stop, start: "Start", begun: float, out: Outputs) -> None:
        training, row = self.training, start.row
        loggers: list[Logger] = []
        filmer = None
        if self.processes.first:
            if start.row_is_new:
                out.log(row)
            progress = ProgressBar(training, row, self.watch.diverged)
            loggers = [self.table, self.watch, progress, CallbackLogger(out.log)]
            if Filmer.wanted(self.members):
                filmer = Filmer(training, self.runs, self.members, self.seeds, say, out.attach)

        def save(state: TrainState, step: int) -> None:
            for run in self.runs if self.processes.first else ():
                run.sync()
            to = self.checkpoints, step, training.trainer, state
            tables = [run.metrics for run in self.runs]
            more = None if self.population is None else self.population.write
            checkpoint.save(*to, keep=1, share=training.share, best=training.best, tables=tables, more=more)

        begin = training, start.state, row
        change = self.population
        outcome = training_run.run(*begin, loggers, save, stop, start.save_first, filmer, change=change)
        if outcome.stopped is not None:
            save(outcome.state, int(outcome.row["step"][0]))
            out.how = STOPPED
            return
        if self.keep_last:
            save(outcome.state, int(outcome.row["step"][0]))
        rates = progress.rates() if self.processes.first else {}
        self._finish(outcome.state, outcome.row, {"seconds": round(time.monotonic() - begun, 1), **rates}, out)
        out.how = FINISHED

    def _begin(self, stop: Stop) -> "Start | None":
        """What to train from; None where a signal came before."""
        first, broadcast = self.processes.first, self.processes.broadcast
        for run in self.runs if first else ():
            run.clean()
            checkpoint.recover(run.checkpoints)
        if first:
            checkpoint.recover(self.checkpoints)
        if not broadcast(bool(checkpoint.steps(self.checkpoints)) if first else None):
            for run in self.runs if first else ():
                run.clear()
            if self.members[0].hands_over:
                return self._after_the_agents(stop)
            given = [starting.of_directory(run.path) for run in self.runs]
            state, row = self.training.start(starting.joined(given))
            if first:
                self.table.log(row)
                self.watch.log(row)
            if self.population is not None:
                self.population.begin(row)
            return Start(state, row, row_is_new=True, save_first=True)
        saved = Path(broadcast(str(checkpoint.verify(self.checkpoints)) if first else None))
        for line in host_states.notes(saved, self.training.trainer, unpickle=False, sweep=True) if first else ():
            say(line)
        training, done = self.training, int(saved.name)
        state = checkpoint.restore(saved, training.trainer, training.share, best=training.best)
        if self.population is not None:
            self.population.restore(saved)
        self.processes.barrier()
        for number, (run, config) in enumerate(zip(self.runs, self.members, strict=True)) if first else ():
            for line in run.cut(done, self.training.expected_table(config), saved, number):
                say(f"note: {line}")
        if first:
            self._note_diverged(done)
            say(f"resuming from the checkpoint of env step {done:,}")
        updates = self.training.trainer.updates(int(state.rollouts))
        return Start(state, {"step": np.array([done]), "updates": np.array([updates])})

    def _after_the_agents(self, stop: Stop) -> "Start | None":
        """Train the agents' parts of hybrid runs, and go on with one agent in their place."""
        training, first = self.training, self.processes.first
        settings = [hybrid.agents_settings(training, member) for member in self.members]
        machine = {"versions": devices.versions(), **devices.description()}
        for run, own in zip(self.runs, settings, strict=True) if first else ():
            hybrid.prepare(run, own, machine)
        self.processes.barrier()
        runs = [RunDirectory(run.path / hybrid.FOLDER) for run in self.runs]
        folder = self.checkpoints.with_name(hybrid.FOLDER)
        part = Batch(
            f"{self.title}, {hybrid.FOLDER}", runs, settings, folder, self.group, self.processes, keep_last=True
        )
        finished = all(run.summary() is not None for run in runs) if first else None
        if not self.processes.broadcast(finished):
            part.train(stop)
            if stop.agreed(self.processes) is not None:
                return None
        saved = Path(self.processes.broadcast(str(checkpoint.verify(folder)) if first else None))
        state = hybrid.begin(training, part.training, saved, say if first else lambda line: None)
        done = training.step(state)  # earlier than the switch where all seeds have diverged and stopped
        for run in self.runs if first else ():
            hybrid.write_table(training, part.training, run)
        if first:
            self._note_diverged(done)
            say(f"one agent takes over at env step {done:,}")
        updates = training.trainer.updates(int(state.rollouts))
        row = {"step": np.array([done]), "updates": np.array([updates])}
        return Start(state, row, save_first=True)

    def _note_diverged(self, done: int) -> None:
        """Note which seeds had diverged by env step `done`."""
        for run, config, own in zip(self.runs, self.members, self.seeds, strict=True):
            copied = None if self.population is None else self.population.lineage.copied().get(str(config.name))
            known = divergence.of_run(run, done, copied)
            self.watch.diverged |= {own.start + seed - config.seed: found for seed, found in known.items()}

    def _finish(self, state: TrainState, row: Row, facts: Mapping[str, Any], out: Outputs) -> None:
        """Leave each run as if it had been trained alone, but for its replay."""
        trainer, share, done = self.training.trainer, self.training.share, int(row["step"][0])
        facts, best = {**facts, "side_by_side": share.total}, self.training.best
        for number, (run, config, seeds) in enumerate(zip(self.runs, self.members, self.seeds, strict=True)):
            to, tables = (run.checkpoints, done, trainer, state), [run.metrics]
            saved = checkpoint.save(*to, keep=1, seeds=seeds, share=share, best=best, tables=tables)
            if not self.processes.first:
                continue
            diverged = {
                config.seed + place - seeds.start: found
                for place, found in self.watch.diverged.items()
                if seeds.start <= place < seeds.stop
            }
            settings = str(config.name), config.diagnostics.q_bias
            own_facts = {**facts, **best_evaluations.summary(saved, config.seed_numbers)}
            own_facts |= {} if self.population is None else self.population.facts(number)
            found = finish.finish(run, self.training.layout, *settings, done, own_facts, diverged)
            out.finish(number, found)

    def _announce(self) -> None:
        training, config = self.training, self.members[0]
        seeds, mesh, size = training.share.total, training.trainer.mesh, self.processes.size
        several = f" in each of {size} processes" if size > 1 else ""
        names = [str(member.name) for member in self.members]
        shown = ", ".join(names if len(names) <= 4 else [*names[:2], "...", names[-1]])
        say(f"{self.title}: {len(names)} runs, {seeds} seeds "
              f"in all, on {mesh.size} x {mesh.devices.flat[0].device_kind}{several}: {shown}")  # fmt: skip
        say(f"{config.env['name']}, {training.total_steps:,} env steps each; "
              f"{of_replay(training.trainer, self.processes)}; "
              f"{needed(training.trainer, len(training.seeds)) / 1e9:.2f} GB in all")  # fmt: skip
