"""Errors that a user can put right, and what was probably meant."""

import difflib
from collections.abc import Iterable


class UserError(ValueError):
    """A setting, file or directory that will not do; its message is one line that says why and what would."""


class OptionError(UserError):
    """A name or an option that no environment takes; the message names the key, the value and what is allowed."""


class HostError(UserError):
    """What an environment that is stepped in Python, on the host, did not do; one line.

    Raised while the compiled program runs it comes out as JAX's own error, with this one's text in it.
    """


def one_line(error: BaseException) -> str:
    """An error's message without its line breaks."""
    return " ".join(str(error).split())


def described(error: BaseException) -> str:
    """An error's type and message, in one line."""
    return f"{type(error).__name__}: {one_line(error)}".rstrip()


def nearest(word: object, known: Iterable[str]) -> str:
    """The end of an error message: what was probably meant, or else everything that is known."""
    known = sorted(set(known))
    close = difflib.get_close_matches(str(word), known, n=3, cutoff=0.5)
    return f"did you mean {' or '.join(repr(name) for name in close)}?" if close else f"known: {', '.join(known)}"
