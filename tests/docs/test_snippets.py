"""Code in README.md and docs/: Python runs, and commands name modules and options that there are.

The blocks of docs/extending.md are run in test_extending.py, those of docs/tutorials in test_tutorials.py.
"""

import ast
import dataclasses
import fnmatch
import importlib
import importlib.util
import re
import shlex
import typing
from pathlib import Path

import numpy as np
import pytest
from documents import DOCUMENTS, blocks

from experiments import all as all_studies
from experiments import study
from matd3_jax import config
from matd3_jax.cli import catalog, sweep

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")

OPTIONAL = ("jaxmarl", "mujoco_playground")
"""Packages of extras that tests do without."""

PLACEHOLDER = re.compile(r"[A-Z][A-Z_,]*(/[\w.]+)?|\$\w+|value")
"""A value that stands for the reader's own."""


def commands(path):
    """(module, arguments) of every `python -m` in blocks and in the text. "[key=value ...]" is read without its
    brackets."""
    code = [block.code for block in blocks(path) if block.language == "sh"]
    text = re.sub(r"```.*?```", "", path.read_text(), flags=re.DOTALL)
    inline = [" ".join(found.split()) for found in re.findall(r"`((?:[^`\n]|\n(?!\n))+?)`", text)]
    inline = [re.sub(r"(?<= )\[(\S+=\S+?)(?: \.\.\.)?\]", r"\1", found) for found in inline]
    for line in "\n".join(code).splitlines() + inline:
        for part in re.split(r"&&|&$", line.strip()):
            words = shlex.split(part, comments=True)
            if "-m" in words and any(word.endswith("python") for word in words[: words.index("-m")]):
                module, *arguments = words[words.index("-m") + 1 :]
                if not PLACEHOLDER.fullmatch(module.split(".")[-1]):
                    yield module, arguments


COMMANDS = sorted(
    {
        (name, module, *arguments)
        for name, path in DOCUMENTS.items()
        if name != "docs/tutorials/own_algorithm.md"  # whose algorithms are its own
        for module, arguments in commands(path)
    }
)


def test_there_are_commands_of_every_kind():
    found = {module for _, module, *_ in COMMANDS}
    assert len(COMMANDS) > 40
    assert {"matd3_jax." + name for name in ("train", "sweep", "evaluate", "render", "plot", "crossplay")} < found


@pytest.mark.slow
@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_command(command):
    """The module is there; the settings can be read, and have values that a run could have."""
    _, name, *arguments = command
    if name in ("pytest", "venv"):
        return
    spec = importlib.util.find_spec(name)
    assert spec is not None
    inner = f"{name}.__main__" if spec.submodule_search_locations else name
    assert importlib.util.find_spec(inner) is not None
    given = [word for word in arguments if word not in ("key=value", "...", "--help", "--cfg")]
    assert all("=" in word for word in given), given
    if not given:
        return
    short = name.split(".")[-1]
    module = importlib.import_module(f"matd3_jax.cli.{short}" if name.startswith("matd3_jax.") else inner)
    if name == "tests.torture":
        config.load([word for word in given if word.split("=")[0] not in ("minutes", "seed")])
        return
    is_study = isinstance(getattr(module, "STUDY", None), study.Study)
    ours = catalog.COMMANDS.get(short) if name.startswith("matd3_jax.") else None
    command = ours or (module.STUDY.command if is_study else module.COMMAND)
    options = command.parse(list(filter(None, (concrete(word, command) for word in given))))
    fields = dataclasses.fields(options)
    others = {field.name: getattr(options, field.name) for field in fields if "others" in field.metadata}
    settings = [text for texts in others.values() for text in texts if not text.startswith("launcher.")]
    if is_study:
        lines = module.STUDY.settings(options.scale, options)
        assert fnmatch.filter(lines, options.only or "*"), f"only={options.only}: none of {list(lines)}"
        config.load([*next(iter(lines.values())), *settings])
    elif name == "experiments.all":
        study.parse(all_studies.STUDIES["cooperative"], settings)
    elif getattr(options, "resume", None) is not None:
        assert {word.split("=")[0] for word in settings} <= {"total_steps", "env.pickle"}
    elif name in ("matd3_jax.sweep", "benchmarks.sweep"):
        assert sweep.read(settings, getattr(options, "samples", None), 0)[1] or not settings
    else:
        config.load(settings, command.keys)


def concrete(word, command):
    """A word with a value that stands for the reader's own made one that can be read; "" where it cannot."""
    key, value = word.split("=", 1)
    if key.endswith((".policy", ".frozen")):  # read from a run directory that has to be there
        return ""
    if key == "checkpoint" and PLACEHOLDER.fullmatch(value):
        return "checkpoint=last"
    if key == "runs":
        return "runs=a,b" if command is catalog.PLOT else "runs=a"
    if not PLACEHOLDER.fullmatch(value):
        return word
    field = {field.name: field for field in dataclasses.fields(command.options)}.get(key)
    hints = typing.get_type_hints(command.options)
    textual = field is not None and any(kind in (str, Path) for kind in (hints[key], *typing.get_args(hints[key])))
    return f"{key}={Path(value).name}" if textual else ""


@pytest.mark.parametrize("name", DOCUMENTS)
def test_python_parses(name):
    for block in blocks(DOCUMENTS[name]):
        if block.language == "python":
            ast.parse(block.code, f"{name}:{block.line}")
        assert block.language in ("python", "sh", "diff", "yaml", "text"), f"{name}:{block.line}: {block.language!r}"


def missing(code):
    """Whether a block imports a package of an extra that is not installed."""
    names = {alias.name.split(".")[0] for node in ast.walk(ast.parse(code)) for alias in getattr(node, "names", ())}
    return any(name in OPTIONAL and importlib.util.find_spec(name) is None for name in names)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["README.md", "docs/environments.md", "docs/interop.md", "docs/running.md", "docs/sweeps.md"]
)
def test_python_runs(name, tmp_path, monkeypatch):
    """Blocks of a document share their names. Trainings are shorter than they are written."""
    monkeypatch.chdir(tmp_path)
    names = {"__name__": "snippet"}
    for block in blocks(DOCUMENTS[name]):
        if block.language == "python" and not missing(block.code):
            code = block.code.replace("total_steps=100_000", "total_steps=5_000, learning_starts=1_000, num_envs=20")
            exec(compile("\n" * (block.line - 1) + code, name, "exec"), names)
    if name == "README.md":
        assert np.isfinite(names["result"].metrics["return_agents"]).all()
        assert names["result"].evaluate(episodes=2).shape == (4, 2, 3)
    if name == "docs/sweeps.md":
        assert all(len(run) == 1 and (run[0] / "metrics.csv").exists() for run in names["runs"].values())
