"""The asking end: processes of the scripts of this folder, and the environments that some of them need."""

import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.peers_scripts.rows import Worker
from matd3_jax.cli import command
from matd3_jax.runtime import files

LIMIT = 900.0
"""Seconds for one answer; compiling included."""


class WorkerError(Exception):
    """What went wrong with a worker, in one line."""


class Process:
    """A running script; see `serve.serve` for what it answers."""

    def __init__(self, python: Path, worker: Worker, cache: Path, log: Path):
        env = dict(os.environ, JAX_PLATFORMS="cpu", MPLBACKEND="Agg")
        env.setdefault("JAX_COMPILATION_CACHE_DIR", str(cache))
        if worker.script == "stepping_jax.py":
            env["JAX_NUM_CPU_DEVICES"] = "1"  # the program runs on one device, which then has all cores
        if worker.requirements:
            env.pop("PYTHONPATH", None)  # what it leads to is this Python's
        script = Path(__file__).parent / worker.script
        self.log = log
        with log.open("a") as errors:
            self.process = subprocess.Popen(
                [str(python), str(script), str(worker.cores)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=errors,
                text=True,
                env=env,
            )

    def send(self, **request: Any) -> None:
        """Ask; raises WorkerError if the process is gone."""
        assert self.process.stdin is not None
        try:
            self.process.stdin.write(json.dumps(request) + "\n")
            self.process.stdin.flush()
        except OSError:
            raise WorkerError(self._ended()) from None

    def receive(self) -> dict[str, Any]:
        """The answer to what was sent. Raises WorkerError for an error, an end, or none within LIMIT seconds."""
        assert self.process.stdout is not None
        timer = threading.Timer(LIMIT, self.process.kill)
        timer.start()
        begun = time.monotonic()
        try:
            line = self.process.stdout.readline()
        finally:
            timer.cancel()
        if not line:
            late = time.monotonic() - begun >= LIMIT
            raise WorkerError(f"no answer within {LIMIT:.0f} s" if late else self._ended())
        answer = json.loads(line)
        if "error" in answer:
            raise WorkerError(answer["error"])
        return answer

    def close(self) -> None:
        """End it: by the end of its input, or else by force."""
        assert self.process.stdin is not None and self.process.stdout is not None
        try:
            self.process.stdin.close()
        except OSError:
            pass
        try:
            self.process.wait(30)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        self.process.stdout.close()

    def _ended(self) -> str:
        code = self.process.wait()
        return last_line(self.log.read_text()) or f"ended with code {code}"


def python_of(name: str, worker: Worker, folder: Path) -> Path:
    """The interpreter that runs a worker. Raises WorkerError where its environment is missing or incomplete."""
    if not worker.requirements:
        return Path(sys.executable)
    try:
        record = json.loads(_record(worker, folder).read_text())
    except (OSError, ValueError):
        raise WorkerError(f"not installed: {_prepare(folder)}") from None
    if record["error"] is not None:
        raise WorkerError(f"not installed: {record['error']}")
    if record["requirements"] != [list(part) for part in worker.requirements]:
        raise WorkerError(f"installed with other versions: {_prepare(folder)}")
    return folder / worker.package / "bin" / "python"


def _prepare(folder: Path) -> str:
    return command.line("benchmarks.peers", "prepare=true", envs=folder)


def install(worker: Worker, folder: Path) -> str | None:
    """Make a worker's environment; the error's line if that fails, which is also kept for the table."""
    folder.mkdir(parents=True, exist_ok=True)
    target = folder / worker.package
    calls = [
        [sys.executable, "-m", "venv", str(target)],
        *([str(target / "bin" / "python"), "-m", "pip", "install", "-q", *part] for part in worker.requirements),
    ]
    error = None
    for call in calls:
        done = subprocess.run(call, capture_output=True, text=True, env=_without_path())
        if done.returncode:
            error = last_line(done.stderr, "ERROR") or last_line(done.stdout) or f"code {done.returncode}"
            break
    record = {"requirements": [list(part) for part in worker.requirements], "error": error}
    files.write_json(_record(worker, folder), record)
    return error


def last_line(text: str, start: str = "") -> str:
    """The last line of `text` that is not empty and begins with `start`, or the last at all."""
    lines: Sequence[str] = [line.strip() for line in text.splitlines() if line.strip()]
    matching = [line for line in lines if line.startswith(start)] or lines
    return matching[-1] if matching else ""


def _record(worker: Worker, folder: Path) -> Path:
    return folder / f"{worker.package}.json"


def _without_path() -> dict[str, str]:
    return {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
