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
"""Seconds until a lost interrupt is raised once more: callbacks are short."""


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
    """Raise KeyboardInterrupt once more where it came in a callback, of the garbage collector, say: Python prints it as
    ignored there and goes on."""
    before = sys.unraisablehook
    if getattr(before, "raises_interrupts", False):
        return

    def hook(found: Any) -> None:
        if not isinstance(found.exc_value, KeyboardInterrupt):
            before(found)
            return
        timer = threading.Timer(_PAUSE, _thread.interrupt_main)
        timer.daemon = True
        timer.start()

    hook.raises_interrupts = True  # type: ignore[attr-defined]
    sys.unraisablehook = hook


def _in_the_main_thread() -> bool:
    return threading.current_thread() is threading.main_thread()


def _end(number: int, frame: object) -> None:
    with contextlib.suppress(OSError):
        os.write(2, b"interrupted\n")  # print could be at work below this handler
    os._exit(EXIT_CODE)
