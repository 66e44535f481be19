"""Signals that come in a callback are not lost, and errors that say nothing are not printed."""

import signal
import subprocess
import sys
import types

from matd3_jax.runtime import callbacks

IN_A_CALLBACK = """
import os, signal, sys, time
from matd3_jax.cli import command

class Collected:
    def __del__(self):
        os.kill(os.getpid(), signal.SIGINT)
        for _ in range(10):  # Python looks for signals between its operations
            pass

def main(argv):
    Collected()
    for _ in range(100):
        time.sleep(0.1)
    return 0

command.run(main)
"""

A_SECOND_SIGNAL = IN_A_CALLBACK.replace("import os", "from matd3_jax.runtime.signals import Stop\nimport os").replace(
    "    Collected()", "    stop = Stop()\n    os.kill(os.getpid(), signal.SIGHUP)\n    Collected()"
)


def ended(program: str) -> subprocess.CompletedProcess:
    return subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60)


def test_ctrl_c_is_not_lost():
    done = ended(IN_A_CALLBACK)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "interrupted\n")


def test_a_second_signal_is_not_lost():
    done = ended(A_SECOND_SIGNAL)
    assert (done.returncode, done.stderr) == (128 + signal.SIGINT, "")
    assert "SIGHUP: writing a checkpoint" in done.stdout


def test_other_errors_are_printed_as_before(monkeypatch):
    """Once; what Orbax's futures print after a checkpoint failed is left out."""
    printed = []
    monkeypatch.setattr(sys, "unraisablehook", lambda found: printed.append(found.exc_value))
    callbacks.handle_errors()
    hook = sys.unraisablehook
    callbacks.handle_errors()
    assert sys.unraisablehook is hook
    for error in (
        RuntimeError("Event loop is closed"), RuntimeError("another"), ValueError("Event loop is closed"),
        SystemExit(1), SystemExit("words"), SystemExit(255),
    ):  # fmt: skip
        hook(types.SimpleNamespace(exc_value=error))
    wanted = "RuntimeError('another'), ValueError('Event loop is closed'), SystemExit(1), SystemExit('words')"
    assert ", ".join(map(repr, printed)) == f"{wanted}, SystemExit(255)"
