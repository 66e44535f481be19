"""A tracker that fails, hangs or dies: one warning, and the training goes on at once. Stand-ins for W&B."""

import io
import os
import pickle
import textwrap
import time

import numpy as np
import pytest

from matd3_jax.tracking import logger as tracking
from matd3_jax.tracking import process
from matd3_jax.tracking.logger import TrackingLogger
from matd3_jax.tracking.messages import FAILED, FINISHED, Closed, Logged, TrackedRun

pytestmark = pytest.mark.slow

ROW = {"step": np.array([100]), "seed": np.array([3]), "return_agents": np.array([1.5])}
SETTINGS = {"logger_seeds": "runs", "wandb": {"project": None, "entity": None, "mode": None}}

STAND_IN = """
    import os, sys, time
    class Settings:
        def __init__(self, **given): pass
    class Run:
        offline, url = False, "https://example.org/run"
        def log(self, values, step): {log}
        def finish(self, exit_code): {close}
    def init(**given):
        {init}
        return Run()
"""


@pytest.fixture
def stand_in(tmp_path, monkeypatch):
    """Makes a package `wandb` that does as it is told."""

    def make(init="pass", log="pass", close="pass"):
        folder = tmp_path / "packages" / "wandb"
        folder.mkdir(parents=True)
        (folder / "__init__.py").write_text(textwrap.dedent(STAND_IN.format(init=init, log=log, close=close)))
        monkeypatch.setenv("PYTHONPATH", str(folder.parent))

    return make


def started(tmp_path, said, told):
    run = TrackedRun("first", str(tmp_path), (3,), SETTINGS)
    return TrackingLogger("wandb", [run], told.append, said.append)


@pytest.mark.parametrize(
    ("how", "warning"),
    [
        ({"init": "raise RuntimeError('No API key configured.')"}, "RuntimeError: No API key configured."),
        ({"init": "raise SystemExit(1)"}, "its process ended (exit code 1)"),
        ({"log": "raise ValueError('two\\nlines')"}, "ValueError: two lines"),
        ({"log": "os._exit(7)"}, "its process ended (exit code 7)"),
        ({"close": "raise OSError('no network')"}, "OSError: no network"),
    ],
)
def test_one_warning_and_no_end(how, warning, stand_in, tmp_path):
    stand_in(**how)
    said, told = [], []
    logger = started(tmp_path, said, told)
    slowest = 0.0
    for k in range(20):
        begun = time.monotonic()
        logger.log({**ROW, "step": np.array([k])})
        slowest = max(slowest, time.monotonic() - begun)
        time.sleep(0.05)
    logger.close(FINISHED)
    logger.close(FINISHED)
    assert slowest < 0.5
    assert told == [f"warning: Weights & Biases fails, the run goes on without it: {warning}"]


@pytest.mark.parametrize("where", ["init", "log", "close"])
def test_one_that_hangs_is_left(where, stand_in, tmp_path, monkeypatch):
    monkeypatch.setattr(tracking, "PATIENCE", {FINISHED: 3.0})
    stand_in(**{where: "time.sleep(1000)"})
    said, told = [], []
    logger = started(tmp_path, said, told)
    begun = time.monotonic()
    for _ in range(100):
        logger.log(ROW)
    assert time.monotonic() - begun < 1
    logger.close(FINISHED)
    assert time.monotonic() - begun < 15
    assert told == [
        "warning: Weights & Biases fails, the run goes on without it: it has not taken everything after 3 s"
    ]
    with pytest.raises(ProcessLookupError):
        os.kill(logger._process.pid, 0)


def test_one_that_is_slower_than_the_training_loses_rows(stand_in, tmp_path, monkeypatch):
    monkeypatch.setattr(tracking, "MOST", 50)
    monkeypatch.setattr(tracking, "IN_A_HURRY", 1.0)
    stand_in(init="time.sleep(1000)")
    told = []
    logger = started(tmp_path, [], told)
    for _ in range(5000):
        logger.log({**ROW, "return_agents": np.zeros(1000)})
    logger.close(FAILED)
    assert len(told) == 1 and "slower than the training" in told[0]


def test_the_line_that_says_where_the_runs_are(stand_in, tmp_path):
    stand_in()
    said, told = [], []
    logger = started(tmp_path, said, told)
    logger.log(ROW)
    logger.close()
    assert (said, told) == (["Weights & Biases: https://example.org/run"], [])


class Noted:
    """A tracker that notes what it gets."""

    has_parents = False

    def __init__(self):
        self.calls = []

    def __getattr__(self, name):
        return lambda *given: self.calls.append((name, *given))


@pytest.mark.parametrize(("last", "how"), [([Closed("stopped")], "stopped"), ([], FAILED)])
def test_runs_are_closed_also_where_the_training_is_killed(last, how, tmp_path, monkeypatch):
    """Then the messages end without a word."""
    noted = Noted()
    monkeypatch.setattr(process, "backend", lambda kind: noted)
    monkeypatch.setattr(process.signal, "alarm", lambda seconds: None)
    run = TrackedRun("first", str(tmp_path), (3,), SETTINGS)
    source = io.BytesIO(b"".join(pickle.dumps(one) for one in [(run,), Logged(ROW, frozenset()), *last]))
    process.Tracking("wandb", io.StringIO()).run(source)
    assert noted.calls[-2:] == [("log", (0, 3), 100, {"return_agents": 1.5}), ("close", (0, 3), how)]
