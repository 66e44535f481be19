"""Output to the user: never a reason to end."""

import contextlib
import io
import os
import shutil
import sys
from typing import Any, TextIO

LONGEST = 2000
"""Of an error line, characters."""


def say(text: str, end: str = "\n") -> None:
    """Print a line at once; where nobody reads any more, or the terminal lacks the letters, go on without."""
    _write(sys.stdout, text + end)


def note(text: str) -> None:
    """`say` from a thread: takes none of the locks of standard output, on which Python would fail where the main thread
    ends while nobody reads."""
    with contextlib.suppress(OSError, ValueError, AttributeError):
        os.write(sys.stdout.fileno(), (text + "\n").encode(sys.stdout.encoding or "ascii", "backslashreplace"))


def show(renderable: Any, width: int | None = None) -> None:
    """Print a table of rich; of `width` characters where standard output is no terminal."""
    from rich.console import Console

    terminal = sys.stdout is not None and not sys.stdout.closed and sys.stdout.isatty()
    size = shutil.get_terminal_size().columns if terminal else width
    console = Console(file=_Page(), force_terminal=terminal, width=size)
    console.print(renderable)
    say(console.file.getvalue(), end="")  # type: ignore[attr-defined]


class _Page(io.StringIO):
    """What is going to be printed, in the letters that standard output has: rich draws its lines by them."""

    @property
    def encoding(self) -> str:  # type: ignore[override]
        return getattr(sys.stdout, "encoding", None) or "ascii"


def complain(text: str) -> None:
    """Print a text on standard error as one line: what would break it, or move the cursor, is escaped."""
    line = "".join(letter if letter.isprintable() else repr(letter)[1:-1] for letter in text)
    if len(line) > LONGEST:
        line = f"{line[: LONGEST // 2]} ... {line[-LONGEST // 2 :]}"
    _write(sys.stderr, line + "\n")


def leave(at_once: bool = False) -> None:
    """Give up what could not be printed: Python would try once more at the end, fail, and change the exit code.

    at_once: wait for no reader of what is still to be printed.
    """
    for stream in (sys.stdout, sys.stderr):
        if stream is None:
            continue
        try:
            if at_once:
                _give_up(stream)
            stream.flush()
        except (OSError, ValueError):
            _give_up(stream)


def _give_up(stream: TextIO) -> None:
    with contextlib.suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def _write(stream: TextIO | None, text: str) -> None:
    if stream is None:  # a process without a standard output
        return
    try:
        stream.write(text)
        stream.flush()
    except UnicodeEncodeError:
        encoding = stream.encoding or "ascii"
        with contextlib.suppress(OSError, ValueError):
            stream.write(text.encode(encoding, "backslashreplace").decode(encoding))
            stream.flush()
    except BrokenPipeError:
        _give_up(stream)
    except (OSError, ValueError):  # a full disk behind the output, a closed one
        pass
