"""Run commands in processes of their own, which may be disturbed (`fault_process`), and see what comes of it."""

import json
import select
import subprocess
import sys
import threading
from pathlib import Path
from typing import NamedTuple

LIMIT = 900
"""Seconds after which a command is taken to hang."""


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
        self.process: subprocess.Popen | None = None

    def run(self, job: Job) -> Ended:
        self.begin(job)
        return self.wait(job.after)

    def begin(self, job: Job) -> None:
        if self.process is None or self.process.poll() is not None:
            self.process = subprocess.Popen(
                [sys.executable, str(Path(__file__).with_name("fault_process.py"))],
                stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True,
            )  # fmt: skip
            assert self._answer() == "ready"
        self.number += 1
        self.output, self.log = (
            self.place / f"{id(self)}-{self.number}.txt",
            self.place / f"{id(self)}-{self.number}.log",
        )
        given = {**job._asdict(), "folder": str(job.folder)}
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps({**given, "output": str(self.output), "log": str(self.log)}) + "\n")
        self.process.stdin.flush()

    def wait(self, after: float | None = None) -> Ended:
        assert self.process is not None
        killer = None
        if after is not None:
            killer = threading.Timer(after, self.process.kill)
            killer.start()
        answer = self._answer()
        if killer is not None:
            killer.cancel()
            killer.join()
        if not answer:
            self.process.wait()
        texts = [path.read_text(errors="replace") if path.exists() else "" for path in (self.output, self.log)]
        for path in (self.output, self.log):
            path.unlink(missing_ok=True)
        return Ended(int(answer) if answer else None, texts[0], texts[1].splitlines())

    def _answer(self) -> str:
        """The next line of its answers; "" where it died."""
        assert self.process is not None and self.process.stdout is not None
        if not select.select([self.process.stdout], [], [], LIMIT)[0]:
            self.close()
            raise TimeoutError(f"a command took more than {LIMIT} s")
        return self.process.stdout.readline().strip()

    def close(self) -> None:
        if self.process is not None:
            self.process.kill()
            self.process.wait()
