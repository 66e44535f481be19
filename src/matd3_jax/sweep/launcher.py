"""Batches of a sweep as jobs of a Hydra launcher: on a SLURM cluster, in local processes, one after another.

`python -m matd3_jax.sweep.launcher --multirun sweep=SWEEP_DIR batch=0,1,2 hydra/launcher=submitit_slurm` is what
`launch` runs.
"""

import dataclasses
import re
import runpy
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import hydra
from hydra.core.config_store import ConfigStore
from hydra.core.plugins import Plugins
from omegaconf import MISSING

from matd3_jax.errors import UserError, nearest


@dataclasses.dataclass
class Job:
    """One batch of a sweep."""

    sweep: str = MISSING
    batch: int = MISSING


ConfigStore.instance().store(name="matd3_jax_job", node=Job)


def check(launcher: str, options: Sequence[str]) -> None:
    """Raise UserError where no such launcher is installed, or it has no such option ("launcher.KEY=value")."""
    Plugins.instance()  # finds the plugins, which register their configurations
    known = ConfigStore.instance().list("hydra/launcher")
    if f"{launcher}.yaml" not in known:
        hint = "; pip install hydra-submitit-launcher" if launcher.startswith("submitit") else ""
        raise UserError(
            f"no launcher is called {launcher!r}; {nearest(launcher, [n.removesuffix('.yaml') for n in known])}{hint}"
        )
    keys = ConfigStore.instance().load(f"hydra/launcher/{launcher}.yaml").node
    for option in options:
        key = option.removeprefix("launcher.").split("=")[0]
        if key.split(".")[0] not in keys:
            raise UserError(f"the launcher {launcher} has no option {key!r}; {nearest(key, map(str, keys))}")


def launch(folder: Path, batches: int, launcher: str, options: Sequence[str]) -> int:
    """Train the batches of the sweep in `folder` as jobs and wait for them: the exit code.

    Args:
        options: "launcher.KEY=value", the launcher's own.
    """
    folder = folder.resolve()
    command = [sys.executable, "-m", "matd3_jax.sweep.launcher", "--multirun", f"sweep={quoted(folder)}"]
    command += [f"batch={','.join(map(str, range(batches)))}", f"hydra/launcher={launcher}"]
    command += [f"hydra.sweep.dir={quoted(folder / 'jobs')}", "hydra.sweep.subdir=${batch}"]
    command += [f"hydra.{option}" for option in options]
    return subprocess.run(command).returncode


def quoted(path: Path) -> str:
    """A path as a string in Hydra's grammar."""
    text = re.sub(r"(\\*)'", r"\1\1\'", str(path))
    text = re.sub(r"(\\+)$", r"\1\1", text)
    return "'" + re.sub(r"(\\*)\$\{", r"\1\1\${", text) + "'"


@hydra.main(version_base=None, config_path=None, config_name="matd3_jax_job")
def job(config: Job) -> int:
    """Train one batch: `python -m matd3_jax.sweep` in this process."""
    sys.argv = ["matd3_jax.sweep", f"resume={config.sweep}", f"batch={config.batch}"]
    try:
        runpy.run_module("matd3_jax.sweep", run_name="__main__", alter_sys=True)
    except SystemExit as end:
        return int(end.code or 0)
    return 0


if __name__ == "__main__":
    job()
