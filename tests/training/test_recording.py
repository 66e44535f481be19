"""Every state that a stop, a kill or a damage leaves in a run directory leads on, and to the unbroken run's numbers."""

import dataclasses
import functools
import re
import shutil
import signal
import subprocess
import sys
import threading

import jax.numpy as jnp
import numpy as np
import pytest
from checkpoint_arrays import assert_same_run, back_to

import matd3_jax
from matd3_jax import config
from matd3_jax.envs.environment import Environment
from matd3_jax.envs.point_reach import PointReach
from matd3_jax.errors import UserError
from matd3_jax.runs import lock
from matd3_jax.runs.directory import RunDirectory
from matd3_jax.training import checkpoint
from matd3_jax.training.recording import Recorder
from matd3_jax.training.session import TrainingSession

pytestmark = pytest.mark.slow

SMALL = [
    "env=point_reach", "algo=iddpg", "seeds=2", "total_steps=1200", "learning_starts=400", "num_envs=4",
    "rollout_length=5", "batch_size=32", "replay_capacity=800", "algo.hidden=[8]", "log_every=200", "eval_every=400",
    "eval_episodes=2", "checkpoint_every=400", "keep_checkpoints=9",
]  # fmt: skip


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """An unbroken run."""
    path = tmp_path_factory.mktemp("runs") / "whole"
    Recorder().start(config.load(SMALL), path)
    return path


@pytest.fixture
def copy(whole, tmp_path):
    return shutil.copytree(whole, tmp_path / "run")


def resume(path, **given):
    """Resume and give what was said."""
    said = []
    Recorder(say=said.append).resume(path, **given)
    return said


def same(path, whole):
    assert_same_run(path, whole)
    assert RunDirectory(path).summary() is not None and (path / "learning_curve.png").exists()


def test_there_is_a_checkpoint_right_after_the_warm_up(whole):
    first, *_ = checkpoint.steps(whole / "checkpoints")
    with (whole / "metrics.csv").open() as file:
        assert first == int(file.readlines()[1].split(",")[0])


def test_killed_before_its_first_checkpoint(copy, whole):
    shutil.rmtree(copy / "checkpoints")
    (copy / "summary.json").unlink()
    assert "no checkpoint yet: this run starts again" in resume(copy)
    same(copy, whole)


def test_killed_before_anything_but_its_settings(copy, whole):
    for path in copy.iterdir():
        if path.name != "config.yaml":
            shutil.rmtree(path) if path.is_dir() else path.unlink()
    resume(copy)
    same(copy, whole)


@pytest.mark.parametrize("left", ["nothing", "an empty summary", "half a summary"])
def test_killed_after_its_last_checkpoint(copy, whole, left):
    """The end can be made again: summary and curve."""
    (copy / "learning_curve.png").unlink()
    (copy / "summary.json").unlink()
    if left != "nothing":
        (copy / "summary.json").write_text("" if left == "an empty summary" else '{"total_steps": 12')
    said = resume(copy)
    assert any("has come to its end" in line for line in said) and said[-1].startswith("learning curve: ")
    same(copy, whole)
    with pytest.raises(UserError, match="raise total_steps="):
        resume(copy)


def test_a_metrics_table_that_is_lost_after_the_last_checkpoint_leaves_a_summary(copy):
    """Without means, as there is nothing to make them of; commands that play with the policies need none."""
    for name in ("metrics.csv", "learning_curve.png", "summary.json"):
        (copy / name).unlink()
    said = resume(copy)
    step = checkpoint.steps(copy / "checkpoints")[-1]
    assert sum("lacks rows between env steps" in line for line in said) == 1
    assert "has no rows: there are no means" in said[-1]
    found = RunDirectory(copy).summary()
    assert found.pop("best_evaluation").keys() == {"0", "1"}  # the checkpoint has these
    assert found == {"total_steps": step, "diverged": {}, "last_tenth": {}}
    with pytest.raises(UserError, match="raise total_steps="):
        resume(copy)


def test_the_last_rows_that_are_lost_are_not_taken_from_before(copy):
    """The last tenth and the last evaluation are those of the run's end."""
    table = copy / "metrics.csv"
    table.write_bytes(b"".join(table.read_bytes().splitlines(keepends=True)[:-2]))
    (copy / "summary.json").unlink()
    assert any("lacks rows between env steps" in line for line in resume(copy))
    found = RunDirectory(copy).summary()
    assert found["total_steps"] == checkpoint.steps(copy / "checkpoints")[-1]
    assert "last_evaluation" not in found and found["last_tenth"] == {}


def test_an_older_checkpoint_sets_the_newer_ones_aside(copy, whole):
    """Killed right after it was resumed from an old checkpoint, a run continues from there, not from what it left."""
    first, second, *later = checkpoint.steps(copy / "checkpoints")
    (copy / "summary.json").unlink()

    def kill(state, step):
        raise KeyboardInterrupt

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(checkpoint, "save", lambda *args, **kwargs: kill(*args[2:4]))
        with pytest.raises(KeyboardInterrupt):
            resume(copy, step=first)
    assert checkpoint.steps(copy / "checkpoints") == [first]
    said = resume(copy)
    assert f"resumed from the checkpoint of env step {first:,}" in said
    same(copy, whole)
    assert not list((copy / "checkpoints").glob("*set_aside"))


@pytest.mark.parametrize("there", [True, False])
def test_a_checkpoint_that_is_a_link_is_set_aside_and_what_it_leads_to_stays(copy, whole, there):
    """On another disk, say, which may be there or not. The link itself is removed with the next checkpoint."""
    *_, before, last = checkpoint.steps(copy / "checkpoints")
    place, elsewhere = copy / "checkpoints" / str(last), copy.parent / "elsewhere"
    place.rename(elsewhere)
    place.symlink_to(elsewhere)
    if not there:
        shutil.rmtree(elsewhere)
    kept = {path: path.read_bytes() for path in elsewhere.rglob("*") if path.is_file()}
    (copy / "summary.json").unlink()
    assert f"resumed from the checkpoint of env step {before:,}" in resume(copy, step=before)
    same(copy, whole)
    assert {path: path.read_bytes() for path in elsewhere.rglob("*") if path.is_file()} == kept
    assert all(path.is_dir() and not path.is_symlink() for path in (copy / "checkpoints").iterdir())


DAMAGES = {
    "emptied": lambda data: b"",
    "deleted": None,
    "zeros at the end": lambda data: data + b"\0" * 100,
    "a blank line": lambda data: data + b"\r\n",
    "torn within a number": lambda data: data[: data.rfind(b"\n", 0, -2) + 3],
    "a digit changed": lambda data: re.sub(
        rb"\d(?=\r\n)", lambda digit: b"8" if digit[0] == b"7" else b"7", data, count=3
    ),
    "rows missing": lambda data: b"".join(line for k, line in enumerate(data.splitlines(keepends=True)) if k != 3),
}


@pytest.mark.parametrize("name", DAMAGES)
def test_a_damaged_metrics_table_leads_on_and_is_named(copy, whole, name):
    back_to(copy, checkpoint.steps(copy / "checkpoints")[1])
    table = copy / "metrics.csv"
    if DAMAGES[name] is None:
        table.unlink()
    else:
        table.write_bytes(DAMAGES[name](table.read_bytes()))
    said = resume(copy)
    notes = [line for line in said if line.startswith("note: ")]
    lost = [line for line in notes if "lacks rows between" in line]
    assert bool(lost) == (name in ("emptied", "deleted", "rows missing"))
    assert any("damaged line" in line for line in notes) == (
        name in ("zeros at the end", "a blank line", "torn within a number")
    )
    changed = any("are not those that the checkpoint knows" in line for line in notes)
    assert changed == (name == "a digit changed")
    if not lost and not changed:
        same(copy, whole)
    assert RunDirectory(copy).summary() is not None


def test_any_missing_file_of_a_checkpoint_is_named(copy):
    """Each file alone, and each folder of an array."""
    *_, before, last = checkpoint.steps(copy / "checkpoints")
    folder = copy / "checkpoints" / str(last)
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    parts = {path.relative_to(folder).parts[0] for path in files}
    assert parts == {"state", "replay", "best", "metrics.json", "checksums.json"} and len(files) > 10
    assert {path.name for path in files} >= {"_METADATA", "manifest.ocdbt", "checksums.json"}
    aside = copy / "aside"
    for path in [*files, folder / "state", folder / "replay" / "0", folder / "best"]:
        path.rename(aside)
        with pytest.raises(UserError) as error:
            resume(copy, total_steps=2000)
        aside.rename(path)
        named = path.relative_to(folder)
        assert f"{folder} is damaged ({named}" in str(error.value) and "is missing)" in str(error.value), named
        assert f"checkpoint={before}" in str(error.value)
    assert checkpoint.verify(copy / "checkpoints", last).name == str(last)


def test_a_second_process_is_refused(copy):
    back_to(copy, checkpoint.steps(copy / "checkpoints")[1])
    before = {p: p.read_bytes() for p in copy.rglob("*") if p.is_file()}
    hold = f"import pathlib, time; from matd3_jax.runs import lock\nwith lock.held(pathlib.Path({str(copy)!r})):\n"
    hold += " print('held', flush=True); time.sleep(60)"
    other = subprocess.Popen([sys.executable, "-c", hold], stdout=subprocess.PIPE, text=True)
    try:
        assert other.stdout.readline() == "held\n"
        with pytest.raises(UserError, match=f"is in use: process {other.pid}"):
            resume(copy)
    finally:
        other.kill()
        other.wait()
    assert {p: p.read_bytes() for p in copy.rglob("*") if p.is_file() and p.name != lock.NAME} == {
        p: data for p, data in before.items() if p.name != lock.NAME
    }
    resume(copy)


def test_checkpoints_come_by_time_but_take_a_twentieth_of_it_at_most(tmp_path, monkeypatch):
    """A clock that every interval advances by a minute, and every checkpoint by `cost` minutes."""
    from matd3_jax.training import run as module
    from matd3_jax.training.session import TrainingSession

    settings = config.load([*SMALL, "checkpoint_every=0", "checkpoint_minutes=3", "log_every=20", "eval_every=0"])
    saved = {}
    for cost in (0.0, 0.5):
        now = [0.0]
        monkeypatch.setattr(module.time, "monotonic", lambda now=now: now[0])
        training = TrainingSession(settings)
        advance = training.advance

        def one_minute(state, now=now, advance=advance):
            now[0] += 60
            return advance(state)

        monkeypatch.setattr(training, "advance", one_minute)
        steps = []

        def save(state, step, now=now, steps=steps, cost=cost):
            now[0] += 60 * cost
            steps.append(step)

        state, row = training.start()
        module.run(training, state, row, save=save, save_first=True)
        saved[cost] = np.diff(steps) / (training.iterations_per_interval * training.trainer.iteration_steps)
        assert steps[0] == training.trainer.schedule.warmup_steps
    assert set(saved[0.0]) == {3} and len(saved[0.0]) >= 5
    assert set(saved[0.5]) == {10}  # twenty times half a minute


INNER = PointReach()


@dataclasses.dataclass(frozen=True)
class Empty(Environment):
    """A task whose state has an array without numbers."""

    agents = INNER.agents
    observation_sizes = INNER.observation_sizes
    action_spaces = INNER.action_spaces
    episode_length = INNER.episode_length

    def reset(self, key):
        state, seen = INNER.reset(key)
        return (state, jnp.zeros((0, 2))), seen

    def step(self, key, state, action):
        after = INNER.step(key, state[0], action)
        return after._replace(state=(after.state, state[1]))

    def observe(self, state):
        return INNER.observe(state[0])


def test_from_python_with_an_environment_of_ones_own_whose_state_has_an_empty_array(tmp_path):
    """The directory is the command's; resumed it gives the unbroken run's numbers."""
    small = dict(text.split("=") for text in SMALL if not text.startswith(("env=", "algo", "total_steps")))
    options = {**small, "algo": "iddpg", "env": Empty()}
    broken, whole = tmp_path / "broken", tmp_path / "whole"
    train = functools.partial(matd3_jax.train, "algo.hidden=[8]", total_steps=1200, **options)

    def interrupt(row):
        if row["step"][0] > 1000:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(run_dir=broken, callback=interrupt)
    with pytest.raises(UserError, match="is there already"):
        train(run_dir=broken)
    rows = []
    resumed = matd3_jax.resume(broken, env=Empty(), callback=rows.append)
    unbroken = train(run_dir=whole)
    same(broken, whole)
    assert resumed.run_dir == broken and 0 < len(rows) < resumed.metrics["step"].shape[1]
    assert resumed.metrics.keys() == unbroken.metrics.keys()
    for name, column in unbroken.metrics.items():
        np.testing.assert_array_equal(resumed.metrics[name], column, err_msg=name)
    longer = matd3_jax.resume(broken, total_steps=1300, env=Empty())
    assert longer.metrics["step"][0, -1] >= 1300
    assert longer.evaluate(episodes=2).shape == (2, 2, 2)


def test_a_signal_is_noted_while_something_is_printed(monkeypatch):
    """The handler itself prints nothing: it may run in the middle of a print."""
    from matd3_jax.runtime import signals

    noted = threading.Event()
    monkeypatch.setattr(signals, "note", lambda line: noted.set())
    before = {name: signal.getsignal(getattr(signal, name)) for name in signals.NAMES}
    try:
        stop = signals.Stop()
        main = threading.current_thread()
        printed = []
        monkeypatch.setattr(signals, "note", lambda line: (printed.append(threading.current_thread()), noted.set()))
        signal.raise_signal(signal.SIGHUP)
        assert stop.signal == signal.SIGHUP
        assert noted.wait(10) and printed[0] is not main
        with pytest.raises(SystemExit) as ended:
            signal.raise_signal(signal.SIGTERM)
        assert ended.value.code == 128 + signal.SIGTERM
    finally:
        for name, handler in before.items():
            signal.signal(getattr(signal, name), handler)


def test_a_checkpoint_that_was_whole_when_the_process_was_killed_gets_its_name(copy, whole):
    """Killed before the rename; what is not whole is deleted."""
    *_, last = checkpoint.steps(copy / "checkpoints")
    (copy / "summary.json").unlink()
    place = copy / "checkpoints"
    (place / str(last)).rename(place / f".{last}.partial")
    shutil.copytree(place / f".{last}.partial", place / ".9999.partial")
    (place / ".9999.partial" / "checksums.json").unlink()
    said = resume(copy)
    assert any("has come to its end" in line for line in said)
    assert not list(place.glob(".*"))
    same(copy, whole)


def test_a_checkpoint_that_is_written_again_is_there_until_its_successor_is(copy, whole, monkeypatch):
    """Killed between the two names, the run has one of them."""
    back_to(copy, checkpoint.steps(copy / "checkpoints")[1])
    place, rename = copy / "checkpoints", type(copy).rename
    kept = checkpoint.steps(place)[-1]

    class Killed(BaseException):
        pass

    def killing(path, target):
        if path.name == f".{kept}.partial":
            raise Killed
        return rename(path, target)

    training = TrainingSession(config.load(SMALL))
    state = checkpoint.restore(checkpoint.verify(place), training.trainer)
    monkeypatch.setattr(type(copy), "rename", killing)
    with pytest.raises(Killed):
        checkpoint.save(place, kept, training.trainer, state, 9)
    monkeypatch.setattr(type(copy), "rename", rename)
    assert f"resumed from the checkpoint of env step {kept:,}" in resume(copy)
    same(copy, whole)
