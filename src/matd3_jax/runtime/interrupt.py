"""Ctrl-C while a command is loaded."""

import contextlib
import os
import signal
import threading
from collections.abc import Iterator

EXIT_CODE = 130
"""After Ctrl-C, as shells have it."""


@contextlib.contextmanager
def ends_at_once() -> Iterator[None]:
    """Have Ctrl-C end the process while modules are imported, when nothing is written yet.

    KeyboardInterrupt could be lost there: a package may catch it, or turn it into an error of its own.
    """
    # Only Python's own handler gives way: not one that ignores the signal, nor the handler of a program around this.
    here = threading.current_thread() is threading.main_thread()  # no other may set handlers
    if not here or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield
        return
    signal.signal(signal.SIGINT, _end)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def _end(number: int, frame: object) -> None:
    with contextlib.suppress(OSError):
        os.write(2, b"interrupted\n")  # print could be at work below this handler
    os._exit(EXIT_CODE)
