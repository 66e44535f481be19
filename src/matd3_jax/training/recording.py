"""A run that leaves a directory: started, resumed from whatever a stop or a kill left, finished."""

import contextlib
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from matd3_jax import config
from matd3_jax.config import Config
from matd3_jax.envs.environment import Environment
from matd3_jax.errors import UserError
from matd3_jax.runs import divergence, lock
from matd3_jax.runs.directory import RunDirectory
from matd3_jax.runs.divergence import Divergence
from matd3_jax.runtime import devices
from matd3_jax.runtime.multihost import SINGLE_PROCESS, Processes
from matd3_jax.runtime.signals import Stop
from matd3_jax.training import announcement, checkpoint, finish, host_states
from matd3_jax.training.loggers import DivergenceLogger, Logger, TableLogger, TensorBoardLogger, warn
from matd3_jax.training.progress import ProgressBar
from matd3_jax.training.run import Outcome, run
from matd3_jax.training.session import Row, TrainingSession
from matd3_jax.training.state import TrainState

Say = Callable[[str], None]


class Recorded(NamedTuple):
    """A run when it is left."""

    directory: RunDirectory
    training: TrainingSession
    outcome: Outcome


class Recorder:
    """Trains runs whose directories hold their settings, metrics, checkpoints and figures.

    Args:
        processes: which train together; the first alone writes and speaks.
        heed_signals: whether SIGINT, SIGTERM and SIGHUP end a run after a checkpoint (of a program of its own), or
            stay with the program that calls.
        say: gets the lines about a run; None: nothing is said, nor a progress bar shown, but of a seed that diverges a
            RuntimeWarning tells.
        loggers: get the rows of the metrics table, too.
    """

    def __init__(
        self,
        processes: Processes = SINGLE_PROCESS,
        heed_signals: bool = False,
        say: Say | None = None,
        loggers: Sequence[Logger] = (),
    ):
        self.processes, self.loggers = processes, loggers
        self.heed_signals = heed_signals
        self.say: Say = say if say is not None and processes.first else lambda line: None
        self.shows_progress = say is not None
        self.path: Path | None = None
        """Of the last run's directory, once it is there."""

    def start(self, settings: Config, path: Path, env: Environment | None = None, or_another: bool = False) -> Recorded:
        """Train a fresh run in the directory `path`, which is made.

        Args:
            or_another: where it is there already take the first of PATH-2, PATH-3, ... that is not.

        Raises UserError where the run is impossible, before anything is written.
        """
        training = self._checked(settings, env)
        if self.processes.first:
            RunDirectory.check_new(path, or_another)
        self.processes.barrier()  # nothing is written before all processes have found that they can train
        stop = self._stop()
        machine = {"versions": devices.versions(), **self.processes.description()}
        if self.processes.first:
            path = RunDirectory.create(path, settings, machine, or_another).path
        directory = RunDirectory(self.processes.same_directory(path))
        self.path = directory.path
        with self._held(directory):
            return self._from_the_start(training, directory, stop)

    def resume(
        self,
        path: Path,
        step: int | None = None,
        total_steps: int | None = None,
        env: Environment | None = None,
        unpickle: bool = False,
    ) -> Recorded:
        """Train a run on from its last checkpoint, or from that of env step `step`; from the start where it has none.

        A run that was left between its last checkpoint and its summary is finished.

        Args:
            total_steps: env steps of each seed from now on; None: as before.
            env: of a run whose environment was given as an object.
            unpickle: of environments on the host (see `checkpoint.restore`).

        Raises UserError where there is no run, it has come to its end, or the checkpoint is damaged.
        """
        directory, settings = RunDirectory.open(path)
        self.path = path
        if total_steps is not None:
            settings = config.from_dict({**settings.to_dict(), "total_steps": total_steps})
        with self._held(directory):
            training = self._checked(settings, env)
            stop = self._stop()
            there = bool(checkpoint.steps(directory.checkpoints)) if self.processes.first else None
            if not self.processes.broadcast(there) and step is None:
                self.say("no checkpoint yet: this run starts anew")
                if self.processes.first:
                    directory.clear()
                return self._from_the_start(training, directory, stop)
            saved = Path(
                self.processes.broadcast(
                    str(checkpoint.verify(directory.checkpoints, step)) if self.processes.first else None
                )
            )
            return self._from_checkpoint(training, directory, saved, stop, unpickle)

    def _checked(self, settings: Config, env: Environment | None) -> TrainingSession:
        training = TrainingSession(settings, env, processes=self.processes)
        training.check_memory(recorded=True)
        if settings.tensorboard:
            TensorBoardLogger.check()
        return training

    def _stop(self) -> Stop | None:
        return Stop() if self.heed_signals else None

    @contextlib.contextmanager
    def _held(self, directory: RunDirectory) -> Iterator[None]:
        """The directory's lock, which the first process holds for all."""
        with lock.held(directory.path) if self.processes.first else contextlib.nullcontext():
            if self.processes.first:
                directory.clean()
                checkpoint.recover(directory.checkpoints)
            yield

    def _from_the_start(self, training: TrainingSession, directory: RunDirectory, stop: Stop | None) -> Recorded:
        for line in announcement.first_lines(training, directory) if self.processes.first else ():
            self.say(line)
        state, row = training.start()
        if self.processes.first:
            directory.append(row)
            for logger in self.loggers:
                logger.log(row)
        watch = self._watch(training, {})
        if self.processes.first:
            watch.log(row)
        return self._to_the_end(training, directory, state, row, stop, watch, fresh=True)

    def _watch(self, training: TrainingSession, diverged: Mapping[int, Divergence]) -> DivergenceLogger:
        """Knows what has diverged so far, given by the numbers of the seeds."""
        known = {seed - training.config.seed: found for seed, found in diverged.items()}
        return DivergenceLogger(training, self.say if self.shows_progress else warn, known)

    def _diverged(
        self, training: TrainingSession, directory: RunDirectory, state: TrainState, step: int
    ) -> dict[int, Divergence]:
        """Which seeds of a checkpoint of env step `step` had diverged, by their numbers, in the first process."""
        finite = self.processes.gather({"finite": training.finite(state)})["finite"]
        if not self.processes.first:
            return {}
        numbers = range(training.config.seed, training.config.seed + training.config.seeds)
        found = divergence.of_networks(finite, numbers, step)
        return divergence.earliest(divergence.of_run(directory, step), found)

    def _from_checkpoint(
        self, training: TrainingSession, directory: RunDirectory, saved: Path, stop: Stop | None, unpickle: bool
    ) -> Recorded:
        done = int(saved.name)
        row = {"step": np.array([done])}
        if done >= training.total_steps:
            if self.processes.broadcast(directory.summary() is not None if self.processes.first else None):
                raise UserError(
                    f"{directory.path} is at env step {done:,} of {training.total_steps:,}: to train on, raise "
                    "total_steps="
                )
            state = checkpoint.restore(saved, training.trainer, training.share)
            watch = self._watch(training, self._diverged(training, directory, state, done))
            if self.processes.first:
                self.say(f"{directory.path} has come to its end; its figures and its summary are made")
                self._notes(training, directory, done)
                self._finish(training, directory, {}, watch)
            return Recorded(directory, training, Outcome(state, row, None, watch.diverged))
        if self.processes.first:
            for line in announcement.first_lines(training, directory, done):
                self.say(line)
            self.say(f"resumed from the checkpoint of env step {done:,}")
            for line in host_states.notes(saved, training.trainer, unpickle):
                (self.say if self.shows_progress else warn)(line)
        state = checkpoint.restore(saved, training.trainer, training.share, unpickle)
        self.processes.barrier()  # the files are changed only when all have what they need
        if self.processes.first:
            checkpoint.set_aside_after(directory.checkpoints, done)
            config.write(training.config, directory.path / "config.yaml")
            self._notes(training, directory, done)
        row["updates"] = np.array([training.trainer.updates(int(state.rollouts))])
        diverged = self._diverged(training, directory, state, done)
        if diverged:
            self.say(f"note: {divergence.which(diverged)}")
        return self._to_the_end(training, directory, state, row, stop, self._watch(training, diverged))

    def _notes(self, training: TrainingSession, directory: RunDirectory, done: int) -> None:
        """Take the rows after env step `done` out of the metrics table, and say what it lacks."""
        table = directory.cut(done)
        if table.damaged:
            plural = "s" * (table.damaged > 1)
            self.say(f"note: {directory.metrics} had {table.damaged} damaged line{plural}, left out now")
        first, interval = training.trainer.schedule.warmup_steps, training.interval_steps
        gaps = table.gaps(first, done, interval, training.share.total)
        if gaps:
            shown = ", ".join(f"{a:,} and {b:,}" for a, b in gaps[:3]) + (", ..." if len(gaps) > 3 else "")
            self.say(f"note: {directory.metrics} lacks rows between env steps {shown}")

    def _to_the_end(
        self,
        training: TrainingSession,
        directory: RunDirectory,
        state: TrainState,
        row: Row,
        stop: Stop | None,
        watch: DivergenceLogger,
        fresh: bool = False,
    ) -> Recorded:
        """Train to the end, or until a signal comes or a seed diverges that must not."""
        settings, begun = training.config, time.monotonic()
        loggers: list[Logger] = []
        progress = None
        if self.processes.first:
            loggers = [TableLogger([directory]), watch]
            if self.shows_progress:
                progress = ProgressBar(training, row, watch.diverged)
                loggers.append(progress)
            if settings.tensorboard:
                loggers.append(TensorBoardLogger([directory]))
            loggers += self.loggers

        def save(state: TrainState, step: int) -> None:
            keep = settings.keep_checkpoints
            if self.processes.first:
                directory.sync()
            checkpoint.save(directory.checkpoints, step, training.trainer, state, keep, share=training.share)

        outcome = run(training, state, row, loggers, save, stop, save_first=fresh)
        step = int(outcome.row["step"][0])
        save(outcome.state, step)
        if self.processes.first:
            if outcome.finished:
                rates = {} if progress is None else progress.rates()
                self._finish(training, directory, {"seconds": round(time.monotonic() - begun, 1), **rates}, watch)
            else:
                title, diverged = announcement.title(training), self._by_number(training, watch)
                finish.draw(directory, training.layout, title, settings.diagnostics.q_bias, diverged)
        return Recorded(directory, training, outcome)

    def _finish(self, training: TrainingSession, directory: RunDirectory, facts: dict, watch: DivergenceLogger) -> None:
        title, diverged = announcement.title(training), self._by_number(training, watch)
        found = finish.finish(directory, training.layout, title, training.config.diagnostics.q_bias, facts, diverged)
        for line in announcement.last_lines(training, directory, found, diverged):
            self.say(line)

    @staticmethod
    def _by_number(training: TrainingSession, watch: DivergenceLogger) -> dict[int, Divergence]:
        return {training.config.seed + place: found for place, found in sorted(watch.diverged.items())}
