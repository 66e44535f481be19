"""Options that most benchmarks have, and their report."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from matd3_jax.cli.options import option, others
from matd3_jax.runtime import files


@dataclasses.dataclass(frozen=True)
class Reported:
    """A benchmark that can leave its numbers in a file."""

    out: Path | None = option("the report, as JSON", default=None, metavar="FILE.json", new_file=True)

    def write(self, report: Mapping[str, Any]) -> None:
        """Write the report, if a file is wanted; of its "settings" not where it goes."""
        if self.out is not None:
            settings = [text for text in report.get("settings", ()) if not text.startswith("out=")]
            files.write_json(self.out, {**report, **({"settings": settings} if "settings" in report else {})})


@dataclasses.dataclass(frozen=True)
class OfARun(Reported):
    """A benchmark that takes settings of a run."""

    overrides: tuple[str, ...] = others("any other setting of the run, as matd3_jax.train takes it")
