"""Train many settings: runs that can share a program as one batch, batch after batch.

A folder holds `runs/NAME/`, an ordinary run directory for each run, `batches.json` (which runs are trained together)
and, while a batch is trained, `batches/K/` with its checkpoints. Each batch can be trained by a process of its own.
"""

import contextlib
import dataclasses
import json
import shutil
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path

from matd3_jax.config import Config
from matd3_jax.errors import UserError
from matd3_jax.runs import lock
from matd3_jax.runs.directory import PLANS, RunDirectory
from matd3_jax.runs.paths import is_name
from matd3_jax.runtime import devices, files
from matd3_jax.runtime.multihost import SINGLE_PROCESS, Processes
from matd3_jax.runtime.signals import Stop
from matd3_jax.runtime.terminal import say
from matd3_jax.sweep import batching
from matd3_jax.sweep.batch import Batch
from matd3_jax.sweep.lineage import FILE as LINEAGE
from matd3_jax.sweep.population import Rules
from matd3_jax.training import hybrid, outputs, starting
from matd3_jax.training.memory import most_seeds
from matd3_jax.training.session import TrainingSession


class Sweep:
    """The runs of a folder and their batches.

    Args:
        processes: which train every batch together, its seeds shared out among them (among as many as there are
            seeds); the first of them plans, and writes all but the others' part of checkpoints.
        population: the runs are the members of populations, in one batch.

    Raises UserError for populations in several processes.
    """

    def __init__(self, folder: Path, processes: Processes = SINGLE_PROCESS, population: Rules | None = None):
        if population is not None and processes.size > 1:
            raise UserError(
                f"pbt=true: members copy each other within one process, and these are {processes.size}: start one "
                "(it uses all devices of its machine)"
            )
        self.folder, self.processes, self.population = folder, processes, population
        self.runs = folder / "runs"
        self._name = next((name for name in reversed(PLANS) if (folder / f"{name}.json").exists()), PLANS[0])
        self._plan = folder / f"{self._name}.json"

    @property
    def batches(self) -> list[list[str]]:
        """Names of the runs in each batch. Raises UserError where the file has something else."""
        if not self._plan.exists():
            return []
        try:
            found = json.loads(self._plan.read_text(encoding="utf-8"))
        except (OSError, ValueError, RecursionError) as error:
            raise UserError(f"cannot read {self._plan}: {error}") from error
        if not isinstance(found, list) or not all(isinstance(batch, list) and batch for batch in found):
            raise UserError(f"{self._plan}: must be a list of batches, each a list of names of runs")
        for name in (name for batch in found for name in batch):
            if not is_name(name):
                raise UserError(f"{self._plan}: {name!r} is no name of a run in {self.runs}")
        return found

    @contextlib.contextmanager
    def planning(self) -> Iterator[None]:
        """Have the folder, which is made, to oneself for the block. Where the block fails at once nothing is left.

        Raises InUse where another process plans.
        """
        made = [path for path in (self.folder, *self.folder.parents) if not path.exists()]
        self.folder.mkdir(parents=True, exist_ok=True)
        try:
            with lock.held(self.folder):
                yield
        except UserError:
            if made and [path.name for path in self.folder.iterdir()] == [lock.NAME]:
                (self.folder / lock.NAME).unlink()
                for path in made:
                    path.rmdir()
            raise

    def unfinished_plan(self) -> bool:
        """Whether the folder has no more than what a process that was killed while it planned leaves."""
        if not self.folder.is_dir() or not all(RunDirectory(path).bare for path in _entries(self.runs)):
            return False
        own = {lock.NAME, self.runs.name, self._plan.name, *(path.name for path in files.partial(self.folder))}
        return set() < {path.name for path in self.folder.iterdir()} <= own

    def discard_plan(self) -> None:
        """Take away what `unfinished_plan` found, while the folder is held."""
        if self.unfinished_plan():
            files.remove_partial(self.folder)
            self._plan.unlink(missing_ok=True)

    def add(self, settings: Mapping[str, Config], budget: int | None = None) -> dict[str, list[Path]]:
        """Plan what is missing of `settings` (by name): the directories of each setting's runs, those already there
        among them.

        Args:
            budget: bytes that a batch may take in each process; None: what is free now.

        Raises UserError where a setting is impossible, or one seed of it does not fit, or the members of populations
        do not fit at once.
        """
        planned = {name for batch in self.batches for name in batch}
        for path in _entries(self.runs):
            if path.name not in planned and RunDirectory(path).bare:  # a process was killed while it planned
                shutil.rmtree(path)
        for config in settings.values():
            outputs.check(config)
        if self.population is not None and any(config.hands_over for config in settings.values()):
            raise UserError("pbt=true: members of a population are trained by one program, hybrid runs by two")
        for config in {batching.program(config): config for config in settings.values() if config.hands_over}.values():
            hybrid.switch_step(TrainingSession(config))
        if any(config.on_divergence == "stop" for config in settings.values()):
            raise UserError(
                "on_divergence=stop: a sweep's runs are trained side by side, and none ends the others; "
                "on_divergence=stop_seed stops the seeds that diverge"
            )
        budget = devices.free_memory(self.processes.local) if budget is None else budget
        size = self.processes.size
        existing = batching.existing_runs(self.runs)
        if self.population is not None:
            budget -= replay_bytes(next(iter(settings.values())))  # of the seed that is being copied
        new = batching.batches(settings, existing, self.runs, lambda config: size * fitting_seeds(config, budget))
        if self.population is not None and len(new) > 1:
            seeds = sum(config.seeds for config in settings.values())
            raise UserError(
                f"pbt=true: all members are trained at once, and their {seeds} seeds do not fit into "
                f"{budget / 1e9:.2f} GB: fewer members or seeds, or a smaller replay_capacity"
            )
        machine = {"versions": devices.versions(), **devices.description()}
        runs = [config for batch in new for config in batch]
        given = [
            starting.gather(hybrid.first_session(TrainingSession(config), config)) if starting.needed(config) else {}
            for config in runs
        ]
        for config, leaves in zip(runs, given, strict=True):
            more = (lambda folder, leaves=leaves: starting.write(folder, leaves)) if leaves else None
            RunDirectory.create(self.runs / str(config.name), config, machine, more=more)
        if new:
            whole = [*self.batches, *([str(config.name) for config in batch] for batch in new)]
            files.write_json(self._plan, whole)
        existing = batching.existing_runs(self.runs)
        return {name: [self.runs / run for run in batching.missing(c, existing)[0]] for name, c in settings.items()}

    def folder_of(self, batch: int) -> Path:
        """Where a batch has its lock and its checkpoints while it is trained."""
        return self.folder / self._name / str(batch)

    def finished(self, batch: int) -> bool:
        """Whether all runs of a batch are."""
        return all(RunDirectory(self.runs / name).summary() is not None for name in self.batches[batch])

    def train(self, only: Collection[int] | None = None) -> int:
        """Train the unfinished batches, or those of `only`: the exit code, 0 or 128 + the signal that ended it.

        Batches that another process trains are skipped.
        """
        stop = Stop()
        if self.processes.first:
            self._check_links()
            self._clean()
        todo = [k for k in range(len(self.batches)) if not self.finished(k) and (only is None or k in only)]
        for k in self.processes.broadcast(todo):
            with self._taken(k) as mine:
                if self.processes.broadcast(mine and not self.finished(k)):
                    together = self.processes.part(sum(member.seeds for member in self.members(k)))
                    if together is not None:
                        self._batch(k, together).train(stop)
                stopped = stop.agreed(self.processes)
            if stopped is not None:
                return 128 + stopped
        return 0

    def members(self, batch: int) -> list[Config]:
        """Settings of the runs in a batch."""
        return [RunDirectory.open(self.runs / name)[1] for name in self.batches[batch]]

    def _batch(self, batch: int, processes: Processes) -> Batch:
        names = self.batches[batch]
        title = f"batch {batch} ({batch + 1} of {len(self.batches)})"
        runs = [RunDirectory(self.runs / name) for name in names]
        group = self.folder.absolute().name
        place, lineage = self.folder_of(batch) / "checkpoints", self.folder / LINEAGE
        how = group, processes, False, self.population, lineage
        return Batch(title, runs, self.members(batch), place, *how)

    @contextlib.contextmanager
    def _taken(self, batch: int) -> Iterator[bool]:
        """Whether these processes have the batch to themselves now; the first takes it for all."""
        if not self.processes.first:
            yield False
            return
        folder = self.folder_of(batch)
        folder.mkdir(parents=True, exist_ok=True)
        with contextlib.ExitStack() as stack:
            try:
                stack.enter_context(lock.held(folder))
            except lock.InUse:
                say(f"batch {batch}: another process trains it, skipped")
                yield False
                return
            yield True
        self._clean()

    def _check_links(self) -> None:
        """Raise UserError where a folder that is written to, or deleted, is a link to elsewhere."""
        batches = range(len(self.batches))
        names = [self.runs / name for k in batches if not self.finished(k) for name in self.batches[k]]
        for path in (*names, self.folder / self._name, *map(self.folder_of, batches)):
            if not path.resolve().is_relative_to(self.folder.resolve()):
                raise UserError(f"{path} leads out of {self.folder}: nothing is written there")

    def _clean(self) -> None:
        """Delete what finished batches needed while they were trained."""
        for k in range(len(self.batches)):
            if self.folder_of(k).is_dir() and self.finished(k):
                shutil.rmtree(self.folder_of(k), ignore_errors=True)


def _entries(folder: Path) -> list[Path]:
    return sorted(folder.iterdir()) if folder.is_dir() and not folder.is_symlink() else []


class Stopped(Exception):
    """A signal ended the training; `code` is the exit code."""

    def __init__(self, code: int):
        self.code = code


def train(settings: Mapping[str, Config], folder: Path, budget: int | None = None) -> dict[str, list[Path]]:
    """Train what is missing of `settings` (by name) in `folder`: the directories of each setting's finished runs.

    The same call resumes where it was stopped, and finished runs are used as they are. `budget`: as for `Sweep.add`.
    Raises UserError, and Stopped when a signal ended the training.
    """
    if not settings:
        return {}
    sweep = Sweep(folder)
    with sweep.planning():
        runs = sweep.add(settings, budget)
    wanted = [path for paths in runs.values() for path in paths]
    names = {path.name for path in wanted}
    code = sweep.train([k for k, batch in enumerate(sweep.batches) if names & set(batch)])
    if code:
        raise Stopped(code)
    for path in wanted:
        if RunDirectory(path).summary() is None:
            raise UserError(f"{path} is not finished: another process trains it, or the sweep's plan does not have it")
    return runs


def replay_bytes(config: Config) -> int:
    """Of one seed of a run's settings."""
    trainer = TrainingSession(dataclasses.replace(config, seeds=1)).trainer
    return trainer.replay_bytes // trainer.sharding.devices_per_seed


def fitting_seeds(config: Config, budget: int) -> int:
    """`most_seeds` of a run's settings."""
    return most_seeds(TrainingSession(config).trainer, budget)
