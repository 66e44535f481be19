"""SIGINT and SIGTERM as a wish to stop soon."""

import signal
import sys


class Stop:
    """SIGINT and SIGTERM end the run after the chunk at work; a second one ends it at once."""

    def __init__(self) -> None:
        self.signal: signal.Signals | None = None
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._remember)

    def _remember(self, number: int, frame: object) -> None:
        if self.signal is not None:
            sys.exit(128 + number)
        self.signal = signal.Signals(number)
        print(f"\n{self.signal.name}: writing a checkpoint after this chunk (again: stop at once)", flush=True)
