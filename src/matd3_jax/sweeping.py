"""Train many settings: runs that can share a program side by side in it, piece after piece.

A folder holds `runs/NAME/`, an ordinary run directory for each run, `pieces.json` (which runs are trained together)
and, while a piece is at work, `pieces/K/` with its checkpoints. Each piece can be trained by a process of its own.
"""

import contextlib
import fcntl
import json
import shutil
import time
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from matd3_jax import checkpoint, devices, outcome, overestimation, plan, plotting
from matd3_jax.config import Config
from matd3_jax.errors import UserError
from matd3_jax.memory import fitting_seeds, needed
from matd3_jax.progress import ProgressBar
from matd3_jax.runs import RunDirectory
from matd3_jax.stopping import Stop
from matd3_jax.trainer import TrainState
from matd3_jax.training import Row, Training


class Sweep:
    """The runs of a folder and their pieces."""

    def __init__(self, folder: Path):
        self.folder = folder
        self.runs = folder / "runs"
        self._plan = folder / "pieces.json"

    @property
    def pieces(self) -> list[list[str]]:
        """Names of the runs in each piece."""
        return json.loads(self._plan.read_text()) if self._plan.exists() else []

    def add(self, settings: Mapping[str, Config], budget: int | None = None) -> dict[str, list[Path]]:
        """Plan what is missing of `settings` (by name): the directories of each setting's runs, those already there
        among them.

        Args:
            budget: bytes that a piece may take; None: what is free now.

        Raises UserError where a setting is impossible, or one seed of it does not fit.
        """
        budget = devices.free_memory() if budget is None else budget
        existing = plan.existing_runs(self.runs)
        new = plan.pieces(settings, existing, self.runs, lambda config: fitting_seeds(config, budget))
        machine = {"versions": devices.versions(), **devices.description()}
        for config in (config for piece in new for config in piece):
            RunDirectory.create(self.runs / str(config.name), config, machine)
        if new:
            whole = [*self.pieces, *([str(config.name) for config in piece] for piece in new)]
            partial = self._plan.with_suffix(".partial")
            partial.write_text(json.dumps(whole, indent=1) + "\n")
            partial.replace(self._plan)
        existing = plan.existing_runs(self.runs)
        return {name: [self.runs / run for run in plan.missing(c, existing)[0]] for name, c in settings.items()}

    def finished(self, piece: int) -> bool:
        """Whether all runs of a piece are."""
        return all((self.runs / name / "summary.json").exists() for name in self.pieces[piece])

    def train(self, only: Collection[int] | None = None) -> int:
        """Train the unfinished pieces, or those of `only`: the exit code, 0 or 128 + the signal that ended it.

        Pieces at which another process works are passed over.
        """
        stop = Stop()
        todo = [k for k in range(len(self.pieces)) if not self.finished(k) and (only is None or k in only)]
        for k in todo:
            with self._taken(k) as mine:
                if not mine:
                    print(f"piece {k}: another process is at it, passed over", flush=True)
                elif not self.finished(k):
                    Piece(self, k).train(stop)
            if stop.signal is not None:
                return 128 + stop.signal
        return 0

    @contextlib.contextmanager
    def _taken(self, piece: int) -> Iterator[bool]:
        """Whether this process has the piece to itself now."""
        place = self.folder / "pieces" / str(piece)
        place.mkdir(parents=True, exist_ok=True)
        with (place / "lock").open("w") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                yield False
                return
            yield True
        if self.finished(piece):
            shutil.rmtree(place, ignore_errors=True)


class Piece:
    """Runs side by side in one program."""

    def __init__(self, sweep: Sweep, number: int):
        self.sweep, self.number = sweep, number
        opened = [RunDirectory.open(sweep.runs / name) for name in sweep.pieces[number]]
        self.runs = [run for run, _ in opened]
        self.members = [config for _, config in opened]
        self.training = Training(self.members[0], members=self.members)
        self.checkpoints = sweep.folder / "pieces" / str(number) / "checkpoints"
        ends = np.cumsum([config.seeds for config in self.members])
        self.seeds = [slice(end - config.seeds, end) for end, config in zip(ends.tolist(), self.members, strict=True)]
        """Where each run's seeds are."""

    def train(self, stop: Stop) -> None:
        """From the last checkpoint, or from the start, to the end or until a signal comes."""
        training, settings, begun = self.training, self.members[0], time.monotonic()
        training.check_memory()
        self._announce()
        state, row = self._begin()
        step = saved = int(row["step"][0])
        every = training.total_steps / 5 if settings.checkpoint_every is None else settings.checkpoint_every
        progress = ProgressBar(training.total_steps, len(training.seeds), row)
        try:
            while step < training.total_steps and stop.signal is None:
                state, row = training.advance(state)
                step = int(row["step"][0])
                self._append(row)
                progress.show(row)
                if every and step - saved >= every and step < training.total_steps:
                    checkpoint.save(self.checkpoints, step, training.trainer, state, keep=1)
                    saved = step
        finally:
            progress.stop()
        if step < training.total_steps:
            checkpoint.save(self.checkpoints, step, training.trainer, state, keep=1)
            return
        self._finish(state, row, {"seconds": round(time.monotonic() - begun, 1), **progress.rates()})

    def _begin(self) -> tuple[TrainState, Row]:
        if not checkpoint.steps(self.checkpoints):
            for run in self.runs:
                run.clear()
            state, row = self.training.start()
            self._append(row)
            return state, row
        saved = checkpoint.verify(self.checkpoints)
        state, done = checkpoint.restore(saved, self.training.trainer), int(saved.name)
        for run in self.runs:
            run.cut(done)
        print(f"going on from the checkpoint of env step {done:,}", flush=True)
        updates = self.training.trainer.updates(int(state.collects))
        return state, {"step": np.array([done]), "updates": np.array([updates])}

    def _append(self, row: Row) -> None:
        for run, seeds in zip(self.runs, self.seeds, strict=True):
            run.append({name: values[seeds] for name, values in row.items()})

    def _finish(self, state: TrainState, row: Row, facts: Mapping[str, Any]) -> None:
        """Leave each run as if it had been trained alone, but for its replay."""
        facts = {**facts, "side_by_side": len(self.training.seeds)}
        for run, config, seeds in zip(self.runs, self.members, self.seeds, strict=True):
            checkpoint.save(run.checkpoints, int(row["step"][0]), self.training.trainer, state, keep=1, seeds=seeds)
            metrics = run.read_metrics()
            plotting.learning_curve(run.curve, metrics, str(config.name))
            summary = outcome.summary(metrics, {n: values[seeds] for n, values in row.items()}, **facts)
            if config.diagnostics.q_bias:
                summary["overestimation"] = overestimation.summary(metrics, self.training.spec.agents)
                overestimation.draw(run.q_bias, metrics, self.training.spec.by_team(), str(config.name))
            run.write_summary(summary)

    def _announce(self) -> None:
        training, config = self.training, self.members[0]
        seeds, mesh = len(training.seeds), training.trainer.mesh
        names = [str(member.name) for member in self.members]
        shown = ", ".join(names if len(names) <= 4 else [*names[:2], "...", names[-1]])
        print(f"piece {self.number} ({self.number + 1} of {len(self.sweep.pieces)}): {len(names)} runs, {seeds} seeds "
              f"in all, on {mesh.size} x {mesh.devices.flat[0].device_kind}: {shown}")  # fmt: skip
        print(f"{config.env['name']}, {training.total_steps:,} env steps each; {training.memory}; "
              f"{needed(training.trainer, seeds) / 1e9:.2f} GB in all", flush=True)  # fmt: skip


class Stopped(Exception):
    """A signal ended the training; `code` is the exit code."""

    def __init__(self, code: int):
        self.code = code


def train(settings: Mapping[str, Config], folder: Path, budget: int | None = None) -> dict[str, list[Path]]:
    """Train what is missing of `settings` (by name) in `folder`: the directories of each setting's finished runs.

    The same call goes on where it was stopped, and finished runs are used as they are. `budget`: as for `Sweep.add`.
    Raises UserError, and Stopped when a signal ended the training.
    """
    sweep = Sweep(folder)
    runs = sweep.add(settings, budget)
    wanted = [path for paths in runs.values() for path in paths]
    names = {path.name for path in wanted}
    code = sweep.train([k for k, piece in enumerate(sweep.pieces) if names & set(piece)])
    if code:
        raise Stopped(code)
    for path in wanted:
        if not (path / "summary.json").exists():
            raise UserError(f"{path} is not finished, and not here to be: another process is at it, or none knows it")
    return runs
