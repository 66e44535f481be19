"""Directories named on the command line: those of runs, `runs=A,B,C`, and those that a command is going to make."""

import errno
import glob
import os
from collections.abc import Sequence
from pathlib import Path

from matd3_jax import lists
from matd3_jax.errors import UserError

LONGEST_NAME = 255
"""Bytes of a file's name, on all usual file systems."""
LONGEST_PART = 100
"""Characters of one part among others of a name that we make."""


def paths(texts: Sequence[str], key: str = "runs") -> tuple[Path, ...]:
    """The run directories that the texts after `key=` name.

    A text is `A,B` or `[A,B]`; a shell makes several of `runs=runs/{a,b}`. Wildcards of shells stand for all run
    directories that match, in alphabetical order. What is between the commas is taken as it is, so that directories may
    be called 1e3 or lr=0.01; one with a comma or brackets goes in quotation marks.

    Raises UserError where a name is empty or no file can have it, a quotation mark is missing, or nothing matches.
    """
    found: list[Path] = []
    for text in texts:
        try:
            names = lists.split(text)
        except UserError as error:
            raise UserError(f"{key}: {error}") from error
        for name in names:
            if not name:
                raise UserError(f"cannot read {f'{key}={text}'!r}: write directories with commas between, {key}=A,B")
            if not _has_bytes(name):
                raise UserError(f"{key}={name!r}: no file can have this name")
            found += _matching(_from_home(name), key)
    return tuple(found)


def _from_home(name: str) -> Path:
    """A path with `~` or `~user` at its beginning; as it is where nobody has that name, as a shell leaves it."""
    try:
        return Path(name).expanduser()
    except RuntimeError:
        return Path(name)


def is_name(value: object) -> bool:
    """Whether a value from a file can be the name of a directory in another: one part of a path, that leads nowhere."""
    return isinstance(value, str) and _is_part(value) and value == Path(value).name and "\\" not in value


def as_part(text: str) -> str:
    """A text as a part of a directory's name: spaces become `-`, all but ASCII letters, digits and `.+-_` becomes `_`,
    and of a long one only the beginning is left."""
    plain = text.replace(" ", "-")
    return "".join(c if c.isascii() and (c.isalnum() or c in ".+-_") else "_" for c in plain)[:LONGEST_PART]


def inside(parent: Path, name: str, key: str) -> Path:
    """The directory `name` in another one; a name with slashes stands for directories within each other.

    Raises UserError, naming the option `key`, where it would not be inside.
    """
    found = parent / name
    if Path(name).is_absolute() or not all(map(_is_part, Path(name).parts or ("",))):
        long = any(len(os.fsencode(part)) > LONGEST_NAME for part in Path(name).parts if _has_bytes(part))
        why = f": a name has at most {LONGEST_NAME} bytes" if long else ""
        raise UserError(f"{key}={name}: must name a directory in {parent}{why}")
    return found


def _is_part(name: str) -> bool:
    """Whether a text can be one part of a path, which does not lead up."""
    return _has_bytes(name) and 0 < len(os.fsencode(name)) <= LONGEST_NAME and name not in (".", "..")


def _has_bytes(name: str) -> bool:
    """Whether the system can take a text as a file's name at all, of whatever length."""
    try:
        return "\0" not in name and os.fsencode(name) is not None
    except UnicodeEncodeError:
        return False


def check_new_directory(path: Path, key: str) -> None:
    """`check_directory`, and raise UserError where something is in it already."""
    check_directory(path, key)
    if path.is_dir() and any(path.iterdir()):
        raise UserError(f"{key}={path}: something is there already; choose another directory")


def check_directory(path: Path, key: str) -> None:
    """Raise UserError where nothing can be written into the directory `path`, which need not be there. Makes nothing.

    Args:
        key: of the option that names it, for the message.
    """
    if not _has_bytes(str(path)):
        raise UserError(f"{key}={path}: cannot make this directory: no file can have this name")
    try:
        if path.exists() and not path.is_dir():
            raise UserError(f"{key}={path}: cannot make this directory: a file has this name")
        above = next(folder for folder in (path.absolute(), *path.absolute().parents) if folder.exists())
        longest = os.pathconf(above, "PC_NAME_MAX") if hasattr(os, "pathconf") else 255
        if any(len(os.fsencode(name)) > longest for name in path.absolute().relative_to(above).parts):
            raise OSError(errno.ENAMETOOLONG, os.strerror(errno.ENAMETOOLONG))
    except OSError as error:
        raise UserError(f"{key}={path}: cannot make this directory: {error.strerror}") from error
    if not above.is_dir():
        raise UserError(f"{key}={path}: cannot make this directory: {above} is a file")
    if not os.access(above, os.W_OK | os.X_OK):
        raise UserError(f"{key}={path}: cannot make this directory: {above} is not writable")


def _matching(path: Path, key: str) -> list[Path]:
    if path.exists() or not glob.has_magic(str(path)):
        return [path]
    matches = sorted(Path(name) for name in glob.glob(str(path)))
    runs = [match for match in matches if (match / "config.yaml").is_file()]
    if not runs:
        raise UserError(f"{key}={path}: no run directory matches")
    return runs
