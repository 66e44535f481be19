"""Runs that differ in nothing but their seeds belong together: one curve, one row of a table."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from matd3_jax.config import Config, diff
from matd3_jax.runs.directory import RunDirectory


def groups(paths: Sequence[Path]) -> dict[tuple[Path, ...], Config]:
    """Runs that differ only in their seeds, in how long they are and in what they write: (paths of a group: settings of
    its first run).

    Raises UserError where there is no run.
    """
    found: list[tuple[dict[str, Any], list[Path], Config]] = []
    for path in paths:
        settings = RunDirectory.open(path)[1]
        own = diff.learning(settings)
        members = next((members for other, members, _ in found if other == own), None)
        if members is None:
            found.append((own, [path], settings))
        else:
            members.append(path)
    return {tuple(members): settings for _, members, settings in found}


def common(settings: Sequence[Config]) -> str:
    """Environment and algorithms, where they are the same in all runs of several."""
    environments = list(dict.fromkeys(diff.environment(one) for one in settings))
    names = list(dict.fromkeys(map(diff.algorithms, settings)))
    parts = environments if len(environments) == 1 else []
    return ", ".join([*parts, *(names if len(names) == 1 < len(settings) else [])])
