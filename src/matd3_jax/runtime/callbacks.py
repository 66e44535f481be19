"""What is raised in callbacks, where Python can do no more than print it."""

import signal
import sys
import threading
from typing import Any

_PAUSE = 0.05
"""Seconds until a lost signal comes once more: callbacks are short."""


def handle_errors() -> None:
    """Leave out of what Python prints the errors that say nothing, and have signals come once more that were lost.

    - Where writing a checkpoint fails, Orbax ends its event loop before all writes of tensorstore have, whose ends are
      then errors of their own; the one that counts is raised.
    - A signal's handler may raise while a callback runs, of the garbage collector, say: KeyboardInterrupt (Python's
      own), or SystemExit of 128 + N (`signals.Stop` at a second signal N).
    """
    before = sys.unraisablehook
    if getattr(before, "handles_errors", False):
        return

    def hook(found: Any) -> None:
        error = found.exc_value
        if isinstance(error, RuntimeError) and str(error) == "Event loop is closed":
            return
        number = _signal(error)
        if number is None:
            before(found)
            return
        timer = threading.Timer(_PAUSE, _again, (number,))
        timer.daemon = True
        timer.start()

    hook.handles_errors = True  # type: ignore[attr-defined]
    sys.unraisablehook = hook


def _again(number: int) -> None:
    """Send the main thread a signal, which wakes it where the system can."""
    main = threading.main_thread().ident
    if main is not None and hasattr(signal, "pthread_kill"):
        signal.pthread_kill(main, number)
    else:
        signal.raise_signal(number)


def _signal(error: object) -> int | None:
    """The signal for which a handler raised an error; None: it was raised by no handler."""
    if isinstance(error, KeyboardInterrupt):
        return signal.SIGINT
    code = error.code if isinstance(error, SystemExit) else None
    return code - 128 if isinstance(code, int) and code - 128 in signal.valid_signals() else None
