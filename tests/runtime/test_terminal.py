"""Printing never ends a program, whatever its terminal is."""

import os
import signal
import subprocess
import sys
import time

import pytest

SAY = "from matd3_jax.runtime.terminal import complain, leave, say, show; import sys\n"
TABLE = "from rich.table import Table; t = Table(title='\\xb1 95 %'); t.add_column('a'); t.add_row('\\xe9')\n"


def python(code: str, **how) -> subprocess.CompletedProcess:
    return subprocess.run([sys.executable, "-c", SAY + TABLE + code], capture_output=True, timeout=60, **how)


def test_an_ascii_terminal():
    ascii_only = {**os.environ, "LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    done = python("say('3 \\xb1 1'); show(t); complain('\\xe9'); print('end')", env=ascii_only)
    assert done.returncode == 0 and done.stdout.startswith(b"3 \\xb1 1\n"), done
    assert done.stdout.isascii() and b"\\u" not in done.stdout  # the table's lines, too
    assert b"\\xb1 95" in done.stdout and done.stdout.endswith(b"end\n")


@pytest.mark.parametrize("closed", ["1", "2"])
def test_a_closed_stream(closed):
    code = f"import os; os.close({closed}); say('a'); show(t); complain('b'); leave(); sys.exit(0)"
    assert python(code).returncode == 0


def test_nobody_reads():
    reader, writer = os.pipe()
    os.close(reader)
    code = SAY + TABLE + "for _ in range(9): say('a' * 10**5); show(t)\n"
    done = subprocess.run([sys.executable, "-c", code], stdout=writer, stderr=subprocess.PIPE, timeout=60)
    os.close(writer)
    assert done.returncode == 0 and done.stderr == b""


@pytest.mark.slow
@pytest.mark.parametrize("module", ["experiments.cooperative", "benchmarks.loop", "matd3_jax.train"])
def test_nobody_reads_the_help(module):
    """Of studies and benchmarks, too, which print by the same functions (a rule of ruff sees to it)."""
    reader, writer = os.pipe()
    os.close(reader)
    done = subprocess.run([sys.executable, "-m", module, "--help"], stdout=writer, stderr=subprocess.PIPE, timeout=60)
    os.close(writer)
    assert done.returncode == 0 and done.stderr == b""


def test_a_full_disk_behind_the_output():
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            [sys.executable, "-c", SAY + TABLE + "say('a'); show(t); complain('still there'); leave(); sys.exit(7)"],
            stdout=full,
            stderr=subprocess.PIPE,
            timeout=60,
        )
    assert done.returncode == 7 and done.stderr == b"still there\n"


def test_tables_keep_their_width_without_a_terminal():
    done = python("t.add_column('b' * 150); show(t, 200)")
    assert "b" * 150 in done.stdout.decode()


BLOCKED = """
import sys
from matd3_jax.cli import command
from matd3_jax.runtime.signals import Stop
from matd3_jax.runtime.terminal import say

def main(argv):
    stop = Stop()
    print("ready", file=sys.stderr, flush=True)
    say("x" * 10**6)
    print(f"went on after {int(stop.signal)}", file=sys.stderr, flush=True)
    return 0

command.run(main)
"""


@pytest.mark.slow
@pytest.mark.parametrize("signals", [1, 2])
def test_signals_while_nobody_reads_the_output(signals):
    """The first is noted, and what was said is not lost; a second one ends the program, which waits for no reader."""
    reader, writer = os.pipe()
    how = {"stdout": writer, "stderr": subprocess.PIPE, "text": True}
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    started = subprocess.Popen([sys.executable, "-c", BLOCKED], env=environment, **how)
    os.close(writer)
    assert started.stderr.readline() == "ready\n"
    time.sleep(1)
    for _ in range(signals):
        started.send_signal(signal.SIGINT)
        time.sleep(0.5)
    if signals == 1:
        said = b"".join(iter(lambda: os.read(reader, 2**16), b""))
        assert said.count(b"x") == 10**6 and b"SIGINT: writing a checkpoint" in said and started.wait(60) == 0
        assert started.stderr.read() == "went on after 2\n"
    else:
        assert started.wait(60) == 130
        assert started.stderr.read() == ""
    os.close(reader)
