"""Which signals a run heeds."""

import os
import signal

import pytest

from matd3_jax.runtime.signals import NAMES, Stop


@pytest.fixture(autouse=True)
def handlers():
    before = {name: signal.getsignal(getattr(signal, name)) for name in NAMES}
    yield
    for name, handler in before.items():
        signal.signal(getattr(signal, name), handler)


@pytest.mark.parametrize("name", NAMES)
def test_a_signal_is_a_wish_to_stop(name):
    """SIGINT, too, where a shell has what it started in the background ignore it."""
    if name == "SIGINT":
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    stop = Stop()
    assert stop.signal is None
    os.kill(os.getpid(), getattr(signal, name))
    assert stop.signal == getattr(signal, name)
    with pytest.raises(SystemExit) as ended:
        signal.raise_signal(getattr(signal, name))
    assert ended.value.code == 128 + stop.signal


def test_nohup():
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    stop = Stop()
    os.kill(os.getpid(), signal.SIGHUP)
    assert stop.signal is None
    signal.raise_signal(signal.SIGTERM)
    assert stop.signal == signal.SIGTERM
