"""What a tracker must do for us, and the names under which it knows a run again."""

import json
from pathlib import Path
from typing import Any, Protocol

from matd3_jax.runtime import files
from matd3_jax.tracking.messages import Numbers, TrackedRun


class Backend(Protocol):
    """A tracker; its runs are those of our runs and seeds, (number of the run, seed), or (number of the run, None) for
    all seeds of a run together."""

    has_parents: bool
    """Whether a run that is tracked seed by seed has a run of its own, too."""

    def open(self, key: tuple[int, int | None], run: TrackedRun) -> None:
        """Start a run, or continue the one that the run directory knows."""

    def describe(self) -> str:
        """Say in a line where the runs are to be seen."""

    def log(self, key: tuple[int, int | None], step: int, values: Numbers) -> None:
        """Take numbers of an env step."""

    def attach(self, key: tuple[int, int | None], step: int, path: Path) -> None:
        """Take a picture, a film or another file."""

    def summarize(self, key: tuple[int, int | None], step: int, values: Numbers) -> None:
        """Take what is said of the whole run."""

    def close(self, key: tuple[int, int | None], how: str) -> None:
        """End a run: `FINISHED`, `STOPPED` or `FAILED`."""


class Known:
    """The file in a run directory that says what a tracker calls the run, so that a resume continues it."""

    def __init__(self, folder: str, tracker: str):
        self.path = Path(folder) / f"{tracker}.json"
        try:
            found = json.loads(self.path.read_text(encoding="utf-8"))
        except (OSError, ValueError, RecursionError):
            found = {}
        self.found: dict[str, Any] = found if isinstance(found, dict) else {}

    def text(self, key: str) -> str | None:
        """A text that was kept; None where there is none."""
        value = self.found.get(key)
        return value if isinstance(value, str) else None

    def run(self, seed: int | None) -> str | None:
        """What the tracker calls a seed's run, or that of all seeds."""
        runs = self.found.get("runs")
        value = runs.get(_key(seed)) if isinstance(runs, dict) else None
        return value if isinstance(value, str) and value.isalnum() else None

    def keep(self, seed: int | None, name: str, **texts: str | None) -> None:
        """Write a run's name, and texts that hold for all of them, into the file."""
        runs = self.found.get("runs")
        runs = {**(runs if isinstance(runs, dict) else {}), _key(seed): name}
        self.found = {**self.found, **{key: value for key, value in texts.items() if value}, "runs": runs}
        files.write_json(self.path, self.found)


def _key(seed: int | None) -> str:
    return "all" if seed is None else f"seed_{seed}"
