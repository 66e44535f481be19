"""SIGINT, SIGTERM and SIGHUP as a wish to stop soon."""

import signal
import sys
import threading

from matd3_jax.runtime.multihost import Processes
from matd3_jax.runtime.terminal import note

NAMES = ("SIGINT", "SIGTERM", "SIGHUP")


class Stop:
    """The signals end the run after the interval at work; a second one ends it at once.

    Under nohup, which has a program ignore SIGHUP, it stays ignored. SIGINT, which shells have what they start in the
    background ignore, is heeded there, too.
    """

    def __init__(self) -> None:
        self.signal: signal.Signals | None = None
        self._came = threading.Event()
        # A handler runs between any two operations, in the middle of a print, too: it only notes what came.
        threading.Thread(target=self._tell, daemon=True).start()
        for name in NAMES:
            number = getattr(signal, name, None)
            if number is not None and not (name == "SIGHUP" and signal.getsignal(number) is signal.SIG_IGN):
                signal.signal(number, self._remember)

    def agreed(self, processes: Processes) -> signal.Signals | None:
        """The signal that has come to any of the processes, if any has; all get the same answer."""
        number = processes.agree(int(self.signal or 0))
        return signal.Signals(number) if number else None

    def _remember(self, number: int, frame: object) -> None:
        if self.signal is not None:
            sys.exit(128 + number)
        self.signal = signal.Signals(number)
        self._came.set()

    def _tell(self) -> None:
        self._came.wait()
        assert self.signal is not None
        note(f"\n{self.signal.name}: writing a checkpoint after this interval (again: stop at once)")
