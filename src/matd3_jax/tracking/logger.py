"""The logger that hands a run to Weights & Biases or MLflow."""

import collections
import contextlib
import importlib.util
import json
import os
import pickle
import queue
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import matd3_jax
from matd3_jax.errors import UserError
from matd3_jax.tracking.messages import FINISHED, Attached, Closed, Logged, Summarized, TrackedRun

NAMES = {"wandb": "Weights & Biases", "mlflow": "MLflow"}
"""Trackers as the setting `logger` has them, and as they are called."""

PATIENCE = {FINISHED: 60.0}
"""Seconds that a tracker may take at the end of a run; `IN_A_HURRY` where it was stopped or failed."""

IN_A_HURRY = 10.0

MOST = 10_000
"""Messages that wait for a tracker which is slower than the training; what comes beyond is left out."""


def check(kind: str) -> None:
    """Raise UserError where the tracker's package is missing."""
    try:
        spec = importlib.util.find_spec(kind)
    except ValueError:
        spec = None
    if spec is None or spec.origin is None:  # a folder of that name, which W&B leaves, is no package
        raise UserError(f"logger=[{kind}] needs the package {kind}: pip install 'matd3_jax[{kind}]'")


class TrackingLogger:
    """Sends rows, pictures, films and summaries to a tracker, through a process of its own.

    Whatever happens to the tracker, the training goes on: nothing here waits but `close`, and that for `PATIENCE` at
    most. The first thing that goes wrong is reported in one line, when the next row comes.

    Args:
        kind: one of `NAMES`.
        runs: whose seeds, one run after the other, are the seeds of the rows.
        tell: gets the warning.
        say: gets the line that says where the runs are.
    """

    def __init__(
        self,
        kind: str,
        runs: Sequence[TrackedRun],
        tell: Callable[[str], object],
        say: Callable[[str], object],
    ):
        self.kind, self.tell, self.say = kind, tell, say
        self.warned = self.closed = self._gone = False
        self._deadline: float | None = None
        self._said: collections.deque[tuple[str, str]] = collections.deque()
        self._queue: queue.Queue[Any] = queue.Queue(MOST)
        package = str(Path(matd3_jax.__file__).parents[1])
        path = os.pathsep.join([package, *filter(None, [os.environ.get("PYTHONPATH")])])
        try:
            self._process: subprocess.Popen | None = subprocess.Popen(
                [sys.executable, "-m", "matd3_jax.tracking.process", kind],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                env={**os.environ, "PYTHONPATH": path},
                start_new_session=True,  # Ctrl-C is for the training
            )
        except OSError as error:
            self._process = None
            self._warn(str(error))
            return
        self._threads = [threading.Thread(target=work, daemon=True) for work in (self._write, self._read)]
        for thread in self._threads:
            thread.start()
        self._send(tuple(runs))

    def log(self, row: Mapping[str, np.ndarray], diverged: frozenset[int] = frozenset()) -> None:
        """Take a row, columns [seeds]; diverged: the places of seeds that have."""
        self._tell()
        self._send(Logged(row, diverged))

    def attach(self, run: int, step: int, path: Path, seed: int | None = None) -> None:
        """Take a picture or a film of the run number `run`; seed: whose it is, None of all."""
        self._send(Attached(run, step, str(path.absolute()), seed))

    def summarize(self, message: Summarized) -> None:
        """Take what a run left in its summary."""
        self._send(message)

    def end(self, how: str = FINISHED) -> None:
        """Tell the tracker that nothing will come any more; `close` waits for it."""
        if self._deadline is None:
            self.patience = PATIENCE.get(how, IN_A_HURRY)
            self._deadline = time.monotonic() + self.patience
            self._send(Closed(how))

    def close(self, how: str = FINISHED) -> None:
        """End the tracker's runs; wait until it has taken everything, but not for ever."""
        if self.closed or self._process is None:
            return
        self.closed = True
        self.end(how)
        try:
            self._process.wait(max(0.1, self._deadline - time.monotonic()))  # type: ignore[operator]
        except BaseException as error:
            with contextlib.suppress(OSError):
                os.killpg(self._process.pid, signal.SIGKILL)  # with what it started
            self._process.wait()
            if not isinstance(error, subprocess.TimeoutExpired):
                raise
            self._said.append(("warning", f"it has not taken everything after {self.patience:.0f} s"))
        self._threads[1].join(1)
        if self._process.returncode:  # after everything was written: nobody found the pipe broken
            self._said.append(("warning", f"its process ended (exit code {self._process.returncode})"))
        self._tell()

    def _send(self, message: Any) -> None:
        if self._process is None or self._gone:
            return
        try:
            self._queue.put_nowait(message)
        except queue.Full:
            self._warn("it is slower than the training, and lacks rows")

    def _write(self) -> None:
        assert self._process is not None and self._process.stdin is not None
        try:
            while True:
                message = self._queue.get()
                pickle.dump(message, self._process.stdin)
                self._process.stdin.flush()
                if isinstance(message, Closed):
                    self._process.stdin.close()
                    return
        except (OSError, ValueError):
            self._gone = True
            code = self._process.wait()
            self._threads[1].join(1)  # what it said before is the reason
            self._said.append(("warning", f"its process ended (exit code {code})"))

    def _read(self) -> None:
        assert self._process is not None and self._process.stdout is not None
        for line in self._process.stdout:
            with contextlib.suppress(ValueError):
                what, text = json.loads(line)
                self._said.append((what, text))

    def _tell(self) -> None:
        while self._said:
            what, text = self._said.popleft()
            if what == "info":
                self.say(text)
            else:
                self._warn(text)

    def _warn(self, text: str) -> None:
        if not self.warned:
            self.warned = True
            self.tell(f"warning: {NAMES[self.kind]} fails, the run goes on without it: {text[:300]}")
