"""One process works in a run directory; a lock whose owner is gone holds nobody up."""

import json
import os
import signal
import socket
import subprocess
import sys

import pytest

from matd3_jax.errors import UserError
from matd3_jax.runs import lock

HOLD = """
import sys, time, pathlib
from matd3_jax.runs import lock
if sys.argv[2] == "owner":
    lock.fcntl = None
with lock.held(pathlib.Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(60)
"""


@pytest.fixture(params=["system", "owner"])
def kind(request, monkeypatch):
    """With the system's locks, and on a system that has none."""
    if request.param == "owner":
        monkeypatch.setattr(lock, "fcntl", None)
    return request.param


def test_a_second_process_learns_who_works_there_and_a_killed_one_is_taken_over(tmp_path, kind):
    other = subprocess.Popen([sys.executable, "-c", HOLD, str(tmp_path), kind], stdout=subprocess.PIPE, text=True)
    try:
        assert other.stdout.readline() == "held\n"
        with pytest.raises(UserError, match=f"is in use: process {other.pid} on {socket.gethostname()} works in it"):
            with lock.held(tmp_path):
                pass
        os.kill(other.pid, signal.SIGKILL)
        other.wait()
        with lock.held(tmp_path):
            assert json.loads((tmp_path / ".lock").read_text())["process"] == os.getpid()
    finally:
        other.kill()


@pytest.mark.slow
def test_commands_start_without_fcntl():
    """As on Windows, which lacks it."""
    commands = "check, crossplay, evaluate, export, plot, render, report, sweep, train"
    code = f"import sys; sys.modules['fcntl'] = None; from matd3_jax.cli import {commands}"
    code += "; from matd3_jax.runs import lock; sys.exit(lock.fcntl is not None)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_it_can_be_held_again_after_its_end_and_after_an_error(tmp_path, kind):
    for _ in range(2):
        with pytest.raises(RuntimeError), lock.held(tmp_path):
            raise RuntimeError


def test_an_owner_on_another_host_is_not_declared_dead(tmp_path, monkeypatch):
    monkeypatch.setattr(lock, "fcntl", None)
    (tmp_path / ".lock").write_text(json.dumps({"process": 2**22 - 3, "host": "elsewhere"}))
    with pytest.raises(UserError, match="on elsewhere works in it"), lock.held(tmp_path):
        pass
    (tmp_path / ".lock").write_text("torn {")
    with pytest.raises(UserError, match="another process works in it"), lock.held(tmp_path):
        pass


def test_a_lock_that_is_a_link_is_not_followed(tmp_path):
    (tmp_path / "mine").write_text("mine")
    (tmp_path / ".lock").symlink_to(tmp_path / "mine")
    with pytest.raises(UserError, match="is a link"), lock.held(tmp_path):
        pass
    assert (tmp_path / "mine").read_text() == "mine"
