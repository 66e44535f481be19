"""Make a process fail, or die, at the n-th of the calls with which it changes files in a folder."""

import builtins
import contextlib
import errno
import io
import os
import re
import resource
import signal
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

ERRORS = {"ENOSPC": errno.ENOSPC, "EIO": errno.EIO}
"""A full disk stays full until the process ends; an error of a device comes once."""

SIGNALS = tuple(f"{name}{more}" for name in ("SIGINT", "SIGTERM", "SIGHUP") for more in ("", " twice"))
"""What asks a process to stop; twice: at once."""

INJECTED = ("short", *ERRORS, *SIGNALS)
"""What a process survives."""

WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT


class Faults:
    """Counts what a process does to files below `folder`, and brings about one fault.

    Args:
        log: gets a line "CALL PATH" before each call, so that it is known where a process died.
        how: "kill" (before the call), "kill after", "half" (half of what is written, then killed), "power" (killed, and
            of every file is left what was synced), "short" (half of it, as a system may write), one of `ERRORS` or
            `SIGNALS`; "": nothing.
        at: number of the call, from 0, among those that `where` matches, a pattern for "CALL PATH".
    """

    def __init__(self, folder: Path, log: Path, how: str = "", at: int = -1, where: str = ""):
        self.where, self.counting = re.compile(where), threading.Lock()  # Orbax writes in several threads
        self.folder, self.how, self.at, self.count = f"{folder.resolve()}{os.sep}", how, at, 0
        self.log = os.open(log, os.O_WRONLY | os.O_APPEND | os.O_CREAT)
        self.original = {name: getattr(os, name) for name in (*BY_PATH, "open", "write", "fsync")}
        self.open = io.open
        self.synced = {file.stat().st_ino: file.stat().st_size for file in self._files()}
        """How much of each file, by its inode, is on the disk."""

    def _inside(self, path: Any, folder: Any = None) -> str | None:
        """The part of a path (or of what a descriptor stands for) below the folder; None: it is elsewhere."""
        if isinstance(path, int):
            try:
                path = os.readlink(f"/proc/self/fd/{path}")
            except OSError:
                return None
        elif isinstance(folder, int):
            path = os.path.join(os.readlink(f"/proc/self/fd/{folder}"), os.fsdecode(path))
        full = os.path.abspath(os.fsdecode(path))
        return full.removeprefix(self.folder) if full.startswith(self.folder) else None

    def _begin(self, call: str, path: str) -> str:
        """Note a call: the fault that is due now."""
        due = ""
        with self.counting:
            if self.where.search(f"{call} {path}"):
                due = self.how if self.count == self.at or (self.how == "ENOSPC" and 0 <= self.at < self.count) else ""
                self.count += 1
            self.original["write"](self.log, f"{call} {path}\n".encode())
        if due == "power":
            self._lose_what_is_not_synced()
        if due in ("kill", "power") or (due == "half" and call != "write"):
            os.kill(os.getpid(), signal.SIGKILL)
        if due in SIGNALS:
            name, _, more = due.partition(" ")
            for _ in range(2 if more else 1):
                os.kill(os.getpid(), getattr(signal, name))
        if due in ERRORS and call in ("open", "write", "mkdir", "fsync", "replace", "rename"):
            if due == "EIO" or call in ("open", "write", "mkdir"):
                raise OSError(ERRORS[due], os.strerror(ERRORS[due]), path)
        return due

    def _files(self) -> list[Path]:
        folder = Path(self.folder)
        return [file for file in folder.rglob("*") if file.is_file() and not file.is_symlink()]

    def _lose_what_is_not_synced(self) -> None:
        for file in self._files():
            found = file.stat()
            if found.st_size > self.synced.get(found.st_ino, 0):
                self.original["truncate"](file, self.synced.get(found.st_ino, 0))

    def sync(self, file: int) -> None:
        self.call("fsync", 0, file)
        found = os.fstat(file)
        self.synced[found.st_ino] = found.st_size

    def _end(self, due: str) -> None:
        if due in ("kill after", "half"):
            os.kill(os.getpid(), signal.SIGKILL)

    def call(self, name: str, where: int, *args: Any, **given: Any) -> Any:
        folder = given.get("dir_fd", given.get("dst_dir_fd"))
        path = self._inside(args[where], folder)
        due = "" if path is None else self._begin(name, path)
        if name == "unlink" and path is not None:
            try:
                self.synced.pop(os.lstat(self.folder + path).st_ino, None)  # another file may get this inode
            except OSError:
                pass
        found = self.original[name](*args, **given)
        self._end(due)
        return found

    def write(self, file: int, data: Any) -> int:
        path = self._inside(file)
        due = "" if path is None else self._begin("write", path)
        if due in ("half", "short") and len(data) > 1:
            data = data[: len(data) // 2]
        found = self.original["write"](file, data)
        self._end(due)
        return found

    def os_open(self, path: Any, flags: int, *args: Any, **given: Any) -> int:
        inside = self._inside(path, given.get("dir_fd")) if flags & WRITES else None
        due = "" if inside is None else self._begin("open", inside)
        found = self.original["open"](path, flags, *args, **given)
        self._end(due)
        return found

    def io_open(self, file: Any, mode: str = "r", *args: Any, **given: Any) -> Any:
        inside = self._inside(file) if {*mode} & {*"wax+"} and not isinstance(file, int) else None
        if inside is None:
            return self.open(file, mode, *args, **given)
        due = self._begin("open", inside)
        opened = self.open(file, mode, *args, **given)
        self._end(due)
        return _Written(opened, self, inside)


class _Written:
    """A file whose writes are counted."""

    def __init__(self, file: Any, faults: Faults, path: str):
        self._file, self._faults, self._path = file, faults, path

    def write(self, data: Any) -> int:
        due = self._faults._begin("write", self._path)
        if due == "half":
            data = data[: len(data) // 2]
        found = self._file.write(data)
        if due in ("half", "kill after"):
            self._file.flush()
        self._faults._end(due)
        return found

    def __enter__(self) -> "_Written":
        self._file.__enter__()
        return self

    def __exit__(self, *error: Any) -> Any:
        return self._file.__exit__(*error)

    def __iter__(self) -> Iterator:
        return iter(self._file)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)


BY_PATH = {"replace": 1, "rename": 1, "mkdir": 0, "unlink": 0, "rmdir": 0, "truncate": 0, "ftruncate": 0}
"""Calls that change names or sizes, and which of their arguments is the path."""


@contextlib.contextmanager
def armed(faults: Faults, largest: int | None = None) -> Iterator[None]:
    """Have a fault in the block. largest: no file may grow beyond so many bytes, whoever writes it (C++, too)."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    if largest is not None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (largest, before[1]))
    for name, where in BY_PATH.items():
        setattr(os, name, lambda *args, name=name, where=where, **given: faults.call(name, where, *args, **given))
    os.fsync = faults.sync
    os.write, os.open = faults.write, faults.os_open
    io.open = builtins.open = faults.io_open  # type: ignore[assignment]
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        for name, function in faults.original.items():
            setattr(os, name, function)
        io.open = builtins.open = faults.open
        os.close(faults.log)
