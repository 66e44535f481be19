"""Code in README.md and docs/: Python runs, and commands name modules and options that there are.

The blocks of docs/extending.md are run in test_extending.py.
"""

import ast
import fnmatch
import importlib
import importlib.util
import re
import shlex

import jax
import numpy as np
import pytest
from documents import DOCUMENTS, blocks

from experiments import study
from matd3_jax import config
from matd3_jax.cli import sweep
from matd3_jax.runtime import slurm

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")

OWN = {
    "matd3_jax.train": {"resume", "checkpoint", *slurm.KEYS},
    "matd3_jax.sweep": {"resume", "batch", *sweep.OPTIONS, *slurm.KEYS},
    "matd3_jax.plot": {"runs"},
    "matd3_jax.crossplay": {"runs"},
    "matd3_jax.check": {"run", "sweep"},
    "tests.torture": {"minutes", "seed"},
    "benchmarks.guard": {"record"},
    "experiments.all": {"skip", *study.OPTIONS},
    "experiments.cooperative_navigation": {"seeds", "total_steps", "out"},
}
"""Keys of commands that are neither settings of a run nor in the command's `DEFAULTS`."""
CLOSED = ("evaluate", "render", "plot", "crossplay", "check", "torture", "peers", "gpu")
"""Commands that take no settings of a run."""
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
    {(name, module, *arguments) for name, path in DOCUMENTS.items() for module, arguments in commands(path)}
)


def test_there_are_commands_of_every_kind():
    found = {module for _, module, *_ in COMMANDS}
    assert len(COMMANDS) > 40
    assert {"matd3_jax." + name for name in ("train", "sweep", "evaluate", "render", "plot", "crossplay")} < found


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
    short = name.split(".")[-1]
    module = importlib.import_module(f"matd3_jax.cli.{short}" if name.startswith("matd3_jax.") else inner)
    own = OWN.get(name, set()) | set(getattr(module, "DEFAULTS", ()))
    words = [word for word in arguments if word not in ("key=value", "...", "--help", "--cfg")]
    assert all("=" in word for word in words), words
    if isinstance(getattr(module, "STUDY", None), study.Study):
        options, overrides = study.parse(module.STUDY, words)
        settings = module.STUDY.settings(options["scale"], options)
        assert fnmatch.filter(settings, options["only"] or "*"), f"only={options['only']}: none of {list(settings)}"
        config.load([*next(iter(settings.values())), *overrides])
        return
    keys = {word.split("=")[0] for word in words}
    if "resume" in keys:
        assert keys <= own | {"total_steps", "metric"}
        return
    rest = [word for word in words if word.split("=")[0] not in own]
    if short in CLOSED:
        assert not rest, f"{name} has no {rest}"
        return
    rest = [word for word in rest if not PLACEHOLDER.fullmatch(word.split("=", 1)[1])]
    if name == "matd3_jax.sweep":
        chosen = [word for word in rest if not word.startswith("launcher.")]
        samples = next((int(word.split("=")[1]) for word in words if word.startswith("samples=")), None)
        assert sweep.read(chosen, samples, 0)[1]
    else:
        config.load(rest)


@pytest.mark.parametrize("name", DOCUMENTS)
def test_python_parses(name):
    for block in blocks(DOCUMENTS[name]):
        if block.language == "python":
            ast.parse(block.code, f"{name}:{block.line}")
        assert block.language in ("python", "sh", "diff", "yaml", "text"), f"{name}:{block.line}: {block.language!r}"


@pytest.mark.parametrize("name", ["README.md", "docs/environments.md", "docs/sweeps.md"])
def test_python_runs(name, tmp_path, monkeypatch, quickly_compiled):
    """Blocks of a document share their names. Trainings are shorter than they are written."""
    monkeypatch.chdir(tmp_path)
    if name != "docs/environments.md":  # whose environments call `jax.jit` within it
        monkeypatch.setattr(jax, "jit", quickly_compiled)
    names = {"__name__": "snippet"}
    for block in blocks(DOCUMENTS[name]):
        if block.language == "python":
            code = block.code.replace("total_steps=100_000", "total_steps=5_000, learning_starts=1_000, num_envs=20")
            exec(compile("\n" * (block.line - 1) + code, name, "exec"), names)
    if name == "README.md":
        assert np.isfinite(names["result"].metrics["return_agents"]).all()
        assert names["result"].evaluate(episodes=2).shape == (4, 2, 3)
    if name == "docs/sweeps.md":
        assert all(len(run) == 1 and (run[0] / "metrics.csv").exists() for run in names["runs"].values())
