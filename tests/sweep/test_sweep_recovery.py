"""Sweeps that were killed while they were planned, whose files name other places, and what finished batches leave."""

import json
import shutil
from pathlib import Path

import pytest

from matd3_jax import config
from matd3_jax.cli import command, sweep
from matd3_jax.errors import UserError
from matd3_jax.runs import lock
from matd3_jax.runs.directory import RunDirectory
from matd3_jax.runtime import files
from matd3_jax.sweep import runner
from matd3_jax.sweep.runner import Sweep
from matd3_jax.training import checkpoint
from matd3_jax.training.recording import Recorder

pytestmark = pytest.mark.slow

TINY = [
    "env=point_reach", "algo=iddpg", "algo.hidden=[4]", "batch_size=8", "num_envs=2", "learning_starts=100",
    "replay_capacity=200", "total_steps=200", "log_every=50", "eval_every=0",
]  # fmt: skip
SWEPT = [*TINY, "algo.lr=0.01,0.1"]


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("sweeps")
    assert sweep.main([*SWEPT, f"out={out}", "name=whole"]) == 0
    return out / "whole"


@pytest.fixture
def copy(trained, tmp_path):
    return shutil.copytree(trained, tmp_path / "copy")


def contents(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


class Killed(BaseException):
    """Stands for a SIGKILL."""


@pytest.mark.parametrize("made", range(6))
def test_killed_while_it_plans_it_can_be_started_again(tmp_path, monkeypatch, made):
    """After any number of the files that a plan is made of: two of each run, the batches, the sweep's facts."""
    out = ["train=false", f"out={tmp_path}", "name=sweep"]
    written, write = [], files.write_text

    def killing(path, text):
        if len(written) == made:
            raise Killed
        written.append(path)
        write(path, text)

    monkeypatch.setattr(files, "write_text", killing)
    with pytest.raises(Killed):
        sweep.main([*SWEPT, *out])
    monkeypatch.setattr(files, "write_text", write)
    with pytest.raises(UserError, match="planning was cut short; start the sweep again"):
        sweep.main([f"resume={tmp_path / 'sweep'}"])
    other = [*TINY, "algo.tau=0.1,0.2,0.3"]  # other settings than at first, too
    assert sweep.main([*other, *out]) == 0
    names = sorted(path.name for path in (tmp_path / "sweep" / "runs").iterdir())
    assert names == ["tau_0.1", "tau_0.2", "tau_0.3"] == sorted(sum(Sweep(tmp_path / "sweep").batches, []))
    with pytest.raises(UserError, match="is there already"):
        sweep.main([*other, *out])


def test_from_python_runs_without_a_batch_are_planned_again(tmp_path, monkeypatch):
    settings = {name: config.load([*TINY, f"algo.lr={name}"]) for name in ("0.01", "0.1")}
    create, made = RunDirectory.create, []

    def killing(path, *more, **others):
        if made:
            raise Killed
        made.append(create(path, *more, **others))

    monkeypatch.setattr(RunDirectory, "create", killing)
    with pytest.raises(Killed):
        runner.train(settings, tmp_path)
    monkeypatch.undo()
    runs = runner.train(settings, tmp_path)
    assert all(RunDirectory(path).summary() is not None for paths in runs.values() for path in paths)


def test_a_directory_with_anything_else_in_it_is_no_unfinished_plan(tmp_path):
    for name in ("notes.txt", "runs/lr_0.01/metrics.csv"):
        folder = tmp_path / name.replace("/", "_")
        (folder / name).parent.mkdir(parents=True)
        (folder / name).write_text("mine")
        with pytest.raises(UserError, match="is there already"):
            sweep.main([*SWEPT, "train=false", f"out={tmp_path}", f"name={folder.name}"])
        assert (folder / name).read_text() == "mine"


def test_what_cannot_be_planned_leaves_nothing(tmp_path):
    with pytest.raises(UserError):
        sweep.main([*SWEPT, "memory=1e-9", f"out={tmp_path / 'new'}", "name=sweep"])
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "plan",
    [[["../../other"]], [[".."]], [["/tmp"]], [[""]], [["a/b"]], [["a\\b"]], [["a\0b"]], [[3]], [[]], {"a": 1}, "[["],
)
def test_names_that_lead_elsewhere_are_refused_and_nothing_is_changed(copy, plan):
    other = shutil.copytree(copy / "runs" / "lr_0.01", copy.parent.parent / copy.parent.name / "other")
    (other / "summary.json").unlink()
    (copy / "batches.json").write_text(plan if isinstance(plan, str) else json.dumps(plan))
    before = contents(copy.parent)
    with pytest.raises(UserError, match=r"batches\.json"):
        sweep.main([f"resume={copy}"])
    assert contents(copy.parent) == before


@pytest.mark.parametrize("link", ["runs", "runs/lr_0.01", "batches", "batches/0"])
def test_links_that_lead_elsewhere_are_refused_and_nothing_is_changed(copy, link):
    (copy / "runs" / "lr_0.01" / "summary.json").unlink()
    (copy / "batches" / "0").mkdir(exist_ok=True)
    (copy / "batches" / "0" / "kept").write_text("mine")
    (copy / link).rename(copy.parent / "elsewhere")
    (copy / link).symlink_to(copy.parent / "elsewhere")
    before = contents(copy.parent / "elsewhere")
    with pytest.raises(UserError, match="leads out of"):
        sweep.main([f"resume={copy}"])
    assert contents(copy.parent / "elsewhere") == before


def test_a_run_that_has_not_ended_is_resumed_by_its_sweep(copy, capsys):
    """`train resume=` refuses it, and names the sweep's command; once it has its end it is a run like others."""
    run = copy / "runs" / "lr_0.01"
    shutil.rmtree(run / "checkpoints")
    (run / "summary.json").unlink()
    before = contents(copy)
    for name, argument in (("train", f"resume={run}"), ("check", f"run={run}")):
        code = command.code(lambda argv, name=name: command.start(name, argv), [argument])
        said = capsys.readouterr()
        line = [line for line in (said.out + said.err).splitlines() if "resume" in line and "sweep" in line][-1]
        assert code == (2 if name == "train" else 0)
        assert line.endswith(f"python -m matd3_jax.sweep resume={copy}"), line
    assert contents(copy) == before
    other = copy / "runs" / "lr_0.1"
    with pytest.raises(UserError, match="raise total_steps="):
        Recorder().resume(other)


def test_what_a_finished_batch_needed_is_deleted_at_the_next_start(copy):
    left = copy / "batches" / "0" / "checkpoints" / "200" / "replay"
    left.mkdir(parents=True)
    assert sweep.main([f"resume={copy}"]) == 0
    assert not list((copy / "batches").iterdir())


def test_a_batch_has_a_checkpoint_right_after_the_warm_up(tmp_path, monkeypatch):
    saved, save = [], checkpoint.save

    def noted(folder, step, *more, **given):
        saved.append(step)
        return save(folder, step, *more, **given)

    monkeypatch.setattr(checkpoint, "save", noted)
    assert sweep.main([*SWEPT, f"out={tmp_path}", "name=sweep"]) == 0
    assert saved[0] == int(RunDirectory(tmp_path / "sweep" / "runs" / "lr_0.01").read_metrics()["step"][0])


def test_a_batch_that_another_process_trains_is_skipped(copy, capsys):
    (copy / "runs" / "lr_0.01" / "summary.json").unlink()
    place = Sweep(copy).folder_of(0)
    place.mkdir(parents=True)
    with lock.held(place):
        assert sweep.main([f"resume={copy}"]) == 1
    assert "batch 0: another process trains it, skipped" in capsys.readouterr().out


def test_on_a_system_without_fcntl(tmp_path, monkeypatch):
    monkeypatch.setattr(lock, "fcntl", None)
    assert sweep.main([*SWEPT, f"out={tmp_path}", "name=sweep"]) == 0
    assert not list(tmp_path.rglob(lock.NAME))
