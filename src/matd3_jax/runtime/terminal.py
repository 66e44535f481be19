"""What a program tells its user: never a reason to end."""

import contextlib
import os
import sys


def say(text: str) -> None:
    """Print a line at once; where nobody reads any more, or the terminal lacks the letters, go on without."""
    try:
        print(text, flush=True)
    except UnicodeEncodeError:
        encoding = sys.stdout.encoding or "ascii"
        with contextlib.suppress(OSError, ValueError):
            print(text.encode(encoding, "backslashreplace").decode(encoding), flush=True)
    except BrokenPipeError:
        # Python would try to flush once more at the end, fail, and change the exit code.
        with contextlib.suppress(OSError, ValueError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except (OSError, ValueError):  # a full disk behind the output, a closed one
        pass
