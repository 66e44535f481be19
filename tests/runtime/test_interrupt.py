"""Ctrl-C ends a command, wherever it comes."""

import os
import signal
import subprocess
import sys
import threading

import pytest

from matd3_jax.runtime import interrupt
from matd3_jax.runtime.signals import Stop

LOADING = """
from matd3_jax.runtime import interrupt
import os, signal
with interrupt.ends_at_once():
    try:
        os.kill(os.getpid(), signal.SIGINT)
        print("went on")
    except BaseException:  # as packages do
        print("caught")
"""

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


@pytest.mark.parametrize("program", [LOADING, IN_A_CALLBACK])
def test_nothing_swallows_it(program):
    done = ended(program)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "interrupted\n")


def test_a_second_signal_is_not_swallowed():
    done = ended(A_SECOND_SIGNAL)
    assert (done.returncode, done.stderr) == (128 + signal.SIGINT, "")
    assert "SIGHUP: writing a checkpoint" in done.stdout


def test_python_has_its_handler_back():
    handler = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(ZeroDivisionError), interrupt.ends_at_once():
            assert signal.getsignal(signal.SIGINT) is not signal.default_int_handler
            raise ZeroDivisionError
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, handler)


@pytest.mark.parametrize("of_another", [signal.SIG_IGN, lambda number, frame: None])
def test_handlers_of_others_stay(of_another):
    handler = signal.signal(signal.SIGINT, of_another)
    try:
        with interrupt.ends_at_once():
            assert signal.getsignal(signal.SIGINT) is of_another
        assert signal.getsignal(signal.SIGINT) is of_another
    finally:
        signal.signal(signal.SIGINT, handler)


def test_threads_may_load_too():
    """Python lets the main thread alone set handlers."""
    came = []

    def load():
        with interrupt.ends_at_once():
            came.append(True)

    thread = threading.Thread(target=load)
    thread.start()
    thread.join()
    assert came == [True]


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP"])
def test_a_run_ignores_what_it_was_started_to_ignore(name):
    """As nohup has it ignore SIGHUP, so that it outlives the terminal."""
    names = ("SIGINT", "SIGTERM", "SIGHUP")
    handlers = {each: signal.getsignal(getattr(signal, each)) for each in names}
    try:
        signal.signal(getattr(signal, name), signal.SIG_IGN)
        stop = Stop()
        os.kill(os.getpid(), getattr(signal, name))
        assert stop.signal is None
        other = "SIGTERM" if name != "SIGTERM" else "SIGHUP"
        signal.raise_signal(getattr(signal, other))
        assert stop.signal == getattr(signal, other)
    finally:
        for each, handler in handlers.items():
            signal.signal(getattr(signal, each), handler)
