"""What the metrics table was when a checkpoint was written: a number that was changed since is noticed."""

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from matd3_jax.runtime import files

FILE = "metrics.json"
"""In a checkpoint: for each of its runs the bytes of the metrics table and their SHA-256."""


def write(folder: Path, tables: Sequence[Path]) -> Path:
    """Note what the tables of a checkpoint's runs are now, in the checkpoint's folder; return the file."""
    found: list[dict[str, Any]] = []
    for table in tables:
        data = table.read_bytes() if table.is_file() else b""
        found.append({"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()})
    files.write_json(folder / FILE, found)
    return folder / FILE


def is_changed(checkpoint: Path, table: Path, number: int = 0) -> bool:
    """Whether the table's beginning is not what it was when the checkpoint was written; False where that is not known,
    as in checkpoints from before it was noted.

    Args:
        number: of the run among those of the checkpoint.
    """
    try:
        noted = json.loads((checkpoint / FILE).read_text(encoding="utf-8"))[number]
        size, digest = int(noted["bytes"]), noted["sha256"]
    except (OSError, ValueError, LookupError, TypeError):
        return False
    data = table.read_bytes()[:size] if table.is_file() else b""
    return bool(hashlib.sha256(data).hexdigest() != digest)
