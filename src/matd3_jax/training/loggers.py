"""Where the rows of the metrics table go while a run trains."""

import contextlib
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Protocol

import numpy as np

from matd3_jax.errors import UserError
from matd3_jax.runs import divergence
from matd3_jax.runs.directory import RunDirectory
from matd3_jax.runs.divergence import Divergence
from matd3_jax.training.event_file import EventFile
from matd3_jax.training.rows import Row
from matd3_jax.training.session import TrainingSession


class Logger(Protocol):
    """Takes the rows of a run, one each logging interval.

    One that has these methods, too, gets more of a run that leaves a directory: `attach(step, path, seed)` the films on
    the way and the figures at the end (seed: its number, None of all), `summarize(found)` what is in summary.json.
    """

    def log(self, row: Row) -> None:
        """Take a row: columns [seeds], "step" and "seed" among them."""

    def close(self) -> None:
        """End: nothing will come any more."""


class TableLogger:
    """Appends to the metrics tables of run directories, each its own part of the seeds."""

    def __init__(self, runs: Sequence[RunDirectory], seeds: Sequence[slice] = (slice(None),)):
        self.parts = list(zip(runs, seeds, strict=True))

    def log(self, row: Row) -> None:
        for run, seeds in self.parts:
            run.append({name: values[seeds] for name, values in row.items()})

    def close(self) -> None:
        pass


class TensorBoardLogger:
    """Writes a scalar for each column and seed into the `tensorboard` folders of run directories."""

    def __init__(self, runs: Sequence[RunDirectory], seeds: Sequence[slice] = (slice(None),)):
        self.check()
        self.parts = [(EventFile(run.tensorboard), own) for run, own in zip(runs, seeds, strict=True)]

    @staticmethod
    def check() -> None:
        """Raise UserError where the library is missing."""
        try:
            import tensorboardX  # noqa: F401
        except ImportError:
            raise UserError(
                "logger=[tensorboard] needs the package tensorboardX: pip install 'matd3_jax[tensorboard]'"
            ) from None

    def log(self, row: Row) -> None:
        with contextlib.ExitStack() as each:  # an error of one folder keeps nothing from the others
            for events, own in self.parts:
                scalars = {
                    f"{name}/seed_{seed}": float(value)
                    for name, values in row.items()
                    if name not in ("step", "seed") and not np.isnan(values[own]).all()
                    for seed, value in zip(row["seed"][own], values[own], strict=True)
                }
                each.callback(events.write, scalars, int(row["step"][0]))

    def close(self) -> None:
        pass


class DivergenceLogger:
    """Notes which seeds diverged, and reports each once.

    Args:
        report: gets a line the moment a seed diverges.
        known: what diverged before, by the places of the seeds in the rows.
        names: what each seed is called, [seeds]; default "seed N".
    """

    def __init__(
        self,
        training: TrainingSession,
        report: Callable[[str], object],
        known: Mapping[int, Divergence] | None = None,
        names: Sequence[str] | None = None,
    ):
        self.training, self.report, self.names = training, report, names
        self.diverged: dict[int, Divergence] = dict(known or {})
        """By the places of the seeds in the rows."""
        self.new = 0
        """How many have diverged since the beginning."""

    def log(self, row: Row) -> None:
        for seed, wrong in self._wrong(row).items():
            if seed in self.diverged:
                continue
            self.diverged[seed] = wrong
            self.new += 1
            name = f"seed {row['seed'][seed]}" if self.names is None else self.names[seed]
            self.report(f"{name} diverged at env step {wrong.step:,}: {wrong.what}")

    def _wrong(self, row: Row) -> dict[int, Divergence]:
        places = np.arange(len(row["seed"]))
        networks = divergence.of_networks(self.training.networks_finite, places, int(row["step"][0]))
        return divergence.earliest(divergence.of_table({**row, "seed": places}), networks)

    @property
    def everywhere(self) -> bool:
        """Whether all seeds have diverged."""
        return len(self.diverged) == self.training.share.total

    def close(self) -> None:
        pass


class CallbackLogger:
    """Calls a function with every row."""

    def __init__(self, callback: Callable[[Row], object]):
        self.callback = callback

    def log(self, row: Row) -> None:
        self.callback(row)

    def close(self) -> None:
        pass


class HistoryLogger:
    """Keeps the rows in memory."""

    def __init__(self, first: Row):
        self.rows = [first]

    def log(self, row: Row) -> None:
        self.rows.append(row)

    def close(self) -> None:
        pass


def warn(line: str) -> None:
    """Report a seed that diverged to a Python caller."""
    warnings.warn(line, RuntimeWarning, stacklevel=2)
