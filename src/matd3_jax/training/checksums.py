"""Checksums of a checkpoint's files: written with it, compared before it is read back."""

import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path

from matd3_jax.runtime import files

FILE = "checksums.json"
"""In a checkpoint: the SHA-256 of every file by its name from there on."""


def of(path: Path, places: Sequence[Path]) -> dict[str, str]:
    """Digests of files, and of all files in folders, by their names from `path` on."""
    found = (file for place in places for file in (place, *place.rglob("*")) if file.is_file())
    return {str(file.relative_to(path)): _digest(file, sync=True) for file in found}


def write(path: Path, parts: Sequence[Mapping[str, str]]) -> None:
    """Note the digests that the processes found of the checkpoint at `path`."""
    files.write_json(path / FILE, dict(sorted(pair for part in parts for pair in part.items())))


def damage(path: Path) -> str | None:
    """What is damaged or missing of the checkpoint at `path`; None where it is whole."""
    try:
        wanted = json.loads((path / FILE).read_text(encoding="utf-8"))
        return next((name for name, digest in wanted.items() if _digest(path / name) != digest), None)
    except FileNotFoundError as error:
        return f"{Path(str(error.filename)).relative_to(path)} is missing"
    except (OSError, ValueError, AttributeError):
        return FILE


def _digest(path: Path, sync: bool = False) -> str:
    """sync: bring the file to the disk, too, before anything is renamed."""
    with path.open("rb") as file:
        if sync:
            os.fsync(file.fileno())
        return hashlib.file_digest(file, "sha256").hexdigest()
