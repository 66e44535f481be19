"""A run directory has one process, or one group of processes, that works in it at a time."""

import contextlib
import json
import os
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import IO

from matd3_jax.errors import UserError

try:
    import fcntl
except ImportError:  # not on every system
    fcntl = None  # type: ignore[assignment]

NAME = ".lock"


class InUse(UserError):
    """Another process holds the lock."""


@contextlib.contextmanager
def held(folder: Path) -> Iterator[None]:
    """Hold the lock of a directory for the block.

    The system lets go of it when the process ends, however that comes about: what a killed process left is taken over.
    Where the system has no such locks, the file names its owner, and is taken over when that process is gone.

    Raises InUse where another process holds it; the message says which.
    """
    with (_by_system if fcntl is not None else _by_owner)(folder / NAME):
        yield


def holder(folder: Path) -> str | None:
    """Who works in a directory, in words; None: nobody. Nothing is changed."""
    path = folder / NAME
    if path.is_symlink() or not path.is_file():
        return None
    if fcntl is None:
        written = path.read_text(errors="replace")
        return None if _gone(written) else _who(written)
    with path.open(encoding="utf-8", errors="replace") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except OSError:
            return _who(file.read())
    return None


@contextlib.contextmanager
def _by_system(path: Path) -> Iterator[None]:
    with _opened(path) as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise _taken(path, file.read()) from error
        file.seek(0)
        file.truncate()
        file.write(_owner())
        file.flush()
        yield  # the file stays: to remove it while others open it would give two owners


@contextlib.contextmanager
def _by_owner(path: Path) -> Iterator[None]:
    for _ in range(2):
        try:
            with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL), "w", encoding="utf-8") as file:
                file.write(_owner())
            break
        except FileExistsError:
            written = path.read_text(encoding="utf-8", errors="replace")
            if not _gone(written):
                raise _taken(path, written) from None
            path.unlink(missing_ok=True)
    else:
        raise _taken(path, "")
    try:
        yield
    finally:
        path.unlink(missing_ok=True)


def _opened(path: Path) -> IO[str]:
    if path.is_symlink():
        raise UserError(f"{path} is a link: nothing is written through it")
    return os.fdopen(
        os.open(path, os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0), 0o666),
        "r+",
        encoding="utf-8",
        errors="replace",
    )


def _owner() -> str:
    return json.dumps({"process": os.getpid(), "host": socket.gethostname()}) + "\n"


def _taken(path: Path, written: str) -> InUse:
    return InUse(f"{path.parent} is in use: {_who(written)} works in it; wait for its end, or stop it")


def _who(written: str) -> str:
    try:
        owner = json.loads(written)
        return f"process {int(owner['process'])} on {owner['host']}"
    except (ValueError, KeyError, TypeError):
        return "another process"


def _gone(written: str) -> bool:
    """Whether the owner that a lock file names ran on this host and does so no more."""
    try:
        owner = json.loads(written)
        if owner["host"] != socket.gethostname():
            return False
        os.kill(int(owner["process"]), 0)
    except ProcessLookupError:
        return True
    except (ValueError, KeyError, TypeError, OSError):
        return False
    return False
