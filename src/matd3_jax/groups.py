"""The files of settings: where they are, and the names among which `env=`, `algo=`, `adversary=`, `recipe=` choose."""

from pathlib import Path

FOLDER = Path(__file__).parent / "config"

GROUPS = {"env": "environment", "algo": "algorithm", "adversary": "algorithm", "recipe": "recipe"}
"""Keys that choose a file, and what the file describes; `adversary` takes the files of `algo`."""


def known_names(group: str) -> tuple[str, ...]:
    """The names of the files that a group offers."""
    folder = FOLDER / ("algo" if group == "adversary" else group)
    return tuple(sorted(path.stem for path in folder.glob("*.yaml") if not path.stem.startswith("_")))
