"""Run directories named on the command line: `runs=A,B,C`."""

import glob
from collections.abc import Sequence
from pathlib import Path

from matd3_jax.errors import UserError


def paths(arguments: Sequence[str], key: str = "runs") -> tuple[list[Path], list[str]]:
    """Split off the run directories that `key` names: (the directories, the other arguments).

    Takes `runs=A,B`, `runs=[A,B]`, several `runs=` (a shell makes them of `runs=runs/{a,b}`), and the wildcards of
    shells, which stand for all run directories that match, in alphabetical order. What is between the commas is taken
    as it is, so that directories may be called 1e3 or lr=0.01.

    Raises UserError where a name is empty, and where nothing matches.
    """
    found, rest = [], []
    for text in arguments:
        if not text.startswith(f"{key}="):
            rest.append(text)
            continue
        value = text.split("=", 1)[1].strip()
        if value.startswith("[") and value.endswith("]"):
            value = value[1:-1]
        for name in (part.strip().strip("'\"") for part in value.split(",")):
            if not name:
                raise UserError(f"cannot read {text!r}: write directories with commas between them, {key}=A,B")
            found += _matching(Path(name).expanduser(), key)
    return found, rest


def _matching(path: Path, key: str) -> list[Path]:
    if path.exists() or not glob.has_magic(str(path)):
        return [path]
    matches = sorted(Path(name) for name in glob.glob(str(path)))
    runs = [match for match in matches if (match / "config.yaml").is_file()]
    if not runs:
        raise UserError(f"{key}={path}: no run directory matches")
    return runs
