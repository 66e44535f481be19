"""Ctrl-C ends a command while it is loaded."""

import signal
import subprocess
import sys
import threading

import pytest

from matd3_jax.runtime import interrupt

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


def test_nothing_swallows_it():
    done = subprocess.run([sys.executable, "-c", LOADING], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "interrupted\n")


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
