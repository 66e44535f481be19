"""The tutorials, run from an empty folder as they stand there but shorter, and the notebook.

Blocks of `sh` are commands, or with `#!` a script; scripts, `python` and `yaml` blocks are files, whose name they begin
with; `diff` blocks change them; `text` is what was seen.
"""

import os
import re
import runpy
import shlex
import shutil
import stat
import subprocess
import sys
from pathlib import Path

import pytest
from documents import ROOT, apply_diff, blocks

from matd3_jax.cli import command

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore::DeprecationWarning")]

FOLDER = ROOT / "docs" / "tutorials"
TINY = "learning_starts=400 batch_size=16 'algo.hidden=[8]' eval_episodes=2"
SHORTER = {
    "first_run": [("total_steps=300000", f"total_steps=1000 {TINY}"), ("total_steps=450000", "total_steps=1200")],
    "own_environment": [
        ("total_steps=40_000, learning_starts=2_000", "total_steps=1_500, learning_starts=500"),
        ("episodes=100", "episodes=2"),
    ],
    "own_algorithm": [("total_steps=20000 learning_starts=2000 batch_size=128", f"total_steps=1000 {TINY}")],
    "slurm_sweep": [("total_steps=30000 learning_starts=5000 batch_size=256", f"total_steps=1000 {TINY}")],
    "robot_to_policy": [
        ("total_steps=40000", f"total_steps=1000 env.episode_length=50 {TINY}"),
        ("episodes=20", "episodes=2"),
    ],
}
"""(as written, as run) of each tutorial."""


def shorter(name, code):
    for written, run in SHORTER[name]:
        code = code.replace(written, run)
    return code


class Reader:
    """Somebody who follows a tutorial: types its commands and writes its files, in the folder they are in."""

    def __init__(self, name):
        self.name, self.path = name, FOLDER / f"{name}.md"
        self.replaced = {written for written, _ in SHORTER[name] if written in self.path.read_text()}
        assert len(self.replaced) == len(SHORTER[name]), "a tutorial has other sizes than the test makes smaller"

    def follow(self):
        for block in blocks(self.path):
            code = shorter(self.name, block.code)
            if block.language == "sh" and not code.startswith("#!"):
                for line in code.splitlines():
                    self.type(line)
            elif block.language != "text":
                self.write(block.language, code)

    def type(self, line):
        """A line as a shell would take it; our commands and Python files in this process, which is quicker."""
        words = shlex.split(line, comments=True)
        if words[:2] == ["python", "-m"] and words[2].startswith("matd3_jax."):
            assert command.code(lambda argv: command.start(words[2].split(".")[1], argv), words[3:]) == 0, line
        elif words[:1] == ["python"]:
            self.run_file(words[1:])
        elif words[:1] == ["cd"]:
            os.chdir(words[1])
        else:
            subprocess.run(["bash", "-e", "-c", line], check=True)

    def run_file(self, words):
        before = {*sys.modules}, [*sys.argv], [*sys.path]
        sys.argv, sys.path = words, [os.getcwd(), *sys.path]
        try:
            runpy.run_path(words[0], run_name="__main__")
        finally:
            for module in {*sys.modules} - before[0]:
                if str(getattr(sys.modules[module], "__file__", "")).startswith(os.getcwd()):
                    del sys.modules[module]
            sys.argv, sys.path = before[1:]

    def write(self, language, code):
        if language == "diff":
            apply_diff(code, Path())
            return
        first = next(line for line in code.splitlines() if not line.startswith("#!"))
        name = re.fullmatch(r"# (\S+\.\w+)", first)
        assert name, f"{self.path}: {first}: files begin with their name"
        Path(name[1]).write_text(code)


@pytest.fixture
def read(tmp_path, monkeypatch):
    """Follow a tutorial in an empty folder: the folder."""
    monkeypatch.chdir(tmp_path)

    def follow(name):
        Reader(name).follow()
        return tmp_path

    return follow


def test_there_are_these():
    assert {path.stem for path in FOLDER.glob("*.md")} == {*SHORTER, "index"}


def test_first_run(read):
    folder = read("first_run")
    assert (folder / "runs" / "first" / "episode.gif").read_bytes()[:6] == b"GIF89a"
    assert (folder / "first.html").is_file()


def test_own_environment(read, capsys):
    folder = read("own_environment")
    assert (folder / "matd3.gif").read_bytes()[:6] == b"GIF89a" and (folder / "curves.png").is_file()
    said = capsys.readouterr().out
    assert "reward" in said.splitlines()[0] and "keeps the contract" in said and "iddpg: balls land" in said


def test_robot_to_policy(read, capsys):
    folder = read("robot_to_policy")
    assert {"policies.npz", "read_policies.py", "policies.json"} <= {path.name for path in folder.glob("policies/*")}
    assert re.search(r"returns: \[", capsys.readouterr().out)
    alone = "import sys; sys.modules['jax'] = sys.modules['matd3_jax'] = None; sys.argv = ['drive.py']; "
    alone += "import runpy; runpy.run_path('drive.py')"
    subprocess.run([sys.executable, "-c", alone], cwd=folder, check=True)  # with NumPy and gymnasium alone


@pytest.fixture
def cluster(tmp_path_factory, monkeypatch):
    """A `sbatch` that runs the tasks of an array one after the other, and the `python` of these tests."""
    folder = tmp_path_factory.mktemp("bin")
    programs = {
        "python": f'exec {shlex.quote(sys.executable)} "$@"',
        "sbatch": r"""
last=$(sed -n 's/^#SBATCH --array=0-\([0-9]*\)$/\1/p' "${@: -1}")
for task in $(seq 0 "$last"); do
  SLURM_JOB_ID=4711 SLURM_ARRAY_JOB_ID=4711 SLURM_ARRAY_TASK_ID=$task SLURM_NTASKS=1 bash "${@: -1}"
  [ $? -eq 0 ] || exit 1
done
""",
    }
    for name, code in programs.items():
        (folder / name).write_text(f"#!/bin/bash\n{code}\n")
        (folder / name).chmod(0o700 | stat.S_IXUSR)
    monkeypatch.setenv("PATH", f"{folder}:{os.environ['PATH']}")


def test_slurm_sweep(read, cluster, capsys):
    folder = read("slurm_sweep")
    said = capsys.readouterr().out
    assert (folder / "runs" / "grid" / "table.csv").is_file() and (folder / "runs" / "grid" / "sweep.png").is_file()
    assert len([*(folder / "runs" / "grid" / "runs").iterdir()]) == 4
    batches = re.search(r"(\d+) batches", (FOLDER / "slurm_sweep.md").read_text())
    assert batches and "--array=0-1" in (folder / "job.sh").read_text() and batches[1] == "2", said


def test_own_algorithm(read, tmp_path, monkeypatch):
    """With a copy of the package in place of a clone, in processes that import it."""
    shutil.copytree(
        ROOT / "src" / "matd3_jax", tmp_path / "src" / "matd3_jax", ignore=shutil.ignore_patterns("__pycache__")
    )
    monkeypatch.setattr(Reader, "type", lambda self, line: run_copy(line, tmp_path))
    folder = read("own_algorithm")
    assert len([*(folder / "runs" / "compared" / "runs").iterdir()]) == 3


def run_copy(line, folder):
    words = shlex.split(line, comments=True)
    if words[:1] == ["python"]:
        env = {**os.environ, "PYTHONPATH": str(folder / "src")}
        subprocess.run([sys.executable, *words[1:]], env=env, check=True)
