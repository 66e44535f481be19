"""The process that sends runs to a tracker: `python -m matd3_jax.tracking.process wandb`, started by `TrackingLogger`.

Reads messages from standard input and says in lines of JSON on standard output what a user should know. A tracker that
fails, hangs or ends the process takes nothing along but itself.
"""

import json
import os
import pickle
import signal
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, BinaryIO, TextIO

from matd3_jax.errors import described
from matd3_jax.tracking import messages
from matd3_jax.tracking.backend import Backend
from matd3_jax.tracking.messages import FAILED, Attached, Closed, Logged, Summarized, TrackedRun

Key = tuple[int, int | None]

LONGEST = 120
"""Seconds that the end may take."""


def main(kind: str) -> None:
    """Track until the messages end."""
    # The process that trains decides when this one ends, also where a signal goes to all processes of a job.
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    source = os.fdopen(os.dup(0), "rb")
    out = os.fdopen(os.dup(1), "w", encoding="utf-8")
    nowhere = os.open(os.devnull, os.O_RDWR)
    for stream in (0, 1, 2):  # nobody reads what a tracker prints, and it must not ask
        os.dup2(nowhere, stream)
    Tracking(kind, out).run(source)


def backend(kind: str) -> Backend:
    """The tracker by its name in the setting `logger`."""
    if kind == "wandb":
        from matd3_jax.tracking.wandb_backend import WandbBackend

        return WandbBackend()
    from matd3_jax.tracking.mlflow_backend import MlflowBackend

    return MlflowBackend()


class Tracking:
    """Passes messages on to a tracker."""

    def __init__(self, kind: str, out: TextIO):
        self.kind, self.out = kind, out
        self.backend: Backend | None = None
        self.runs: Sequence[TrackedRun] = ()

    def run(self, source: BinaryIO) -> None:
        """Take messages, the runs first, until there are no more."""
        how = FAILED  # where the process that trains is gone without a word
        try:
            self.runs = pickle.load(source)
            self._open()
            while not isinstance(message := pickle.load(source), Closed):
                self._safely(self._take, message)
            how = message.how
        except EOFError:
            pass
        except Exception as error:
            self._warn(error)
            return
        signal.alarm(LONGEST)  # ends the process, should the tracker hang and nobody be there to do it
        if self.backend is not None:
            for key in self.keys():
                self._safely(self.backend.close, key, how)

    def keys(self) -> Iterator[Key]:
        """Of the tracker's runs, those that others are nested in first."""
        assert self.backend is not None
        for number, run in enumerate(self.runs):
            if run.bands or self.backend.has_parents:
                yield number, None
            if not run.bands:
                yield from ((number, seed) for seed in run.seeds)

    def _open(self) -> None:
        self.backend = backend(self.kind)
        for key in self.keys():
            self.backend.open(key, self.runs[key[0]])
        self._say("info", self.backend.describe())

    def _take(self, message: Any) -> None:
        assert self.backend is not None
        if isinstance(message, Logged):
            self._log(message)
        elif isinstance(message, Attached):
            self.backend.attach(self._whose(message.run, message.seed), message.step, Path(message.path))
        elif isinstance(message, Summarized):
            run = self.runs[message.run]
            if run.bands or self.backend.has_parents:
                self.backend.summarize((message.run, None), message.step, message.whole)
            for seed in () if run.bands else run.seeds:
                self.backend.summarize((message.run, seed), message.step, message.seeds.get(seed, {}))

    def _log(self, message: Logged) -> None:
        assert self.backend is not None
        first, step = 0, int(message.row["step"][0])
        for number, run in enumerate(self.runs):
            places = range(first, first + len(run.seeds))
            first = places.stop
            if run.bands or self.backend.has_parents:
                own = {name: values[places.start : places.stop] for name, values in message.row.items()}
                found = messages.as_bands(own, [place not in message.diverged for place in places])
                if not run.bands:  # the seeds have runs of their own
                    found = {name: value for name, value in found.items() if "/seed_" not in name}
                self.backend.log((number, None), step, found)
            for place, seed in zip(places, run.seeds, strict=True) if not run.bands else ():
                self.backend.log((number, seed), step, messages.of_seed(message.row, place))

    def _whose(self, number: int, seed: int | None) -> Key:
        """Which of the tracker's runs gets a file: that of its seed, of all seeds, or else of the first seed."""
        run = self.runs[number]
        if run.bands:
            return number, None
        if seed is None and self.backend is not None and self.backend.has_parents:
            return number, None
        return number, run.seeds[0] if seed is None else seed

    def _safely(self, do: Any, *arguments: Any) -> None:
        try:
            do(*arguments)
        except Exception as error:
            self._warn(error)

    def _warn(self, error: Exception) -> None:
        self._say("warning", described(error))

    def _say(self, what: str, line: str) -> None:
        try:
            print(json.dumps([what, line]), file=self.out, flush=True)
        except (OSError, ValueError):
            pass


if __name__ == "__main__":
    main(sys.argv[1])
