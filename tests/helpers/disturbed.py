"""Run commands in processes of their own, which may be disturbed (`fault_process`), and see what comes of it."""

import multiprocessing
import threading
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import NamedTuple

LIMIT = 900
"""Seconds after which a command is taken to hang."""

FORKS = multiprocessing.get_context("forkserver")
# Imports are half of what a process costs. By these names, as Python 3.11 does not pass its path on to the server.
FORKS.set_forkserver_preload(
    [f"matd3_jax.{name}" for name in ("cli.main", "cli.sweep", "cli.train", "figures.learning_curves")]
)


class Job(NamedTuple):
    """A command, the folder in which it may be disturbed, and how."""

    argv: list[str]
    folder: Path
    how: str = ""
    at: int = -1
    where: str = ""
    largest: int | None = None
    after: float | None = None
    """Seconds after which it is killed."""


class Ended(NamedTuple):
    """What came of a command."""

    code: int | None
    """None: it was killed."""
    output: str
    calls: list[str]


class Process:
    """A process that serves jobs until it is killed; then another one."""

    def __init__(self, place: Path):
        self.place, self.number = place, 0
        self.process: BaseProcess | None = None
        self.jobs: Connection

    def run(self, job: Job) -> Ended:
        self.begin(job)
        return self.wait(job.after)

    def begin(self, job: Job) -> None:
        if self.process is None or not self.process.is_alive():
            import fault_process

            self.jobs, theirs = FORKS.Pipe()
            self.process = FORKS.Process(target=fault_process.serve, args=(theirs,), daemon=True)
            self.process.start()
            theirs.close()  # so that the end of the process is seen here
        self.number += 1
        self.output, self.log = (
            self.place / f"{id(self)}-{self.number}.txt",
            self.place / f"{id(self)}-{self.number}.log",
        )
        given = {**job._asdict(), "folder": str(job.folder)}
        self.jobs.send({**given, "output": str(self.output), "log": str(self.log)})

    def wait(self, after: float | None = None) -> Ended:
        assert self.process is not None
        killer = None
        if after is not None:
            killer = threading.Timer(after, self.process.kill)
            killer.start()
        code = self._answer()
        if killer is not None:
            killer.cancel()
            killer.join()
        if code is None:
            self.process.join()
        texts = [path.read_text(errors="replace") if path.exists() else "" for path in (self.output, self.log)]
        for path in (self.output, self.log):
            path.unlink(missing_ok=True)
        return Ended(code, texts[0], texts[1].splitlines())

    def _answer(self) -> int | None:
        """The exit code that it sends; None where it died."""
        if not self.jobs.poll(LIMIT):
            self.close()
            raise TimeoutError(f"a command took more than {LIMIT} s")
        try:
            return self.jobs.recv()
        except EOFError:
            return None

    def close(self) -> None:
        if self.process is not None:
            self.process.kill()
            self.process.join()
