"""Where the rows of the metrics table go while a run trains."""

from collections.abc import Callable, Sequence
from typing import Protocol

import numpy as np

from matd3_jax.errors import UserError
from matd3_jax.runs.directory import RunDirectory
from matd3_jax.training.session import Row


class Logger(Protocol):
    """Takes the rows of a run, one each logging interval."""

    def log(self, row: Row) -> None:
        """Take a row: columns [seeds], "step" and "seed" among them."""

    def close(self) -> None:
        """End: no row will come any more."""


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
        from tensorboardX import SummaryWriter

        self.parts = [(SummaryWriter(str(run.tensorboard)), own) for run, own in zip(runs, seeds, strict=True)]

    @staticmethod
    def check() -> None:
        """Raise UserError where the library is missing."""
        try:
            import tensorboardX  # noqa: F401
        except ImportError:
            raise UserError("tensorboard=true needs tensorboardX: pip install 'matd3_jax[tensorboard]'") from None

    def log(self, row: Row) -> None:
        for writer, own in self.parts:
            for name, values in row.items():
                if name in ("step", "seed") or np.isnan(values[own]).all():
                    continue
                for seed, value in zip(row["seed"][own], values[own], strict=True):
                    writer.add_scalar(f"{name}/seed_{seed}", value, int(row["step"][0]))

    def close(self) -> None:
        for writer, _ in self.parts:
            writer.close()


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
