"""Which signals a run heeds."""

import os
import signal

import pytest

from matd3_jax.runtime.signals import Stop


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
