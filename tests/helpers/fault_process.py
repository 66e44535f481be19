"""A process that runs commands one after the other, as `matd3 COMMAND ...` would, and fails or dies as planned.

Jobs come through a pipe: {"argv", "folder" (which is watched), "output", "log", "how", "at", "where", "largest"}; the
exit code of each goes back. Compiled programs serve all jobs; what is imported here is there before the fork.
"""

import contextlib
import os
import signal
import sys
import traceback
from multiprocessing.connection import Connection
from pathlib import Path

import faults

from matd3_jax.cli import command, main, sweep, train  # noqa: F401  (imported before the first job comes)
from matd3_jax.figures import learning_curves  # noqa: F401


def run(job: dict) -> int:
    """The exit code of a command; 1 after a traceback."""
    fault = faults.Faults(Path(job["folder"]), Path(job["log"]), job["how"], job["at"], job["where"])
    with faults.armed(fault, job["largest"]):
        try:
            return command.code(main.main, job["argv"])
        except SystemExit as ended:
            return int(ended.code or 0)
        except BaseException:
            traceback.print_exc()
            return 1


def serve(jobs: Connection) -> None:
    """Take jobs until there are no more."""
    handlers = {name: signal.getsignal(name) for name in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    while True:
        try:
            job = jobs.recv()
        except EOFError:
            return
        output = os.open(job["output"], os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        os.dup2(output, 1)
        os.dup2(output, 2)
        os.close(output)
        code = run(job)
        for name, handler in handlers.items():
            signal.signal(name, handler)
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(OSError):
                stream.flush()
        jobs.send(code)
