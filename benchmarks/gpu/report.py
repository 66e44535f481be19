"""What was measured, kept in one file from case to case: a run that is cut off loses only the case it was in."""

import gc
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from benchmarks.commit import commit
from matd3_jax.errors import UserError
from matd3_jax.runtime import devices, files
from matd3_jax.runtime.terminal import say

Row = dict[str, Any]


class Report:
    """The file report.json in `out`: facts of the machine, and for each part its cases by name.

    Args:
        out: made if it is not there. What an earlier run left there is kept, and measured cases are not measured again.
        minutes: after which no case is started.

    Raises UserError where `out` holds numbers of other devices.
    """

    def __init__(self, out: Path, minutes: float):
        out.mkdir(parents=True, exist_ok=True)
        self.out, self.file = out, out / "report.json"
        self.end = time.monotonic() + 60 * minutes
        facts = {"machine": devices.description(), "versions": devices.versions(), "commit": commit()}
        before = json.loads(self.file.read_text(encoding="utf-8")) if self.file.exists() else {}
        self.facts: Row = facts
        self.parts: dict[str, dict[str, Row]] = before.get("parts", {})
        devices_before = before.get("machine", self.facts["machine"])["devices"]
        if devices_before != self.facts["machine"]["devices"]:
            raise UserError(f"out={out}: holds numbers of {', '.join(devices_before)}; take another directory")
        self.left: list[str] = []
        """Cases for which no time was left."""
        self.wrong: list[str] = []
        """What the checks found."""

    def case(self, part: str, name: str, measure: Callable[[], Row]) -> Row | None:
        """What `measure` gives, measured now unless it has been; None where it failed or no time was left.

        One that fails (memory, an option that this version does not know) is noted and must not stop the others.
        """
        found = self.parts.get(part, {}).get(name)
        if found is not None and "failed" not in found:
            return found
        if time.monotonic() > self.end:
            self.left.append(f"{part}: {name}")
            return None
        begun = time.monotonic()
        try:
            row = measure()
        except Exception as error:
            row = {"failed": f"{type(error).__name__}: {' '.join(str(error).split())[:500]}"}
            gc.collect()  # the error's frames held arrays
        row |= {"took_seconds": round(time.monotonic() - begun, 1), "commit": self.facts["commit"]}
        self.parts.setdefault(part, {})[name] = row
        self.save()
        say(f"{part}: {name}: {shown(row)}")
        return None if "failed" in row else row

    def get(self, part: str, name: str) -> Row | None:
        """A measured case."""
        found = self.parts.get(part, {}).get(name)
        return None if found is None or "failed" in found else found

    def rows(self, part: str) -> dict[str, Row]:
        """The measured cases of a part by name."""
        return {name: row for name, row in self.parts.get(part, {}).items() if "failed" not in row}

    def save(self) -> None:
        files.write_json(self.file, {**self.facts, "parts": self.parts})


def shown(row: Row) -> str:
    """A row on one line; lists and what is the same for all are left to the file."""
    shown = {key: value for key, value in row.items() if not isinstance(value, list | dict) and key != "commit"}
    return ", ".join(f"{key} {number(value)}" for key, value in shown.items())


def number(value: Any) -> str:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return str(value)
    return f"{value:,.0f}" if abs(value) >= 100 or value == round(value) else f"{value:.3g}"
