"""Where a run's time goes: training, evaluations, compiling."""

import contextlib
import time
from collections.abc import Iterator

import jax

_compiled: list[tuple[float, float]] = []
"""Times (begin, end) in which this process traced and compiled programs, in order."""


def _note(event: str, duration_secs: float, **_: str | int) -> None:
    if event.startswith("/jax/core/compile/"):
        end = time.monotonic()
        # What is reported of a whole comes after its parts.
        while _compiled and _compiled[-1][0] >= end - duration_secs:
            _compiled.pop()
        _compiled.append((end - duration_secs, end))


jax.monitoring.register_event_duration_secs_listener(_note)


def compiling() -> float:
    """Seconds that this process has spent on tracing and compiling since this module was imported."""
    return sum(end - begin for begin, end in _compiled)


class Clock:
    """Seconds of a run by what they were spent on, compiling left out of each."""

    def __init__(self) -> None:
        self.training = 0.0
        """Of the intervals: rollouts and updates."""
        self.evaluation = 0.0
        """Of all evaluations that were due."""
        self.evaluations = 0
        """How many there were."""

    @contextlib.contextmanager
    def train(self) -> Iterator[None]:
        """Count what is done within as training."""
        with _stopwatch() as spent:
            yield
        self.training += spent[0]

    @contextlib.contextmanager
    def evaluate(self) -> Iterator[None]:
        """Count what is done within as an evaluation."""
        with _stopwatch() as spent:
            yield
        self.evaluation += spent[0]
        self.evaluations += 1


@contextlib.contextmanager
def _stopwatch() -> Iterator[list[float]]:
    """A list that holds, at the end, the seconds spent within on anything but compiling."""
    spent: list[float] = []
    begun, compiled = time.monotonic(), compiling()
    yield spent
    spent.append(max(0.0, time.monotonic() - begun - (compiling() - compiled)))
