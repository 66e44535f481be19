"""Options of commands: how they are read, what is refused, what the help says of them."""

import dataclasses
import glob
import math
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from matd3_jax.bounds import Bounds
from matd3_jax.cli import arguments, catalog, command
from matd3_jax.cli.options import Command, flag, option, others
from matd3_jax.errors import UserError
from matd3_jax.figures import learning_curves
from matd3_jax.runs import curves
from matd3_jax.runs.paths import check_new_directory
from matd3_jax.stats import bootstrap


@dataclasses.dataclass(frozen=True)
class Base:
    """Shared."""

    shared: int | None = option("shared by several commands", default=None)


@dataclasses.dataclass(frozen=True)
class All(Base):
    """Do one thing of every kind."""

    where: Path = option("a directory; and more", metavar="PLACE")
    text: str | None = option("any text", default=None, otherwise="nothing")
    count: int = option("how often", default=3, least=1, most=9, unit="times")
    number: int | None = option("a number", default=None, least=0)
    size: float = option("how large", default=0.5, above=0, unit="meters")
    share: float = option("of the whole", default=0.0, least=0, most=1)
    on: bool = option("whether", default=True)
    kind: str = option("which", default="red", choices=("red", "green"))
    sizes: tuple[int, ...] = option("several", default=(1, 2), least=1)
    names: tuple[str, ...] = option("some", default=(), choices=("a", "b"))
    file: Path | None = option("a result", default=None, new_file=True)
    twice: tuple[str, ...] = option("repeated", default=(), read=lambda texts, key: (key, *texts))
    quick: bool = flag("--quick", "in a hurry")
    inner: tuple[str, ...] = others("of the inner thing", prefix="inner.")


@dataclasses.dataclass(frozen=True)
class Open(All):
    """Take anything else, too."""

    rest: tuple[str, ...] = others("anything else")


CLOSED, OPEN = Command("do", All, examples=("do where=here count=2",), more="More text."), Command("do", Open)


def parse(*argv: str) -> All:
    return CLOSED.parse(["where=here", *argv])


def test_defaults_stand_where_nothing_is_given():
    assert parse() == All(where=Path("here"))


@pytest.mark.parametrize(
    ("argument", "name", "value"),
    [
        ("count=1", "count", 1),
        ("count=9", "count", 9),
        ("number=1e6", "number", 1_000_000),
        ("number=1_000", "number", 1000),
        ("number=null", "number", None),
        ("size=1", "size", 1.0),
        ("size=1e-3", "size", 0.001),
        ("share=1", "share", 1.0),
        ("on=false", "on", False),
        ("on=True", "on", True),
        ("kind=green", "kind", "green"),
        ("sizes=4", "sizes", (4,)),
        ("sizes=4,5", "sizes", (4, 5)),
        ("sizes=[4, 5]", "sizes", (4, 5)),
        ("sizes=[]", "sizes", ()),
        ("names=b,a", "names", ("b", "a")),
        ("--quick", "quick", True),
        ("shared=4", "shared", 4),
    ],
)
def test_values_have_the_type_of_their_field(argument, name, value):
    found = getattr(parse(argument), name)
    assert found == value and type(found) is type(value)
    assert dataclasses.replace(parse(argument), **{name: getattr(parse(), name)}) == parse()


NASTY = (
    "1e3", "true", "null", "None", "007", "a b", "a=b", "a,b", "[a]", "[a,b]", "{a:b}", "it's", '"quoted"',
    "naïve ü 日本", "$HOME", "${x}", "${", "a\\b", "x: y #z", "~/a", "*", "--quick", "  spaces ", "interval(1,2)",
    "choice(a,b)", "a;b&c|d",
)  # fmt: skip


@pytest.mark.parametrize("text", NASTY)
def test_texts_and_paths_stay_as_they_are_typed(text):
    found = CLOSED.parse([f"where={text}", f"text={text}"])
    assert found.text == text and found.where == Path(text)


@pytest.mark.parametrize("text", NASTY)
def test_our_commands_take_any_name_of_a_run(text):
    assert catalog.EVALUATE.parse([f"run={text}"]).run == Path(text)
    assert catalog.RENDER.parse([f"run={text}"]).run == Path(text)
    assert catalog.TRAIN.parse([f"resume={text}"]).resume == Path(text)
    sweep = catalog.SWEEP.parse([f"name={text}", f"out={text}", f"resume={text}"])
    assert (sweep.name, sweep.out, sweep.resume) == (text, Path(text), Path(text))
    assert catalog.PLOT.parse(["runs=a", f"title={text}"]).title == text
    quoted = f'"{text}"' if '"' not in text else f"'{text}'"
    if not glob.has_magic(text):  # which names the directories that match
        assert catalog.CROSSPLAY.parse([f"runs=a,{quoted}"]).runs[1] == Path(text.strip()).expanduser()


@pytest.mark.parametrize(
    ("argument", "message"),
    [
        ("count=0", "count=0: must be a whole number from 1 to 9 (times)"),
        ("count=10", "count=10: must be a whole number from 1 to 9 (times)"),
        ("count=1.5", "count=1.5: must be a whole number from 1 to 9 (times)"),
        ("count=", "count=: must be a whole number from 1 to 9 (times)"),
        ("count=null", "count=null: must be a whole number from 1 to 9 (times)"),
        ("count=true", "count=true: must be a whole number from 1 to 9 (times)"),
        ("number=-1", "number=-1: must be a whole number of at least 0"),
        ("number=inf", "number=inf: must be a whole number of at least 0"),
        ("number=last", "number=last: must be a whole number of at least 0"),
        ("size=0", "size=0: must be a positive number (meters)"),
        ("size=nan", "size=nan: must be a positive number (meters)"),
        ("size=inf", "size=inf: must be a positive number (meters)"),
        ("share=1.1", "share=1.1: must be a number from 0 to 1"),
        ("on=1", "on=1: must be true or false"),
        ("kind=geen", "kind=geen: must be one of red, green; did you mean 'green'?"),
        ("sizes=[4,0]", "sizes=[4,0]: must be a list, each a whole number of at least 1"),
        ("sizes=x", "sizes=x: must be a whole number of at least 1"),
        ("names=a,c", "names=a,c: must be one of a, b; known: a, b"),
        ("file=no/such/file", "file=no/such/file: there is no directory no/such"),
        ("file=", "file=: must name a file"),
        ("cuont=3", "there is no key 'cuont'; did you mean 'count' or 'on'?"),
        ("--quik", "there is no option '--quik'; did you mean '--quick'?"),
        ("count", "cannot read 'count': write key=value"),
        ("where=there", "where= is given 2 times: here, there"),
    ],
)
def test_mistakes_are_one_line(argument, message):
    with pytest.raises(UserError) as error:
        parse(argument)
    assert str(error.value) == message


def test_what_is_missing_is_named():
    with pytest.raises(UserError, match="^where=PLACE is missing: a directory$"):
        CLOSED.parse(["count=3"])
    with pytest.raises(UserError, match="^where=: must name a file or directory$"):
        CLOSED.parse(["where="])


@pytest.mark.parametrize("name", catalog.COMMANDS)
def test_what_is_missing_of_our_commands_is_said_without_its_values(name):
    """`KEY=... is missing: what it is`: not what each value means."""
    command = catalog.COMMANDS[name]
    given: list[str] = []
    while True:
        try:
            command.parse(given)
            return
        except UserError as error:
            said = re.fullmatch(r"(\w+)=(\S+) is missing: ([^:;]+)", str(error))
        assert said, "another message"
        given.append(f"{said[1]}={said[2].split('|')[0]}")


def test_a_file_may_not_be_a_directory(tmp_path):
    assert parse(f"file={tmp_path}/new").file == tmp_path / "new"
    with pytest.raises(UserError, match="is a directory, not a file"):
        parse(f"file={tmp_path}")


def test_occurrences_and_other_arguments_keep_their_order():
    assert parse("twice=a", "twice=b,c").twice == ("twice", "a", "b,c")
    argv = ["where=w", "z=1", "inner.b=2", "+a=[1,2]", "inner.a=x=y", "count=2", "seeds=1,2"]
    found = OPEN.parse(argv)
    assert found.rest == ("z=1", "+a=[1,2]", "seeds=1,2") and found.inner == ("inner.b=2", "inner.a=x=y")
    with pytest.raises(UserError, match="there is no key 'z'"):
        CLOSED.parse(argv)


# ---- help ------------------------------------------------------------------------------------------------------------


def test_help_has_an_aligned_line_for_each_option():
    lines = CLOSED.help().splitlines()
    assert lines[0] == "usage: do where=PLACE [key=value ...]" and lines[2] == "Do one thing of every kind."
    wanted = {
        "where=PLACE": "a directory; and more (required)",
        "text=TEXT": "any text (default: nothing)",
        "count=N": "how often (times; 1 to 9; default: 3)",
        "size=NUMBER": "how large (meters; more than 0; default: 0.5)",
        "on=true|false": "whether (default: true)",
        "kind=red|green": "which (default: red)",
        "sizes=N,N,...": "several (default: [1,2])",
        "file=FILE": "a result",
        "--quick": "in a hurry",
        "inner.KEY=VALUE": "of the inner thing",
    }
    first = lines.index("options:") + 1
    column = lines[first].index("a directory")
    found = {line[:column].strip(): line[column:] for line in lines[first : lines.index("", first)]}
    assert {left: found[left] for left in wanted} == wanted
    assert list(found)[0] == "where=PLACE" and list(found)[-4:] == ["shared=N", "--quick", "inner.KEY=VALUE", "--help"]
    assert "More text." in lines and lines[-1] == "  do where=here count=2"


@pytest.mark.parametrize("name", catalog.COMMANDS)
def test_help_of_our_commands_lists_every_option(name, capsys):
    assert command.start(name, ["--help"]) == 0
    printed = capsys.readouterr().out
    fields = dataclasses.fields(catalog.COMMANDS[name].options)
    for field in fields:
        meta = field.metadata
        left = meta.get("flag") or (f"{meta['others']}KEY=" if "others" in meta else f"{field.name}=")
        line = next(line for line in printed.splitlines() if line.startswith(f"  {left}"))
        assert meta["help"][:20] in line, line
    assert all(line.startswith("  python -m matd3_jax.") for line in printed.split("examples:\n")[1].splitlines())
    for example in printed.split("examples:\n")[1].splitlines():
        catalog.COMMANDS[name].parse([word.replace("*", "1") for word in shlex.split(example)[3:]])


@pytest.mark.parametrize("name", catalog.COMMANDS)
def test_help_needs_nothing_heavy(name):
    heavy = ("jax", "hydra", "omegaconf", "numpy", "matplotlib", "brax", "mujoco", "orbax")
    code = f"import sys; from matd3_jax.cli import command; command.start({name!r}, ['-h']); " + (
        f"print([name for name in {heavy} if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"


def test_choices_are_those_of_what_they_choose():
    choices = {f.name: f.metadata["bounds"].choices for f in dataclasses.fields(arguments.Plot)}
    assert choices["x"] == curves.AXES and choices["average"] == bootstrap.AVERAGES
    assert all(suffix in catalog.PLOT.help() for suffix in learning_curves.FORMATS)


# ---- lines to copy ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("text", NASTY)
def test_printed_lines_are_read_back_by_a_shell(text):
    line = command.line("matd3_jax.evaluate", "seed=3", run=Path("runs") / text)
    script = f"python() {{ printf '%s\\0' \"$@\"; }}; {line}"
    done = subprocess.run(["bash", "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.split("\0")[:-1] == ["-m", "matd3_jax.evaluate", "seed=3", f"run={Path('runs') / text}"]


def test_plain_lines_are_not_quoted():
    assert command.line("matd3_jax.train", resume=Path("runs/a-1")) == "python -m matd3_jax.train resume=runs/a-1"


# ---- directories to be made ------------------------------------------------------------------------------------------


def test_a_directory_is_checked_without_being_made(tmp_path, monkeypatch):
    check_new_directory(tmp_path / "a" / "b", "out")
    (tmp_path / "empty").mkdir()
    check_new_directory(tmp_path / "empty", "out")
    assert [path.name for path in tmp_path.iterdir()] == ["empty"]
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "file").touch()
    for path, message in (
        ("full", "something is there already"),
        ("full/file", "cannot make this directory: a file has this name"),
        ("full/file/a", "cannot make this directory"),
        ("a" * 300, "cannot make this directory: File name too long"),
        (f"new/{'a' * 300}/b", "cannot make this directory: File name too long"),
    ):
        with pytest.raises(UserError, match=f"out=.*{message}"):
            check_new_directory(tmp_path / path, "out")
    monkeypatch.setattr("os.access", lambda path, mode: False)  # as for a user who may not write there
    with pytest.raises(UserError, match="is not writable"):
        check_new_directory(tmp_path / "b", "out")


def test_numbers_must_be_finite():
    bounds = Bounds(least=0)
    assert bounds.admits(3) and not bounds.admits(math.inf) and not bounds.admits(math.nan)
