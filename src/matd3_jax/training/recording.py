"""Runs that leave directories: started, or resumed from whatever a stop or a kill left."""

import contextlib
import shlex
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from matd3_jax import config
from matd3_jax.config import Config
from matd3_jax.envs.environment import Environment
from matd3_jax.envs.wrappers.joint_team import innermost
from matd3_jax.errors import UserError
from matd3_jax.runs import divergence, lock
from matd3_jax.runs.directory import RunDirectory
from matd3_jax.runs.divergence import Divergence
from matd3_jax.runtime import devices
from matd3_jax.runtime.multihost import SINGLE_PROCESS, Processes
from matd3_jax.runtime.signals import Stop
from matd3_jax.training import announcement, checkpoint, host_states, hybrid, outputs, starting
from matd3_jax.training.loggers import CallbackLogger, Logger
from matd3_jax.training.recorded_run import Listeners, Recorded, RecordedRun, Say
from matd3_jax.training.rows import Row
from matd3_jax.training.session import TrainingSession
from matd3_jax.training.state import TrainState


class Recorder:
    """Trains runs whose directories hold their settings, metrics, checkpoints and figures.

    Args:
        processes: which train together; the first alone writes and speaks.
        heed_signals: whether SIGINT, SIGTERM and SIGHUP end a run after a checkpoint (of a program of its own), or
            stay with the program that calls.
        say: gets the lines about a run; None: nothing is said, nor a progress bar shown, but a seed that diverges is
            reported by a RuntimeWarning.
        loggers: get the rows of the metrics table, films, figures and the summary, too; their errors end no run.
        callback: gets the rows; its errors do.
        stop: signals that somebody heeds already, to be heeded here, too.
    """

    def __init__(
        self,
        processes: Processes = SINGLE_PROCESS,
        heed_signals: bool = False,
        say: Say | None = None,
        loggers: Sequence[Logger] = (),
        callback: Callable[[Row], object] | None = None,
        stop: Stop | None = None,
    ):
        self.processes, self.heed_signals, self.stop = processes, heed_signals, stop
        self.listeners = Listeners(processes, say, loggers, callback)
        self.say = self.listeners.say
        self.path: Path | None = None
        """Of the last run's directory, once it is there."""

    def start(self, settings: Config, path: Path, env: Environment | None = None, or_another: bool = False) -> Recorded:
        """Train a fresh run in the directory `path`, which is made.

        Args:
            or_another: where it is there already take the first of PATH-2, PATH-3, ... that is not.

        Raises UserError where the run is impossible, before anything is written.
        """
        training = self._checked(settings, env)
        given = starting.gather(hybrid.first_session(training, settings) if settings.hands_over else training)
        if self.processes.first:
            RunDirectory.check_new(path, or_another)
        self.processes.barrier()  # nothing is written before all processes have found that they can train
        stop = self._stop()
        machine = self._machine()
        more = (lambda folder: starting.write(folder, given)) if given else None
        if self.processes.first:
            path = RunDirectory.create(path, settings, machine, or_another, more).path
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
        untouched: bool = False,
    ) -> Recorded:
        """Train a run on from its last checkpoint, or from that of env step `step`; from the start where it has none.

        A run that was left between its last checkpoint and its summary is finished.

        Args:
            total_steps: env steps of each seed from now on; None: as before.
            env: of a run whose environment was given as an object.
            unpickle: of environments on the host (see `checkpoint.restore`).
            untouched: nothing has been trained yet; no message says that it starts again.

        Raises UserError where there is no run, it has come to its end, or the checkpoint is damaged.
        """
        directory, settings = RunDirectory.open(path)
        if directory.sweep is not None and directory.summary() is None and not checkpoint.steps(directory.checkpoints):
            line = shlex.join(["python", "-m", "matd3_jax.sweep", f"resume={directory.sweep}"])
            raise UserError(f"{path} is trained together with others, by its sweep: resume it with: {line}")
        self.path = path
        if total_steps is not None:
            settings = config.from_dict({**settings.to_dict(), "total_steps": total_steps})
        with self._held(directory):
            training = self._checked(settings, env)
            stop = self._stop()
            there = bool(checkpoint.steps(directory.checkpoints)) if self.processes.first else None
            if not self.processes.broadcast(there) and step is None:
                if not (untouched or hybrid.begun(directory)):
                    self.say("no checkpoint yet: this run starts again")
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
        outputs.check(settings)
        if settings.hands_over:
            self._checked(hybrid.agents_settings(training, settings), innermost(training.env))
        return training

    def _machine(self) -> dict[str, Any]:
        """What machine.json says; asked by all processes together."""
        return {"versions": devices.versions(), **self.processes.description()}

    def _stop(self) -> Stop | None:
        return Stop() if self.heed_signals else self.stop

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
        if training.config.hands_over:
            return self._after_the_agents(training, directory, stop)
        state, row = training.start(starting.of_directory(directory.path))
        return RecordedRun(self.listeners, training, directory).train(state, row, stop, fresh=True)

    def _after_the_agents(self, training: TrainingSession, directory: RunDirectory, stop: Stop | None) -> Recorded:
        """Train the agents in a run directory of their own, then the one agent that takes over from them."""
        loggers, callback = self.listeners.loggers, self.listeners.callback
        rows = [CallbackLogger(logger.log) for logger in loggers]  # closed when the one agent is trained, too
        say = self.say if self.listeners.shows_progress else None
        part = Recorder(self.processes, False, say, rows, callback, stop)
        part_of, outcome = hybrid.train_agents(part, training, directory, self._machine())
        if outcome is not None and not outcome.finished:
            return Recorded(directory, part_of, outcome)
        del outcome  # its replay
        saved = hybrid.last_checkpoint(directory, self.processes)
        state = hybrid.begin(training, part_of, saved, self.say)
        done = training.step(state)  # earlier than the switch where all seeds have diverged and stopped
        if self.processes.first:
            hybrid.write_table(training, part_of, directory)
        self.say(f"one agent takes over at env step {done:,}")
        row = {"step": np.array([done]), "updates": np.array([training.trainer.updates(int(state.rollouts))])}
        diverged = self._diverged(training, directory, state, done)
        return RecordedRun(self.listeners, training, directory, diverged).train(state, row, stop, save_first=True)

    def _diverged(
        self, training: TrainingSession, directory: RunDirectory, state: TrainState, step: int
    ) -> dict[int, Divergence]:
        """Which seeds of a checkpoint of env step `step` had diverged, by their numbers, in the first process."""
        finite = self.processes.gather({"finite": training.finite(state)})["finite"]
        if not self.processes.first:
            return {}
        numbers = training.config.seed_numbers
        found = divergence.of_networks(finite, numbers, step)
        return divergence.earliest(divergence.of_run(directory, step), found)

    def _all_stopped(self, training: TrainingSession, directory: RunDirectory, step: int) -> bool:
        """Whether no seed is left to train at env step `step`."""
        if training.config.on_divergence != "stop_seed":
            return False
        found = len(divergence.of_run(directory, step)) if self.processes.first else None
        return self.processes.broadcast(found) == training.share.total

    def _from_checkpoint(
        self, training: TrainingSession, directory: RunDirectory, saved: Path, stop: Stop | None, unpickle: bool
    ) -> Recorded:
        done = int(saved.name)
        row = {"step": np.array([done])}
        all_stopped = self._all_stopped(training, directory, done)
        if done >= training.total_steps or all_stopped:
            if self.processes.broadcast(directory.summary() is not None if self.processes.first else None):
                where = f"{directory.path} is at env step {done:,} of {training.total_steps:,}: "
                left = "all its seeds have diverged and stopped" if all_stopped else "to train on, raise total_steps="
                raise UserError(where + left)
            state = checkpoint.restore(saved, training.trainer, training.share, best=training.best)
            ended = RecordedRun(self.listeners, training, directory, self._diverged(training, directory, state, done))
            if self.processes.first:
                self.say(f"{directory.path} has come to its end; its figures and its summary are made")
                self._notes(training, directory, done)
            return ended.finish(state, row)
        if self.processes.first:
            for line in announcement.first_lines(training, directory, done):
                self.say(line)
            self.say(f"resumed from the checkpoint of env step {done:,}")
            for line in host_states.notes(saved, training.trainer, unpickle):
                self.listeners.tell(line)
        state = checkpoint.restore(saved, training.trainer, training.share, unpickle, training.best)
        self.processes.barrier()  # the files are changed only when all have what they need
        if self.processes.first:
            checkpoint.set_aside_after(directory.checkpoints, done)
            config.write(training.config, directory.path / "config.yaml")
            self._notes(training, directory, done)
        row["updates"] = np.array([training.trainer.updates(int(state.rollouts))])
        diverged = self._diverged(training, directory, state, done)
        if diverged:
            self.say(f"note: {divergence.which(diverged)}")
        return RecordedRun(self.listeners, training, directory, diverged).train(state, row, stop)

    def _notes(self, training: TrainingSession, directory: RunDirectory, done: int) -> None:
        """Take the rows after env step `done` out of the metrics table, and say what it lacks."""
        saved = directory.checkpoints / str(done)
        for line in directory.cut(done, training.expected_table(training.config), saved):
            self.say(f"note: {line}")
