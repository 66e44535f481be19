"""A file of settings that is not as it was left: one line that names it, from every command that reads runs."""

import pytest

from matd3_jax import config
from matd3_jax.cli import command

WHOLE = config.text(config.load(["env=simple_spread"]))


def without(group: str, instead: str) -> str:
    """The settings with another value for a group, whose keys are left under another name."""
    assert f"\n{group}:\n" in WHOLE
    return WHOLE.replace(f"\n{group}:\n", f"\n{group}: {instead}\nother_{group}:\n")


DAMAGED = {
    "empty": "",
    "blank": " \n\n",
    "a number": "3",
    "a word": "env",
    "a list": "- 1\n- 2\n",
    "no YAML": "a: [1",
    "a tab": "\tenv: 3",
    "cut off": WHOLE[: len(WHOLE) // 2],
    "zeros": "\0" * 512,
    "no text": b"\xff\xfe\x00abc",
    "two documents": f"{WHOLE}---\n{WHOLE}",
    "a key twice": f"{WHOLE}seed: 1\n",
    "a key less": WHOLE.replace("seeds: 4\n", ""),
    "a key more": f"{WHOLE}speed: 1\n",
    "no env": WHOLE.replace("\nenv:", "\nenvironment:"),
    "env is nothing": without("env", "null"),
    "env is a word": without("env", "simple_spread"),
    "env without a name": WHOLE.replace("  name: simple_spread\n", ""),
    "env with a list as its name": WHOLE.replace("name: simple_spread", "name: [simple_spread]"),
    "algo is a number": without("algo", "3"),
    "algo is a list": without("algo", "[3]"),
    "diagnostics are a number": without("diagnostics", "3"),
    "adversary is a number": WHOLE.replace("adversary: null", "adversary: 3"),
    "numbers as keys": "1: 2\n",
    "a date": WHOLE.replace("seed: 0", "seed: 2020-01-01"),
    "an interpolation": WHOLE.replace("seed: 0", "seed: ${seeds}"),
    "an unfinished interpolation": WHOLE.replace("seed: 0", "seed: ${x"),
    "an object": "!!python/object/apply:os.system ['true']",
    "deep lists": "a: " + "[" * 5000 + "]" * 5000,
    "deep groups": "{a: " * 5000 + "1" + "}" * 5000,
    "a number of 5000 digits": WHOLE.replace("seeds: 4", f"seeds: {'9' * 5000}"),
    "values that multiply": "a: &a [1, 1]\nb: &b [*a, *a]\nc: &c [*b, *b]\n",
    "a value in itself": "a: &a [*a]",
    "far too long": f"{WHOLE}# {'x' * 2_000_000}\n",
}


@pytest.mark.parametrize("kind", DAMAGED)
def test_a_damaged_file_is_named(kind, tmp_path, capsys):
    damaged = DAMAGED[kind]
    (tmp_path / "config.yaml").write_bytes(damaged if isinstance(damaged, bytes) else damaged.encode())
    for name, argument in (("train", "resume"), ("evaluate", "run"), ("plot", "runs")):
        assert command.code(lambda argv, name=name: command.start(name, argv), [f"{argument}={tmp_path}"]) == 2
        said = capsys.readouterr().err
        assert said.startswith(f"error: cannot read the configuration {tmp_path / 'config.yaml'}: ")
        assert said.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["config.yaml"]


def test_a_directory_in_its_place(tmp_path, capsys):
    (tmp_path / "config.yaml").mkdir()
    assert command.code(lambda argv: command.start("evaluate", argv), [f"run={tmp_path}"]) == 2
    assert "has no config.yaml" in capsys.readouterr().err
