"""Files are replaced whole or not at all, whatever happens while they are written."""

import json
import os
import subprocess
import sys

import pytest

from matd3_jax.errors import UserError
from matd3_jax.runtime import files


def listing(folder):
    return sorted(path.name for path in folder.iterdir())


def test_a_failure_while_writing_leaves_the_old_file_and_nothing_else(tmp_path):
    path = tmp_path / "summary.json"
    path.write_text("old")
    with pytest.raises(OSError, match="disk"), files.replacing(path) as new:
        new.write_text("half of the new")
        raise OSError("no space left on the disk")
    assert path.read_text() == "old" and listing(tmp_path) == ["summary.json"]


@pytest.mark.parametrize("call", ["fsync", "replace"])
def test_no_call_of_the_system_may_fail_half_way(tmp_path, monkeypatch, call):
    path = tmp_path / "config.yaml"
    path.write_text("old")

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, call, full)
    with pytest.raises(OSError, match="No space"):
        files.write_text(path, "new")
    assert path.read_text() == "old" and listing(tmp_path) == ["config.yaml"]


def test_a_kill_at_the_rename_leaves_the_old_file(tmp_path):
    path = tmp_path / "a.json"
    path.write_text("old")
    code = (
        "import os, pathlib, signal; from matd3_jax.runtime import files\n"
        "os.replace = lambda *_: os.kill(os.getpid(), signal.SIGKILL)\n"
        f"files.write_text(pathlib.Path({str(path)!r}), 'new')"
    )
    assert subprocess.run([sys.executable, "-c", code]).returncode == -9
    assert path.read_text() == "old"


def test_the_bytes_are_on_the_disk_before_the_name_is(tmp_path, monkeypatch):
    calls = []
    real_sync, real_replace = os.fsync, os.replace
    monkeypatch.setattr(os, "fsync", lambda handle: (calls.append("sync"), real_sync(handle)))
    monkeypatch.setattr(os, "replace", lambda *paths: (calls.append("rename"), real_replace(*paths)))
    files.write_text(tmp_path / "a.txt", "é")
    assert calls == ["sync", "rename", "sync"]  # the file, its name, its folder
    assert (tmp_path / "a.txt").read_bytes() == "é".encode()


def test_what_is_the_same_is_not_written(tmp_path):
    path = tmp_path / "a.txt"
    files.write_text(path, "same")
    before = path.stat()
    files.write_text(path, "same")
    assert (path.stat().st_mtime_ns, path.stat().st_ino) == (before.st_mtime_ns, before.st_ino)


def test_nothing_is_written_through_links(tmp_path):
    outside = tmp_path / "outside"
    outside.write_text("mine")
    run = tmp_path / "run"
    run.mkdir()
    (run / "config.yaml").symlink_to(outside)
    (run / "metrics.csv").symlink_to(outside)
    files.write_text(run / "config.yaml", "mine")  # the same content, but a link
    with pytest.raises(UserError, match=r"metrics\.csv is a link"):
        files.append(run / "metrics.csv", b"row")
    assert outside.read_text() == "mine" and not (run / "config.yaml").is_symlink()


def test_appending_is_whole_or_not_at_all(tmp_path, monkeypatch):
    """A disk that takes three bytes and is full then."""
    path, real = tmp_path / "metrics.csv", os.write
    files.append(path, b"step,seed\n")
    left = [3]

    def few(file, data):
        if not left[0]:
            raise OSError(28, "No space left on device")
        taken = real(file, data[: left[0]])
        left[0] -= taken
        return taken

    monkeypatch.setattr(os, "write", few)
    with pytest.raises(OSError, match="No space"):
        files.append(path, b"100,0\n")
    assert path.read_text() == "step,seed\n"
    left[0] = 1000
    files.append(path, b"100,0\n")
    assert path.read_text() == "step,seed\n100,0\n"


def test_json_has_null_for_what_is_no_number(tmp_path):
    files.write_json(tmp_path / "a.json", {"x": [1.5, float("nan"), (float("inf"), None)], "y": {"z": -float("inf")}})

    def refuse(name):
        raise AssertionError(name)

    found = json.loads((tmp_path / "a.json").read_text(), parse_constant=refuse)
    assert found == {"x": [1.5, None, [None, None]], "y": {"z": None}}
