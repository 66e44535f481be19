"""What cannot be is refused in one line, with exit code 2, before anything is written: for every option and setting."""

import dataclasses
import importlib
import pkgutil
import subprocess
import sys
import time
import typing
from collections.abc import Iterator
from pathlib import Path

import bad_input
import pytest

import benchmarks
import experiments
from matd3_jax.cli import catalog, command
from matd3_jax.cli.options import Command
from matd3_jax.config.schema import AlgoConfig, Config, DiagnosticsConfig, MlflowConfig, WandbConfig
from matd3_jax.runs.directory import RunDirectory

SECONDS = 5
"""Of a core, at most for each."""


class Accepted(BaseException):
    """A value that should have been refused was not."""


@pytest.fixture(autouse=True)
def nothing_is_made(monkeypatch, tmp_path):
    """Where a run would be made, the value was accepted; whatever else is written lands in an empty directory."""

    def create(path, *_):
        raise Accepted(path)

    monkeypatch.setattr(RunDirectory, "create", create)
    monkeypatch.chdir(tmp_path)


def refused(main, argv: list[str], key: str, capsys) -> str | None:
    """What is wrong with how the command refuses the arguments; None where it does as it should."""
    begun = time.process_time()
    shown = " ".join(argv)[:120]
    try:
        code = command.code(main, argv)
    except Accepted:
        return f"{shown!r}: accepted"
    except BaseException as error:
        return f"{shown!r}: {type(error).__name__}: {str(error)[:200]}"
    seconds, said = time.process_time() - begun, capsys.readouterr()
    if code != 2 or said.out or said.err.count("\n") != 1 or not said.err.startswith("error: "):
        return f"{shown!r}: exit code {code}, {said.out[:100]!r}, {said.err[:300]!r}"
    if key.split(".")[-1] not in said.err:
        return f"{shown!r}: {said.err[:200]!r} does not name {key}"
    if seconds > SECONDS:
        return f"{shown!r}: {seconds:.1f} s"
    left = list(Path.cwd().rglob("*"))
    return f"{shown!r}: leaves {left[0]}" if left else None


def report(capsys, what: str, count: int) -> None:
    with capsys.disabled():
        print(f"{what}: {count} inputs refused")


def others() -> Iterator[Command]:
    """The commands of benchmarks and experiments."""
    for package in (benchmarks, experiments):
        for module in pkgutil.iter_modules(package.__path__):
            name = f"{package.__name__}.{module.name}"
            name = f"{name}.__main__" if module.ispkg else name
            if importlib.util.find_spec(name) is None:
                continue
            found = importlib.import_module(name)
            for value in [getattr(found, "COMMAND", None), getattr(getattr(found, "STUDY", None), "command", None)]:
                if isinstance(value, Command):
                    yield value


def cases(one: Command) -> Iterator[tuple[str, str]]:
    """(key, text) of every bad text of every option."""
    hints = typing.get_type_hints(one.options)
    for field in dataclasses.fields(one.options):
        if "bounds" in field.metadata:
            yield from ((field.name, text) for text in bad_input.options(hints[field.name], field.metadata))


def needed(one: Command, key: str) -> list[str]:
    """What else must be given: a run that is not there."""
    fields = [field for field in dataclasses.fields(one.options) if "bounds" in field.metadata]
    required = [field for field in fields if field.default is dataclasses.MISSING and field.name != key]
    return [f"{field.name}={bad_input.good(field.metadata['bounds'])}" for field in required]


@pytest.mark.parametrize("name", catalog.COMMANDS)
def test_options_of_commands(name, capsys):
    one = catalog.COMMANDS[name]
    found = list(cases(one))
    wrong = [
        refused(lambda argv: command.start(name, argv), [f"{key}={text}", *needed(one, key)], key, capsys)
        for key, text in found
    ]
    assert not [line for line in wrong if line]
    report(capsys, name, len(found))


def test_options_of_benchmarks_and_experiments(capsys):
    count, commands, wrong = 0, list(others()), []
    for one in commands:
        for key, text in cases(one):
            count += 1
            wrong.append(
                refused(
                    lambda argv, one=one: bool(one.parse(argv)) - 1, [f"{key}={text}", *needed(one, key)], key, capsys
                )
            )
    assert len(commands) >= 10 and count > 500
    assert not [line for line in wrong if line]
    report(capsys, f"{len(commands)} commands of benchmarks and experiments", count)


def of_schema(cls: type, prefix: str) -> Iterator[tuple[str, str]]:
    hints = typing.get_type_hints(cls)
    for field in dataclasses.fields(cls):
        if field.name in ("env", "algo", "adversary", "diagnostics", "wandb", "mlflow") and cls is Config:
            yield from ((field.name, text) for text in ("", "3", "[a]", "{a:1}", "nan", "x", bad_input.LONG))
        elif not field.metadata["text"] and not (prefix and field.name == "name"):
            key = prefix + field.name
            yield from ((key, text) for text in bad_input.settings(hints[field.name], field.metadata["bounds"]))


GROUPS = {
    "": (Config, []),
    "algo.": (AlgoConfig, []),
    "adversary.": (AlgoConfig, ["env=simple_tag", "adversary=maddpg"]),
    "diagnostics.": (DiagnosticsConfig, ["diagnostics.q_bias=true"]),
    "wandb.": (WandbConfig, []),
    "mlflow.": (MlflowConfig, []),
}


@pytest.mark.slow
@pytest.mark.parametrize("prefix", GROUPS)
def test_settings(prefix, capsys):
    cls, more = GROUPS[prefix]
    found = list(of_schema(cls, prefix))
    wrong = [
        refused(lambda argv: command.start("train", argv), [*more, f"{key}={text}"], key, capsys) for key, text in found
    ]
    assert not [line for line in wrong if line]
    report(capsys, f"{prefix}SETTING", len(found))


@pytest.mark.parametrize(
    "argument", ["algo.hidden={a:1}", "algo.lr.x=1", "algo.hidden.0=3", "name.x=1", "env.name.x=1"]
)
def test_keys_of_what_has_none(argument, capsys):
    assert command.code(lambda argv: command.start("train", argv), [argument]) == 2
    said = capsys.readouterr().err
    assert argument.split("=")[0].split(".")[0] in said
    assert "known: \n" not in said and "full_key" not in said and "Config" not in said


def test_values_in_a_sweep_are_refused_before_anything_is_written(capsys):
    small = ["env=point_reach", "algo.lr=0.1,0.01"]
    for more, key in (
        ("seed=0,1", "seed"),
        ("seeds=1,2", "seeds"),
        ("metric=foo", "metric"),
        ("memory=nan", "memory"),
        ("memory=0", "memory"),
        ("samples=0", "samples"),
        ("algo.gamma=2,3", "gamma"),
        ("total_steps=interval(1,2", "total_steps"),
        ("algo.hidden=[8],[x]", "hidden"),
    ):
        assert refused(lambda argv: command.start("sweep", argv), [*small, more], key, capsys) is None


@pytest.mark.slow
def test_whole_processes(tmp_path):
    """With the words of a shell: an option, and a setting whose bytes are no text."""
    for argv in (["resume="], ["algo.lr=\udcff"]):
        done = subprocess.run([sys.executable, "-m", "matd3_jax.train", *argv], cwd=tmp_path, capture_output=True)
        assert done.returncode == 2 and done.stdout == b"" and done.stderr.count(b"\n") == 1, done
    assert not list(tmp_path.iterdir())
