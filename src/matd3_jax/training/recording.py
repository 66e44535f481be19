"""A run that leaves a directory: started, resumed from whatever a stop or a kill left, finished."""

import contextlib
import shlex
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

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
from matd3_jax.tracking.messages import FAILED, FINISHED, STOPPED
from matd3_jax.training import announcement, best, checkpoint, finish, host_states, hybrid, outputs, starting
from matd3_jax.training.film import Filmer
from matd3_jax.training.loggers import CallbackLogger, DivergenceLogger, Logger, TableLogger, warn
from matd3_jax.training.outputs import Outputs
from matd3_jax.training.progress import ProgressBar
from matd3_jax.training.rows import Row
from matd3_jax.training.run import Outcome, run
from matd3_jax.training.session import TrainingSession
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
        self.processes, self.loggers, self.callback = processes, loggers, callback
        self.heed_signals, self.stop = heed_signals, stop
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
        watch = self._watch(training, {})
        if self.processes.first:
            directory.append(row)
            watch.log(row)
        return self._to_the_end(training, directory, state, row, stop, watch, fresh=True)

    def _after_the_agents(self, training: TrainingSession, directory: RunDirectory, stop: Stop | None) -> Recorded:
        """Train the agents in a run directory of their own, then the one agent that takes over from them."""
        rows = [CallbackLogger(logger.log) for logger in self.loggers]  # closed when the one agent is trained, too
        part = Recorder(self.processes, False, self.say if self.shows_progress else None, rows, self.callback, stop)
        part_of, outcome = hybrid.train_agents(part, training, directory, self._machine())
        if outcome is not None and not outcome.finished:
            return Recorded(directory, part_of, outcome)
        del outcome  # its replay
        saved = hybrid.last_checkpoint(directory, self.processes)
        state = hybrid.begin(training, part_of, saved)
        done = training.step(state)  # earlier than the switch where all seeds have diverged and stopped
        if self.processes.first:
            hybrid.write_table(training, part_of, directory)
        self.say(f"one agent takes over at env step {done:,}")
        row = {"step": np.array([done]), "updates": np.array([training.trainer.updates(int(state.rollouts))])}
        watch = self._watch(training, self._diverged(training, directory, state, done))
        return self._to_the_end(training, directory, state, row, stop, watch, save_first=True)

    @property
    def _tell(self) -> Say:
        """What gets warnings."""
        return self.say if self.shows_progress else warn

    def _watch(self, training: TrainingSession, diverged: Mapping[int, Divergence]) -> DivergenceLogger:
        """Knows what has diverged so far, given by the numbers of the seeds."""
        known = {seed - training.config.seed: found for seed, found in diverged.items()}
        return DivergenceLogger(training, self._tell, known)

    def _outputs(self, training: TrainingSession, directory: RunDirectory, watch: DivergenceLogger) -> Outputs:
        """The loggers beside the run's directory; none in other processes than the first."""
        seeds, first = [slice(0, training.share.total)], self.processes.first
        runs, members, own = ([directory], [training.config], self.loggers) if first else ([], [], ())
        return Outputs(runs, members, seeds[: len(runs)], self._tell, self.say, watch.diverged, own=own)

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
            watch = self._watch(training, self._diverged(training, directory, state, done))
            if self.processes.first:
                self.say(f"{directory.path} has come to its end; its figures and its summary are made")
                self._notes(training, directory, done)
                with self._outputs(training, directory, watch) as out:
                    self._finish(training, directory, done, {}, watch, out)
            return Recorded(directory, training, Outcome(state, row, None, watch.diverged))
        if self.processes.first:
            for line in announcement.first_lines(training, directory, done):
                self.say(line)
            self.say(f"resumed from the checkpoint of env step {done:,}")
            for line in host_states.notes(saved, training.trainer, unpickle):
                self._tell(line)
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
        return self._to_the_end(training, directory, state, row, stop, self._watch(training, diverged))

    def _notes(self, training: TrainingSession, directory: RunDirectory, done: int) -> None:
        """Take the rows after env step `done` out of the metrics table, and say what it lacks."""
        saved = directory.checkpoints / str(done)
        for line in directory.cut(done, training.expected_table(training.config), saved):
            self.say(f"note: {line}")

    def _to_the_end(
        self,
        training: TrainingSession,
        directory: RunDirectory,
        state: TrainState,
        row: Row,
        stop: Stop | None,
        watch: DivergenceLogger,
        fresh: bool = False,
        save_first: bool = False,
    ) -> Recorded:
        """Train to the end, or until a signal comes or a seed diverges that must not."""
        with self._outputs(training, directory, watch) as out:
            return self._trained(training, directory, state, row, stop, watch, fresh, fresh or save_first, out)

    def _trained(
        self,
        training: TrainingSession,
        directory: RunDirectory,
        state: TrainState,
        row: Row,
        stop: Stop | None,
        watch: DivergenceLogger,
        fresh: bool,
        save_first: bool,
        out: Outputs,
    ) -> Recorded:
        settings, begun = training.config, time.monotonic()
        loggers: list[Logger] = []
        progress = film = None
        if self.processes.first:
            loggers = [TableLogger([directory]), watch]
            others = [CallbackLogger(out.log)]  # closed later: the summary is still to come
            others += [] if self.callback is None else [CallbackLogger(self.callback)]
            for logger in others if fresh else ():
                logger.log(row)
            if self.shows_progress:
                progress = ProgressBar(training, row, watch.diverged)
                loggers.append(progress)
            loggers += others
            if Filmer.wanted([settings]):
                seeds = [slice(0, len(training.seeds))]
                film = Filmer(training, [directory], [settings], seeds, self._tell, out.attach)

        def save(state: TrainState, step: int) -> None:
            keep = settings.keep_checkpoints
            if self.processes.first:
                directory.sync()
            to = directory.checkpoints, step, training.trainer, state, keep
            checkpoint.save(*to, share=training.share, best=training.best, tables=[directory.metrics])

        outcome = run(training, state, row, loggers, save, stop, save_first, film)
        step = int(outcome.row["step"][0])
        save(outcome.state, step)
        if self.processes.first:
            if outcome.finished:
                rates = {} if progress is None else progress.rates()
                facts = {"seconds": round(time.monotonic() - begun, 1), **rates}
                self._finish(training, directory, step, facts, watch, out)
            else:
                out.how = STOPPED if outcome.stopped is not None else FAILED
                title, diverged = announcement.title(training), self._by_number(training, watch)
                finish.draw(directory, training.layout, title, settings.diagnostics.q_bias, diverged)
        return Recorded(directory, training, outcome)

    def _finish(
        self,
        training: TrainingSession,
        directory: RunDirectory,
        done: int,
        facts: dict,
        watch: DivergenceLogger,
        out: Outputs,
    ) -> None:
        diverged, with_q_bias = self._by_number(training, watch), training.config.diagnostics.q_bias
        title = announcement.title(training)
        last = directory.checkpoints / str(checkpoint.steps(directory.checkpoints)[-1])
        numbers = training.config.seed_numbers
        facts = {**facts, **best.summary(last, numbers)}
        found = finish.finish(directory, training.layout, title, with_q_bias, done, facts, diverged)
        for line in announcement.last_lines(training, directory, found, diverged):
            self.say(line)
        out.finish(0, found)
        out.how = FINISHED

    @staticmethod
    def _by_number(training: TrainingSession, watch: DivergenceLogger) -> dict[int, Divergence]:
        return {training.config.seed + place: found for place, found in sorted(watch.diverged.items())}
