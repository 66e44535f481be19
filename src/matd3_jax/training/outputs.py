"""Loggers that may fail without harm: those of the setting `logger`, and those of a Python program."""

import dataclasses
from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import Any, Self

import numpy as np

from matd3_jax.config import Config
from matd3_jax.errors import UserError, described
from matd3_jax.runs import summary
from matd3_jax.runs.directory import RunDirectory
from matd3_jax.tracking import logger as tracking
from matd3_jax.tracking import messages
from matd3_jax.tracking.messages import FAILED, Summarized, TrackedRun
from matd3_jax.training.loggers import Logger, TensorBoardLogger
from matd3_jax.training.session import Row

Tell = Callable[[str], object]


def check(settings: Config, recorded: bool = True) -> None:
    """Raise UserError where a logger cannot be had: its package is missing, or there is no run directory.

    recorded: whether the run leaves one, which films and checkpoints need, too.
    """
    more = [name for name in settings.logger if name != "csv"]
    asked = [f"logger=[{','.join(more)}]"] if more else []
    for key in ("video_every", "checkpoint_every", "name"):
        asked += [f"{key}={getattr(settings, key)}"] if getattr(settings, key) else []
    if asked and not recorded:
        raise UserError(f"{asked[0]} needs a run directory: give run_dir=")
    for name in more:
        if name == "tensorboard":
            TensorBoardLogger.check()
        else:
            tracking.check(name)


class Harmless:
    """A logger whose errors are reported once, and end no run."""

    def __init__(self, logger: Any, tell: Tell):
        self.logger, self.tell = logger, tell
        self.warned = False

    def log(self, row: Row) -> None:
        self._do("log", row)

    def attach(self, step: int, path: Path, seed: int | None) -> None:
        """Hand over a file, if the logger takes files."""
        if hasattr(self.logger, "attach"):
            self._do("attach", step, path, seed)

    def summarize(self, found: dict[str, Any]) -> None:
        """Hand over the summary, if the logger takes one."""
        if hasattr(self.logger, "summarize"):
            self._do("summarize", found)

    def close(self) -> None:
        self._do("close")

    def _do(self, method: str, *arguments: Any) -> None:
        try:
            getattr(self.logger, method)(*arguments)
        except Exception as error:
            if not self.warned:
                self.warned = True
                why = described(error)
                self.tell(f"warning: {type(self.logger).__name__} fails, the run goes on: {why[:300]}")


class Outputs:
    """Where the rows, films, figures and summaries of runs side by side go, besides their directories.

    As a context it is closed at the end; `how` says before how the runs were left.

    Args:
        members: settings of the runs, and `seeds` where each run's seeds are in the rows.
        tell: gets warnings.
        say: gets the lines that say where the runs are to be seen.
        diverged: the places of seeds that have; more may come into it.
        sweep: the name of the sweep that the runs belong to.
        own: loggers of a Python program.
    """

    def __init__(
        self,
        runs: Sequence[RunDirectory],
        members: Sequence[Config],
        seeds: Sequence[slice],
        tell: Tell,
        say: Tell,
        diverged: Collection[int] = (),
        sweep: str | None = None,
        own: Sequence[Logger] = (),
    ):
        self.runs = runs
        self.how = FAILED
        """How the runs were left, for trackers: one of `tracking.messages`."""
        self.own = [Harmless(logger, tell) for logger in own]
        # Runs of one program may have different loggers.
        board = [
            (run, part) for run, one, part in zip(runs, members, seeds, strict=True) if "tensorboard" in one.logger
        ]
        if board:
            self.own.append(Harmless(TensorBoardLogger(*map(list, zip(*board, strict=True))), tell))
        self.trackers = [
            Tracker(kind, runs, members, seeds, tell, say, diverged, sweep)
            for kind in tracking.NAMES
            if any(kind in one.logger for one in members)
        ]

    def log(self, row: Row) -> None:
        """Take a row: columns [seeds]."""
        for logger in self.own:
            logger.log(row)
        for tracker in self.trackers:
            tracker.log(row)

    def attach(self, run: int, step: int, path: Path, seed: int | None = None) -> None:
        """Take a film or a figure of the run number `run`, of a seed or of all."""
        for logger in self.own:
            logger.attach(step, path, seed)
        for tracker in self.trackers:
            tracker.attach(run, step, path, seed)

    def finish(self, run: int, found: dict[str, Any]) -> None:
        """Take what the run number `run` has left at its end: its figures and its summary."""
        directory = self.runs[run]
        step = int(found["total_steps"])
        for path in (directory.curve, directory.q_bias):
            if path.is_file():
                self.attach(run, step, path)
        for logger in self.own:
            logger.summarize(found)
        for tracker in self.trackers:
            tracker.summarize(run, _summarized(directory, step, found))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End; trackers may take a while to get everything, but not for ever."""
        for logger in self.own:
            logger.close()
        for tracker in self.trackers:
            tracker.logger.end(self.how)
        for tracker in self.trackers:
            tracker.logger.close(self.how)


class Tracker:
    """A tracker that gets those of the runs that want it."""

    def __init__(
        self,
        kind: str,
        runs: Sequence[RunDirectory],
        members: Sequence[Config],
        seeds: Sequence[slice],
        tell: Tell,
        say: Tell,
        diverged: Collection[int],
        sweep: str | None,
    ):
        wanting = [number for number, one in enumerate(members) if kind in one.logger]
        self.numbers = {number: k for k, number in enumerate(wanting)}
        self.places = np.concatenate([np.arange(seeds[number].stop)[seeds[number]] for number in wanting])
        self.diverged = diverged
        tracked = [_tracked(runs[number], members[number], sweep) for number in wanting]
        self.logger = tracking.TrackingLogger(kind, tracked, tell, say)

    def log(self, row: Row) -> None:
        lost = frozenset(k for k, place in enumerate(self.places.tolist()) if place in self.diverged)
        self.logger.log({name: values[self.places] for name, values in row.items()}, lost)

    def attach(self, run: int, step: int, path: Path, seed: int | None) -> None:
        if run in self.numbers:
            self.logger.attach(self.numbers[run], step, path, seed)

    def summarize(self, run: int, message: Summarized) -> None:
        if run in self.numbers:
            self.logger.summarize(dataclasses.replace(message, run=self.numbers[run]))


def _tracked(run: RunDirectory, settings: Config, sweep: str | None) -> TrackedRun:
    path = run.path.absolute()
    seeds = tuple(settings.seed_numbers)
    return TrackedRun(path.name, str(path), seeds, settings.to_dict(), sweep)


def _summarized(run: RunDirectory, step: int, found: dict[str, Any]) -> Summarized:
    """A run's summary in numbers, and of each seed its own."""
    metrics = run.read_metrics()
    facts = {name: value for name, value in found.items() if isinstance(value, int | float)}
    seeds = {}
    for seed in np.unique(metrics["seed"]).astype(int).tolist():
        own: dict[str, Any] = dict(facts)
        if str(seed) in found["diverged"]:
            own["diverged_at"] = found["diverged"][str(seed)]
        else:
            there = metrics["seed"] == seed
            own["last_tenth"] = summary.finals({name: column[there] for name, column in metrics.items()}, step)
        seeds[seed] = messages.numbers(own)
    return Summarized(0, step, messages.numbers(found), seeds)
