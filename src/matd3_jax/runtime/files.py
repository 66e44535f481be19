"""Write files whole or not at all: what is replaced stays as it was until its successor is on the disk."""

import contextlib
import csv
import errno
import io
import json
import math
import os
import re
import shutil
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from matd3_jax.errors import UserError

PARTIAL = re.compile(r"\..+\.\d+\.partial(\.\w+)?")
"""Names of the files that `replacing` writes, and of new directories of runs, until they get their own."""

ABANDONED = 24 * 60 * 60
"""Age in seconds from which nobody writes to a partial file any more; clocks of machines that share it may differ."""


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Give the path of a new file, with the suffix of `path`, that takes the place of `path` when the block ends well.

    It is synced, then renamed: after a kill, a power cut or a full disk there is the old file or the new one. A link at
    `path` is replaced, not followed. After an error `path` is as before, and the new file is gone.
    """
    partial = path.with_name(f".{path.stem}.{os.getpid()}.partial{path.suffix}")
    partial.unlink(missing_ok=True)
    try:
        yield partial
        sync(partial)
        os.replace(partial, path)
        sync_folder(path.parent)
    finally:
        partial.unlink(missing_ok=True)


def partial(folder: Path) -> list[Path]:
    """Files and directories in a folder that were begun under a name of `PARTIAL` and left by a kill."""
    return sorted(path for path in folder.glob(".*.partial*") if PARTIAL.fullmatch(path.name))


def remove_partial(folder: Path) -> None:
    """Delete what `partial` finds; nobody else may write there now."""
    for path in partial(folder):
        _remove(path)


def remove_abandoned(folder: Path, pattern: str) -> None:
    """Delete what `partial` finds under names of a glob pattern, where others may write, once it is a day old.

    What cannot be deleted stays.
    """
    for path in partial(folder):
        with contextlib.suppress(OSError):
            if path.match(pattern) and time.time() - path.lstat().st_mtime > ABANDONED:
                _remove(path)


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Make `text` the content of `path`, in UTF-8; a file that has it already is not touched."""
    data = text.encode()
    with contextlib.suppress(OSError):
        if not path.is_symlink() and path.read_bytes() == data:
            return
    with replacing(path) as new:
        new.write_bytes(data)


def write_json(path: Path, value: Any) -> None:
    """Write a value as JSON that every reader takes: numbers that are not finite are null."""
    write_text(path, json.dumps(_finite(value), indent=1, allow_nan=False) + "\n")


def write_csv(path: Path, rows: Iterable[Sequence[Any]], line_end: str = "\r\n") -> None:
    """Write rows, the names of the columns first, as CSV."""
    file = io.StringIO(newline="")
    csv.writer(file, lineterminator=line_end).writerows(rows)
    write_text(path, file.getvalue())


def append(path: Path, data: bytes) -> None:
    """Add `data` to the end of a file, or nothing of it where that fails.

    Raises UserError where `path` is a link: what is behind it is not the run's.
    """
    try:
        flags = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_BINARY", 0)  # of POSIX, of Windows
        file = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT | flags, 0o666)
    except OSError as error:
        if error.errno == errno.ELOOP or path.is_symlink():
            raise UserError(f"{path} is a link: nothing is written through it") from error
        raise
    try:
        size = os.fstat(file).st_size
        try:
            while data:
                data = data[os.write(file, data) :]
        except OSError:
            os.ftruncate(file, size)
            raise
    finally:
        os.close(file)


def sync_folder(folder: Path) -> None:
    """Bring the names in a folder to the disk, on systems that can."""
    with contextlib.suppress(OSError):
        sync(folder, os.O_RDONLY)


def sync(path: Path, flags: int = os.O_RDWR) -> None:
    """Bring what was written to a file to the disk."""
    handle = os.open(path, flags)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _finite(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
