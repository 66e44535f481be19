"""SIGINT and SIGTERM as a wish to stop soon."""

import signal
import sys

from matd3_jax.runtime.multihost import Processes


class Stop:
    """SIGINT and SIGTERM end the run after the interval at work; a second one ends it at once."""

    def __init__(self) -> None:
        self.signal: signal.Signals | None = None
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._remember)

    def agreed(self, processes: Processes) -> signal.Signals | None:
        """The signal that has come to any of the processes, if any has; all get the same answer."""
        number = processes.agree(int(self.signal or 0))
        return signal.Signals(number) if number else None

    def _remember(self, number: int, frame: object) -> None:
        if self.signal is not None:
            sys.exit(128 + number)
        self.signal = signal.Signals(number)
        print(f"\n{self.signal.name}: writing a checkpoint after this interval (again: stop at once)", flush=True)
