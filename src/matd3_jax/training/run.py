"""One training run from where it stands to its end: advance, log, checkpoint, stop."""

from collections.abc import Callable, Sequence
from signal import Signals
from typing import NamedTuple

from matd3_jax.runtime.signals import Stop
from matd3_jax.training.loggers import Logger
from matd3_jax.training.session import Row, TrainingSession
from matd3_jax.training.state import TrainState


class Outcome(NamedTuple):
    """Where a run stands when it is left."""

    state: TrainState
    row: Row
    """Of the last logging interval."""
    stopped: Signals | None
    """The signal that ended it; None where it was trained to its end."""


def run(
    training: TrainingSession,
    state: TrainState,
    row: Row,
    loggers: Sequence[Logger] = (),
    save: Callable[[TrainState, int], object] | None = None,
    stop: Stop | None = None,
) -> Outcome:
    """Train interval after interval to the end, or until a signal comes; the loggers are closed then.

    Args:
        state, row: where the run stands; the state is donated.
        loggers: get the row of each interval; of several processes those of the first alone.
        save: writes a checkpoint of a state and its env step: called every `checkpoint_every` env steps, but not at
            the end.
        stop: signals that have come; None: none are heeded.
    """
    step = saved = int(row["step"][0])
    every = training.checkpoint_every

    def stopped() -> Signals | None:
        return None if stop is None else stop.agreed(training.processes)

    try:
        signal = stopped()
        while step < training.total_steps and signal is None:
            state, row = training.advance(state)
            step = int(row["step"][0])
            for logger in loggers:
                logger.log(row)
            if save is not None and every and step - saved >= every and step < training.total_steps:
                save(state, step)
                saved = step
            signal = stopped()
    finally:
        for logger in loggers:
            logger.close()
    return Outcome(state, row, signal if step < training.total_steps else None)
