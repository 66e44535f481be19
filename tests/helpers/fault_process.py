"""A process that runs commands one after the other, as `matd3 COMMAND ...` would, and fails or dies as planned.

Jobs come as lines of JSON on its standard input: {"argv", "folder" (which is watched), "output", "log", "how", "at",
"where", "largest"}; the exit code of each goes to its standard output. Imports and compiled programs serve all jobs.
"""

import contextlib
import json
import os
import signal
import sys
import traceback
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


def serve() -> None:
    """Take jobs until there are no more."""
    answers = os.fdopen(os.dup(1), "w")
    handlers = {name: signal.getsignal(name) for name in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    print("ready", file=answers, flush=True)
    for line in sys.stdin:
        job = json.loads(line)
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
        print(code, file=answers, flush=True)


if __name__ == "__main__":
    serve()
