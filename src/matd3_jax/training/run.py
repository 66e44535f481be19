"""One training run from where it stands to its end: advance, log, checkpoint, stop."""

import time
from collections.abc import Callable, Mapping, Sequence
from signal import Signals
from typing import NamedTuple

from matd3_jax.runs.divergence import Divergence
from matd3_jax.runtime.signals import Stop
from matd3_jax.training.loggers import DivergenceLogger, Logger
from matd3_jax.training.rows import Row
from matd3_jax.training.session import TrainingSession
from matd3_jax.training.state import TrainState

SHARE = 20
"""Checkpoints by time take at most one part in so many of a run."""


class Outcome(NamedTuple):
    """Where a run stands when it is left."""

    state: TrainState
    row: Row
    """Of the last logging interval."""
    stopped: Signals | None
    """The signal that ended it; None where none did."""
    diverged: Mapping[int, Divergence]
    """By the places of the seeds in the rows; of several processes in the first of them."""
    halted: bool = False
    """Whether `on_divergence=stop` ended it."""

    @property
    def finished(self) -> bool:
        """Whether it was trained to its end."""
        return self.stopped is None and not self.halted


def run(
    training: TrainingSession,
    state: TrainState,
    row: Row,
    loggers: Sequence[Logger] = (),
    save: Callable[[TrainState, int], object] | None = None,
    stop: Stop | None = None,
    save_first: bool = False,
    film: Callable[[TrainState, int, int], object] | None = None,
    change: Callable[[TrainState, Row, int], TrainState] | None = None,
) -> Outcome:
    """Train interval after interval to the end, or until a signal comes, or with `on_divergence=stop` until a seed
    diverges, with `stop_seed` until all have; the loggers are closed then.

    Args:
        state, row: where the run stands; the state is donated.
        loggers: get the row of each interval; of several processes those of the first alone. Its `DivergenceLogger`
            knows which seeds have diverged.
        save: writes a checkpoint of a state and its env step: called every `checkpoint_every` env steps and every
            `checkpoint_minutes`, but not at the end. Where writing takes long it waits until the training since has
            taken `SHARE` times as long.
        stop: signals that have come; None: none are heeded.
        save_first: write a checkpoint before anything is trained.
        film: sees the state after each interval, with the env steps before and after it.
        change: gives the state to train on from after each interval, from its state and row and the env step before it.
    """
    step = saved = int(row["step"][0])
    every, minutes = training.checkpoint_every, training.config.checkpoint_minutes
    begun = ended = time.monotonic()

    def write(state: TrainState) -> None:
        nonlocal saved, begun, ended
        begun = time.monotonic()
        save(state, step)  # type: ignore[misc]
        saved, ended = step, time.monotonic()

    def due() -> bool:
        if save is None or step >= training.total_steps:
            return False
        wait = max(60 * minutes, SHARE * (ended - begun))
        late = minutes > 0 and time.monotonic() - ended >= wait
        return (every > 0 and step - saved >= every) or bool(training.processes.agree(int(late)))

    def stopped() -> Signals | None:
        return None if stop is None else stop.agreed(training.processes)

    watch = next((logger for logger in loggers if isinstance(logger, DivergenceLogger)), None)

    def agreed(mode: str, there: Callable[[DivergenceLogger], bool]) -> bool:
        if training.config.on_divergence != mode:
            return False
        return bool(training.processes.agree(int(watch is not None and there(watch))))

    halt = ended_early = False
    try:
        if save is not None and save_first and (every or minutes):
            write(state)
        signal = stopped()
        while step < training.total_steps and signal is None and not halt and not ended_early:
            state, row = training.advance(state)
            before, step = step, int(row["step"][0])
            for logger in loggers:
                logger.log(row)
            if film is not None:
                film(state, before, step)
            if change is not None:
                state = change(state, row, before)
            if due():
                write(state)
            signal, halt = stopped(), agreed("stop", lambda watch: watch.new > 0)
            ended_early = agreed("stop_seed", lambda watch: watch.everywhere)  # nobody is left who learns
    finally:
        for logger in loggers:
            logger.close()
    diverged = {} if watch is None else watch.diverged
    left = step < training.total_steps and not ended_early
    return Outcome(state, row, signal if left else None, diverged, left and halt and signal is None)
