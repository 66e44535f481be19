"""One training run from where it stands to its end: advance, log, checkpoint, stop."""

import time
from collections.abc import Callable, Sequence
from signal import Signals
from typing import NamedTuple

from matd3_jax.runtime.signals import Stop
from matd3_jax.training.loggers import Logger
from matd3_jax.training.loop import TrainState
from matd3_jax.training.session import Row, TrainingSession

SHARE = 20
"""Checkpoints by time take at most one part in so many of a run."""


class Outcome(NamedTuple):
    """Where a run stands when it is left."""

    state: TrainState
    row: Row
    """Of the last logging interval."""
    stopped: Signals | None
    """The signal that ended it; None where it came to its end."""


def run(
    training: TrainingSession,
    state: TrainState,
    row: Row,
    loggers: Sequence[Logger] = (),
    save: Callable[[TrainState, int], object] | None = None,
    stop: Stop | None = None,
    save_first: bool = False,
) -> Outcome:
    """Train interval after interval to the end, or until a signal comes; the loggers are closed then.

    Args:
        state, row: where the run stands; the state is donated.
        loggers: get the row of each interval; of several processes those of the first alone.
        save: writes a checkpoint of a state and its env step: called every `checkpoint_every` env steps and every
            `checkpoint_minutes`, but not at the end. Where writing takes long it waits until the training since has
            taken `SHARE` times as long.
        stop: signals that have come; None: none are heeded.
        save_first: write a checkpoint before anything is trained.
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

    try:
        if save is not None and save_first and (every or minutes):
            write(state)
        signal = stopped()
        while step < training.total_steps and signal is None:
            state, row = training.advance(state)
            step = int(row["step"][0])
            for logger in loggers:
                logger.log(row)
            if due():
                write(state)
            signal = stopped()
    finally:
        for logger in loggers:
            logger.close()
    return Outcome(state, row, signal if step < training.total_steps else None)
