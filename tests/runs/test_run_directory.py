"""Run directories have a format, know what a killed write left, and are not written through links."""

import json
import os
import time

import pytest

from matd3_jax import config
from matd3_jax.cli import command
from matd3_jax.errors import UserError
from matd3_jax.runs.directory import FORMAT, RunDirectory
from matd3_jax.runs.paths import is_name
from matd3_jax.runtime import files

SMALL = ["env=point_reach", "total_steps=400", "learning_starts=100", "replay_capacity=400", "batch_size=8"]


@pytest.fixture
def run(tmp_path):
    return RunDirectory.create(tmp_path / "run", config.load(SMALL), {"versions": {}})


def test_a_new_directory_has_the_format_of_this_version(run):
    assert json.loads((run.path / "machine.json").read_text())["format"] == FORMAT == run.format == 1


@pytest.mark.parametrize("written", ['{"versions": {}}', "", "[1]", '{"format": "x"}', None])
def test_without_a_format_it_is_read_as_before(run, written):
    machine = run.path / "machine.json"
    machine.unlink() if written is None else machine.write_text(written)
    opened, settings = RunDirectory.open(run.path)
    assert opened.format == 0 and settings == config.load(SMALL)


@pytest.mark.parametrize(
    "name, key",
    [
        ("train", "resume"),
        ("evaluate", "run"),
        ("render", "run"),
        ("plot", "runs"),
        ("crossplay", "runs"),
        ("check", "run"),
    ],
)
def test_every_command_refuses_a_newer_format_in_one_line(run, name, key, tmp_path):
    files.write_json(run.path / "machine.json", {"format": FORMAT + 1})
    before = {path: path.read_bytes() for path in run.path.iterdir()}
    out = {"crossplay": [f"out={tmp_path / 'out'}"], "plot": [f"out={tmp_path / 'plot.png'}"]}
    with pytest.raises(UserError, match=f"has the format {FORMAT + 1} of run directories, this version") as found:
        command.start(name, [f"{key}={run.path}", *out.get(name, [])])
    assert "\n" not in str(found.value)
    assert {path: path.read_bytes() for path in run.path.iterdir()} == before


def test_what_killed_writes_left_is_removed_and_nothing_else(run, tmp_path):
    left = [".config.123.partial.yaml", ".learning_curve.9.partial.png", ".lock.1.partial"]
    kept = [".config.partial.yaml", ".hidden", "a.1.partial", ".config.x.partial.yaml"]
    elsewhere = tmp_path / "elsewhere"
    for folder, names in ((run.path, left + kept), (run.path / ".run.12.partial", ["a"]), (elsewhere, ["a"])):
        folder.mkdir(exist_ok=True)
        for name in names:
            (folder / name).write_text("")
    (run.path / ".run.13.partial").symlink_to(elsewhere)
    assert [path.name for path in files.partial(run.path)] == sorted([*left, ".run.12.partial", ".run.13.partial"])
    run.clean()
    assert {path.name for path in run.path.iterdir()} == {*kept, "config.yaml", "machine.json"}
    assert (elsewhere / "a").exists()


def test_a_new_run_removes_those_that_a_kill_kept_from_their_names(tmp_path):
    """None that may still be made, and nothing else."""
    names = {".run.12.partial": 2, ".run.13.partial": 0, ".film.12.partial": 2, "run.12.partial": 2}  # age, days
    for name, days in names.items():
        (tmp_path / name).mkdir()
        (tmp_path / name / "config.yaml").write_text("")
        then = time.time() - days * 24 * 60 * 60 - 60
        os.utime(tmp_path / name, (then, then))
    RunDirectory.create(tmp_path / "new", config.load(), {})
    assert {path.name for path in tmp_path.iterdir()} == {*names, "new"} - {".run.12.partial"}


@pytest.mark.parametrize("name", ["metrics.csv", "checkpoints", "tensorboard", "videos", "wandb"])
def test_links_are_not_written_through(run, name, tmp_path):
    (run.path / name).symlink_to(tmp_path / "elsewhere")
    with pytest.raises(UserError, match="is a link: nothing is written through it"):
        run.clean()


def test_names_are_one_part_of_a_path():
    assert all(map(is_name, ["a", "lr_0.1", "...", "é", "a b"]))
    assert not any(map(is_name, ["", ".", "..", "a/", "/a", "a/b", "a\\b", "a\0", None, 3, ["a"]]))


@pytest.mark.parametrize("text", ["", "env: [", "[]", "a: b: c", "env:\n  name: x\n  epi", "\0"])
def test_settings_that_cannot_be_read_are_refused_in_one_line(run, text):
    (run.path / "config.yaml").write_text(text)
    with pytest.raises(UserError, match="cannot read the configuration") as found:
        RunDirectory.open(run.path)
    assert "\n" not in str(found.value)
