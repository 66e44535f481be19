"""A fresh Python process for each measurement, so that one's memory, caches and devices do not show in another's."""

import json
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from typing import Any

from matd3_jax.errors import UserError


def run(module: str, arguments: Sequence[str], environment: Mapping[str, str] | None = None) -> dict[str, Any]:
    """What `python -m module *arguments` prints as its last line, read as JSON.

    Args:
        environment: variables to set in addition to those of this process.

    Raises UserError with the process's own error line where it ends with exit code 2 (a setting that cannot be), or
    where it was killed, as a machine without memory left does; RuntimeError with the end of what it wrote otherwise.
    """
    done = subprocess.run(
        [sys.executable, "-m", module, *arguments],
        env={**os.environ, **(environment or {})},
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode == 2 and "error: " in done.stderr:
        raise UserError(done.stderr.rsplit("error: ", 1)[1].strip())
    if done.returncode < 0:
        raise UserError(f"{module} {' '.join(arguments)}: killed by signal {-done.returncode}")
    if done.returncode:
        raise RuntimeError(f"{module} {' '.join(arguments)} ended with {done.returncode}:\n{done.stderr[-2000:]}")
    return json.loads(done.stdout.strip().splitlines()[-1])
