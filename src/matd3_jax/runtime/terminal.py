"""What a program tells its user: never a reason to end."""

import contextlib
import os
import sys
from typing import Any, TextIO

LONGEST = 2000
"""Of an error line, characters."""


def say(text: str, end: str = "\n") -> None:
    """Print a line at once; where nobody reads any more, or the terminal lacks the letters, go on without."""
    _write(sys.stdout, text + end)


def show(renderable: Any, width: int | None = None) -> None:
    """Print a table of rich; of `width` characters where standard output is no terminal."""
    from rich.console import Console

    console = Console()
    if width is not None and not console.is_terminal:
        console = Console(width=width)
    with console.capture() as captured:
        console.print(renderable)
    say(captured.get(), end="")


def complain(text: str) -> None:
    """Print a text on standard error as one line: what would break it, or move the cursor, is escaped."""
    line = "".join(letter if letter.isprintable() else repr(letter)[1:-1] for letter in text)
    if len(line) > LONGEST:
        line = f"{line[: LONGEST // 2]} ... {line[-LONGEST // 2 :]}"
    _write(sys.stderr, line + "\n")


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
        # Python would try to flush once more at the end, fail, and change the exit code.
        with contextlib.suppress(OSError, ValueError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
    except (OSError, ValueError):  # a full disk behind the output, a closed one
        pass
