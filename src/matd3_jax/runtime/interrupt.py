"""Ctrl-C while a command is loaded, and where Python would lose it."""

import _thread
import contextlib
import os
import signal
import sys
import threading
from collections.abc import Iterator
from typing import Any

EXIT_CODE = 130
"""After Ctrl-C, as shells have it."""

_PAUSE = 0.05
"""Seconds until a lost signal comes once more: callbacks are short."""


@contextlib.contextmanager
def ends_at_once() -> Iterator[None]:
    """Have Ctrl-C end the process while modules are imported, when nothing is written yet.

    KeyboardInterrupt is no help there: packages turn it into errors of their own, or go on without a module.
    """
    # Only Python's own handler gives way: not one that ignores the signal, nor the handler of a program around this.
    if signal.getsignal(signal.SIGINT) is not signal.default_int_handler or not _in_the_main_thread():
        yield
        return
    signal.signal(signal.SIGINT, _end)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def is_not_lost() -> None:
    """Have a signal come once more where its handler raised in a callback, of the garbage collector, say: Python prints
    that as ignored and goes on.

    Handlers raise KeyboardInterrupt (Python's own) or SystemExit of 128 + N (`signals.Stop` at a second signal N).
    """
    before = sys.unraisablehook
    if getattr(before, "repeats_signals", False):
        return

    def hook(found: Any) -> None:
        number = _signal(found.exc_value)
        if number is None:
            before(found)
            return
        timer = threading.Timer(_PAUSE, _thread.interrupt_main, (number,))
        timer.daemon = True
        timer.start()

    hook.repeats_signals = True  # type: ignore[attr-defined]
    sys.unraisablehook = hook


def _in_the_main_thread() -> bool:
    return threading.current_thread() is threading.main_thread()


def _signal(error: object) -> int | None:
    """The signal for which a handler raised an error; None: it was raised by no handler."""
    if isinstance(error, KeyboardInterrupt):
        return signal.SIGINT
    code = error.code if isinstance(error, SystemExit) else None
    return code - 128 if isinstance(code, int) and code > 128 else None


def _end(number: int, frame: object) -> None:
    with contextlib.suppress(OSError):
        os.write(2, b"interrupted\n")  # print could be at work below this handler
    os._exit(EXIT_CODE)
