"""Runs on Weights & Biases."""

import os
import secrets
from pathlib import Path
from typing import Any

from matd3_jax.tracking.backend import Known
from matd3_jax.tracking.messages import FINISHED, STOPPED, Numbers, TrackedRun

PROJECT = "matd3_jax"
"""Unless the settings or WANDB_PROJECT name another."""


class WandbBackend:
    """Each seed, or each run with all its seeds, is a run there; the seeds of a run are a group."""

    has_parents = False

    def __init__(self) -> None:
        import wandb

        self.wandb = wandb
        self.runs: dict[tuple[int, int | None], Any] = {}

    def open(self, key: tuple[int, int | None], run: TrackedRun) -> None:
        known, seed = Known(run.folder, "wandb"), key[1]
        options = run.settings["wandb"]
        project = known.text("project") or options["project"] or os.environ.get("WANDB_PROJECT") or PROJECT
        entity = known.text("entity") or options["entity"]  # None: W&B heeds WANDB_ENTITY
        name = known.run(seed) or secrets.token_hex(4)
        # Before it starts: a run that is killed right away is known, too.
        known.keep(seed, name, project=project, entity=entity)
        group = run.sweep if seed is None else run.title
        settings = self.wandb.Settings(
            silent=True,
            console="off",
            program="matd3_jax",
            x_disable_stats=bool(self.runs),  # the machine's load is the same for all
        )
        self.runs[key] = self.wandb.init(
            project=project,
            entity=entity,
            mode=options["mode"],  # None: WANDB_MODE
            id=name,
            resume="allow",
            reinit="create_new",
            name=run.title if seed is None else f"{run.title}-seed_{seed}",
            group=os.environ.get("WANDB_RUN_GROUP") or group,
            config={**run.settings, **({} if seed is None else {"seed": seed})},
            dir=os.environ.get("WANDB_DIR") or run.folder,
            settings=settings,
        )

    def describe(self) -> str:
        first = next(iter(self.runs.values()))
        if first.offline:
            return "Weights & Biases: offline; each run directory's wandb/ has files to be uploaded with: wandb sync"
        more = f" and {len(self.runs) - 1} more" if len(self.runs) > 1 else ""
        return f"Weights & Biases: {first.url}{more}" if first.url else "Weights & Biases: disabled"

    def log(self, key: tuple[int, int | None], step: int, values: Numbers) -> None:
        self.runs[key].log(values, step=step)

    def attach(self, key: tuple[int, int | None], step: int, path: Path) -> None:
        if path.suffix in (".gif", ".mp4"):
            kind: Any = path.suffix[1:]
            self.runs[key].log({"video": self.wandb.Video(str(path), format=kind)}, step=step)
        elif path.suffix == ".png":
            self.runs[key].log({path.stem: self.wandb.Image(str(path))}, step=step)

    def summarize(self, key: tuple[int, int | None], step: int, values: Numbers) -> None:
        self.runs[key].summary.update(values)

    def close(self, key: tuple[int, int | None], how: str) -> None:
        if how == STOPPED:
            self.runs[key].mark_preempting()
        self.runs[key].finish(exit_code=0 if how == FINISHED else 1)
