"""A run that trains in its directory: rows, checkpoints and films are written on the way, figures and a summary at the
end."""

import time
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

from matd3_jax.runs.directory import RunDirectory
from matd3_jax.runs.divergence import Divergence
from matd3_jax.runtime.multihost import Processes
from matd3_jax.runtime.signals import Stop
from matd3_jax.tracking.messages import FAILED, FINISHED, STOPPED
from matd3_jax.training import announcement, best, checkpoint, finish
from matd3_jax.training.film import Filmer
from matd3_jax.training.loggers import CallbackLogger, DivergenceLogger, Logger, TableLogger, warn
from matd3_jax.training.outputs import Outputs
from matd3_jax.training.progress import ProgressBar
from matd3_jax.training.rows import Row
from matd3_jax.training.run import Outcome, run
from matd3_jax.training.session import TrainingSession
from matd3_jax.training.state import TrainState

Say = Callable[[str], None]


class Listeners:
    """Who hears of a run: arguments as for `recording.Recorder`."""

    def __init__(
        self,
        processes: Processes,
        say: Say | None,
        loggers: Sequence[Logger],
        callback: Callable[[Row], object] | None,
    ):
        self.processes, self.loggers, self.callback = processes, loggers, callback
        self.say: Say = say if say is not None and processes.first else lambda line: None
        self.shows_progress = say is not None
        self.tell: Say = self.say if self.shows_progress else warn
        """What gets warnings."""


class Recorded(NamedTuple):
    """A run when it is left."""

    directory: RunDirectory
    training: TrainingSession
    outcome: Outcome


class RecordedRun:
    """A run whose directory is there and locked.

    Args:
        diverged: what has diverged so far, by the numbers of the seeds.
    """

    def __init__(
        self,
        listeners: Listeners,
        training: TrainingSession,
        directory: RunDirectory,
        diverged: Mapping[int, Divergence] | None = None,
    ):
        self.listeners, self.training, self.directory = listeners, training, directory
        self.first = listeners.processes.first
        known = {seed - training.config.seed: found for seed, found in (diverged or {}).items()}
        self.watch = DivergenceLogger(training, listeners.tell, known)

    def outputs(self) -> Outputs:
        """The loggers beside the run's directory; none in other processes than the first."""
        training, listeners = self.training, self.listeners
        seeds = [slice(0, training.share.total)]
        runs, members = ([self.directory], [training.config]) if self.first else ([], [])
        own = listeners.loggers if self.first else ()
        places = seeds[: len(runs)]
        return Outputs(runs, members, places, listeners.tell, listeners.say, self.watch.diverged, own=own)

    def train(
        self, state: TrainState, row: Row, stop: Stop | None, fresh: bool = False, save_first: bool = False
    ) -> Recorded:
        """Train to the end, or until a signal comes or a seed diverges that must not.

        Args:
            row: of `state`.
            fresh: nothing of the run is written yet: `row` is its table's first, and a checkpoint comes first.
            save_first: begin with a checkpoint.
        """
        if fresh and self.first:
            self.directory.append(row)
            self.watch.log(row)
        with self.outputs() as out:
            return self._trained(state, row, stop, fresh, fresh or save_first, out)

    def finish(self, state: TrainState, row: Row) -> Recorded:
        """Make the figures and the summary of a run that had come to its end at the env step of `row`."""
        if self.first:
            with self.outputs() as out:
                self._finish(int(row["step"][0]), {}, out)
        return Recorded(self.directory, self.training, Outcome(state, row, None, self.watch.diverged))

    def _trained(
        self, state: TrainState, row: Row, stop: Stop | None, fresh: bool, save_first: bool, out: Outputs
    ) -> Recorded:
        training, directory, listeners = self.training, self.directory, self.listeners
        settings, begun = training.config, time.monotonic()
        loggers: list[Logger] = []
        progress = film = None
        if self.first:
            loggers = [TableLogger([directory]), self.watch]
            others = [CallbackLogger(out.log)]  # closed later: the summary is still to come
            others += [] if listeners.callback is None else [CallbackLogger(listeners.callback)]
            for logger in others if fresh else ():
                logger.log(row)
            if listeners.shows_progress:
                progress = ProgressBar(training, row, self.watch.diverged)
                loggers.append(progress)
            loggers += others
            if Filmer.wanted([settings]):
                seeds = [slice(0, len(training.seeds))]
                film = Filmer(training, [directory], [settings], seeds, listeners.tell, out.attach)

        def save(state: TrainState, step: int) -> None:
            keep = settings.keep_checkpoints
            if self.first:
                directory.sync()
            to = directory.checkpoints, step, training.trainer, state, keep
            checkpoint.save(*to, share=training.share, best=training.best, tables=[directory.metrics])

        outcome = run(training, state, row, loggers, save, stop, save_first, film)
        step = int(outcome.row["step"][0])
        save(outcome.state, step)
        if self.first:
            if outcome.finished:
                rates = {} if progress is None else progress.rates()
                self._finish(step, {"seconds": round(time.monotonic() - begun, 1), **rates}, out)
            else:
                out.how = STOPPED if outcome.stopped is not None else FAILED
                title = announcement.title(training)
                finish.draw(directory, training.layout, title, settings.diagnostics.q_bias, self._diverged())
        return Recorded(directory, training, outcome)

    def _finish(self, done: int, facts: dict, out: Outputs) -> None:
        training, directory, diverged = self.training, self.directory, self._diverged()
        title, with_q_bias = announcement.title(training), training.config.diagnostics.q_bias
        last = directory.checkpoints / str(checkpoint.steps(directory.checkpoints)[-1])
        facts = {**facts, **best.summary(last, training.config.seed_numbers)}
        found = finish.finish(directory, training.layout, title, with_q_bias, done, facts, diverged)
        for line in announcement.last_lines(training, directory, found, diverged):
            self.listeners.say(line)
        out.finish(0, found)
        out.how = FINISHED

    def _diverged(self) -> dict[int, Divergence]:
        """What has diverged, by the numbers of the seeds."""
        return {self.training.config.seed + place: found for place, found in sorted(self.watch.diverged.items())}
