"""Options of a command: the fields of a dataclass, read from `key=value` arguments, and the help made from them.

What stands after `key=` is text: it never goes through Hydra's grammar, so that a path may have spaces, commas,
brackets or a further `=`, and a run may be called 1e3, true or null. The type of a field says what the text is read as:
`str` and `Path` as typed, `bool`, `int`, `float` (`null` is None where the type allows None), and tuples of these as
`A,B` or `[A,B]`.
"""

import dataclasses
import inspect
import math
import textwrap
import types
import typing
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, Generic, TypeVar

from matd3_jax.bounds import Bounds
from matd3_jax.errors import UserError, nearest
from matd3_jax.lists import words

WIDTH = 120
"""Of the help, characters."""
HELP = ("-h", "--help")
NOUNS = {int: "a whole number", float: "a number"}

Options = TypeVar("Options")


def option(
    help: str,
    *,
    default: Any = dataclasses.MISSING,
    metavar: str | None = None,
    unit: str = "",
    otherwise: str = "",
    least: float | None = None,
    most: float | None = None,
    above: float | None = None,
    choices: Iterable[Any] | None = None,
    read: Callable[[Sequence[str], str], Any] | None = None,
    new_file: bool = False,
) -> Any:
    """Declare a field of an options dataclass as `KEY=VALUE`.

    Args:
        help: what it means, in a line.
        default: without one the option must be given.
        metavar: what the help shows as its value.
        unit: of a number.
        otherwise: what the help says of a default that is None.
        least, most, above, choices: what is allowed (see `Bounds`), of each member of a tuple.
        read: reads the texts of all occurrences, (texts, key) -> value; without it an option may be given once.
        new_file: a file is going to be written there: its directory must exist.
    """
    bounds = Bounds(least, most, above, None if choices is None else tuple(choices))
    meta = {"help": help, "metavar": metavar, "unit": unit, "otherwise": otherwise, "bounds": bounds, "read": read}
    return dataclasses.field(default=default, metadata={**meta, "new_file": new_file}, kw_only=True)


def flag(name: str, help: str) -> Any:
    """Declare a bool field that `name`, for instance `--cfg`, makes true."""
    return dataclasses.field(default=False, metadata={"help": help, "flag": name}, kw_only=True)


def others(help: str, prefix: str = "") -> Any:
    """Declare a tuple field for the arguments that are no option of the command, as they were typed, in their order.

    prefix: takes those alone whose key begins so.
    """
    return dataclasses.field(default=(), metadata={"help": help, "others": prefix}, kw_only=True)


def key(argument: str) -> str:
    """What stands before the first `=`."""
    return argument.partition("=")[0]


def asks_for_help(argv: Sequence[str]) -> bool:
    return bool(set(HELP) & set(argv))


@dataclasses.dataclass(frozen=True)
class Command(Generic[Options]):
    """A command as it is typed, and its options.

    Attributes:
        program: for instance `python -m matd3_jax.evaluate`.
        options: a dataclass whose fields are made by `option`, `flag` and `others`.
        about: how the help begins; default: the docstring of the dataclass.
        usage: what may follow the program, one line each; default: the required options and `[key=value ...]`.
        examples: whole command lines.
        more: text between options and examples, or what makes it.
    """

    program: str
    options: type[Options]
    about: str | None = None
    usage: Sequence[str] = ()
    examples: Sequence[str] = ()
    more: str | Callable[[], str] = ""

    @property
    def keys(self) -> tuple[str, ...]:
        """Those of its options that are written `key=value`."""
        fields = dataclasses.fields(self.options)  # type: ignore[arg-type]
        return tuple(field.name for field in fields if "bounds" in field.metadata)

    def parse(self, argv: Sequence[str]) -> Options:
        """The options that the arguments give. Raises UserError, in one line, for the first that will not do."""
        hints = typing.get_type_hints(self.options)
        fields = {field.name: field for field in dataclasses.fields(self.options)}  # type: ignore[arg-type]
        flags = {field.metadata["flag"]: name for name, field in fields.items() if "flag" in field.metadata}
        rests = {name: field.metadata["others"] for name, field in fields.items() if "others" in field.metadata}
        plain = {name: field for name, field in fields.items() if name not in rests and name not in flags.values()}
        texts: dict[str, list[str]] = {}
        values: dict[str, Any] = {name: () for name in rests}
        for argument in argv:
            name, sign, text = argument.partition("=")
            if sign and name in plain:
                texts.setdefault(name, []).append(text)
            elif argument in flags:
                values[flags[argument]] = True
            elif argument.startswith("-"):
                raise UserError(f"there is no option {argument!r}; {nearest(argument, [*flags, HELP[1]])}")
            elif rest := _taker(argument, rests):
                values[rest] += (argument,)
            elif not sign:
                raise UserError(f"cannot read {argument!r}: write key=value")
            else:
                raise UserError(f"there is no key {name!r}; {nearest(name, plain)}")
        for name, field in plain.items():
            if name in texts:
                values[name] = _read(name, texts[name], hints[name], field.metadata)
            elif field.default is dataclasses.MISSING:
                missing = f"{name}={_metavar(hints[name], field.metadata)}"
                raise UserError(f"{missing} is missing: {field.metadata['help'].split(';')[0]}")
        return self.options(**values)

    def help(self) -> str:
        """What `--help` prints."""
        hints = typing.get_type_hints(self.options)
        own = self.options.__annotations__
        fields = dataclasses.fields(self.options)  # type: ignore[arg-type]
        # What must be given comes first, what several commands share last.
        fields = tuple(sorted(fields, key=lambda f: (f.default is not dataclasses.MISSING, f.name not in own)))
        plain = [field for field in fields if "bounds" in field.metadata]
        required = [f for f in plain if f.default is dataclasses.MISSING]
        needed = [f"{f.name}={_metavar(hints[f.name], f.metadata)}" for f in required]
        usage = self.usage or [" ".join([*needed, "[key=value ...]"])]
        lines = [f"{'usage:' if k == 0 else '':<6} {self.program} {line}".rstrip() for k, line in enumerate(usage)]
        lines += ["", inspect.cleandoc(self.about or self.options.__doc__ or ""), "", "options:"]
        rows = [(f"{f.name}={_metavar(hints[f.name], f.metadata)}", _meaning(f, hints[f.name])) for f in plain]
        for f in fields:
            if "flag" in f.metadata:
                rows.append((f.metadata["flag"], f.metadata["help"]))
            if "others" in f.metadata:
                rows.append((f"{f.metadata['others']}KEY=VALUE", f.metadata["help"]))
        rows.append((HELP[1], "print this and stop"))
        column = max(len(left) for left, _ in rows)
        for left, right in rows:
            first, *wrapped = textwrap.wrap(right, WIDTH - column - 4) or [""]
            lines.append(f"  {left:<{column}}  {first}")
            lines += [" " * (column + 4) + line for line in wrapped]
        more = self.more if isinstance(self.more, str) else self.more()
        lines += ["", more.strip()] if more else []
        lines += ["", "examples:", *(f"  {line}" for line in self.examples)] if self.examples else []
        return "\n".join(lines)


# ---- one option ------------------------------------------------------------------------------------------------------


def _taker(argument: str, rests: dict[str, str]) -> str | None:
    """The field that takes an argument which is no option, the one with the longest prefix first."""
    fitting = [name for name, prefix in rests.items() if argument.startswith(prefix)]
    return max(fitting, key=lambda name: len(rests[name]), default=None)


def _read(name: str, texts: Sequence[str], hint: Any, meta: typing.Mapping[str, Any]) -> Any:
    if meta["read"] is not None:
        return meta["read"](texts, name)
    if len(texts) > 1:
        raise UserError(f"{name}= is given {len(texts)} times: {', '.join(texts)}")
    kinds = _kinds(hint)
    if type(None) in kinds and texts[0] == "null" and not {str, Path} & set(kinds):
        return None
    kind = kinds[0]
    if typing.get_origin(kind) is tuple:
        member = typing.get_args(kind)[0]
        try:
            several = words(texts[0])
        except UserError as error:
            raise UserError(f"{name}: {error}") from error
        value: Any = tuple(_convert(name, word, member, meta, texts[0]) for word in several)
    else:
        value = _convert(name, texts[0], kind, meta, texts[0])
    if meta["new_file"] and value is not None:
        check_new_file(name, value)
    return value


def check_new_file(name: str, path: Path) -> None:
    """Raise UserError, naming the option, where no file can be written: no directory, or a directory of that name."""
    if path.is_dir():
        raise UserError(f"{name}={path}: is a directory, not a file")
    if not path.parent.is_dir():
        raise UserError(f"{name}={path}: there is no directory {path.parent}")


def _convert(name: str, text: str, kind: Any, meta: typing.Mapping[str, Any], whole: str) -> Any:
    """One text as a value of type `kind`; `whole` is what was typed, for the message."""
    bounds: Bounds = meta["bounds"]
    shown = f"{name}={whole}"
    if kind is Path:
        if not text:
            raise UserError(f"{shown}: must name a {'file' if meta['new_file'] else 'file or directory'}")
        return Path(text)
    if kind is str:
        if bounds.choices is not None and text not in bounds.choices:
            raise UserError(f"{shown}: must {bounds.words()}; {nearest(text, bounds.choices)}")
        return text
    if kind is bool:
        if text.lower() not in ("true", "false"):
            raise UserError(f"{shown}: must be true or false")
        return text.lower() == "true"
    value = number(text, kind)
    if value is None or not bounds.admits(value):
        unit = f" ({meta['unit']})" if meta["unit"] else ""
        noun = NOUNS[kind] if text == whole else f"a list, each {NOUNS[kind]}"
        raise UserError(f"{shown}: must {bounds.words(noun)}{unit}")
    return value


def number(text: str, kind: type) -> Any:
    """The number that a text is; None if it is none."""
    try:
        return kind(text)
    except ValueError:
        pass
    try:
        value = float(text)  # 1e6 reads better than 1000000
    except ValueError:
        return None
    return int(value) if math.isfinite(value) and value.is_integer() else None


def _kinds(hint: Any) -> list[Any]:
    """The types of `X | None`, None last."""
    parts = list(typing.get_args(hint)) if typing.get_origin(hint) in (typing.Union, types.UnionType) else [hint]
    return sorted(parts, key=lambda part: part is type(None))


# ---- help ------------------------------------------------------------------------------------------------------------


def _metavar(hint: Any, meta: typing.Mapping[str, Any]) -> str:
    if meta["metavar"]:
        return meta["metavar"]
    kind, choices = _kinds(hint)[0], meta["bounds"].choices
    several = typing.get_origin(kind) is tuple
    kind = typing.get_args(kind)[0] if several else kind
    names = {bool: "true|false", int: "N", float: "NUMBER", Path: "FILE" if meta["new_file"] else "DIR", str: "TEXT"}
    word = "|".join(map(str, choices)) if choices is not None and not several else names[kind]
    return f"{word},{word},..." if several else word


def _meaning(field: dataclasses.Field, hint: Any) -> str:
    """Help, unit, bounds and default of an option, in a line."""
    meta, notes = field.metadata, []
    bounds: Bounds = meta["bounds"]
    kinds = _kinds(hint)
    several = typing.get_origin(kinds[0]) is tuple
    if meta["unit"]:
        notes.append(meta["unit"])
    if bounds.choices is not None:
        named = not (several or meta["metavar"]) or field.default == bounds.choices
        notes += [] if named else [f"of {', '.join(map(str, bounds.choices))}"]
    elif bounds.most is not None:
        notes.append(f"at most {bounds.most}" if bounds.least is None else f"{bounds.least} to {bounds.most}")
    elif bounds.above is not None:
        notes.append(f"more than {bounds.above:g}")
    elif bounds.least is not None and bounds.least > 1:
        notes.append(f"at least {bounds.least:g}")
    if field.default is dataclasses.MISSING:
        notes.append("required")
    elif field.default is not None:
        notes.append(f"default: {_text(field.default)}")
    elif meta["otherwise"]:
        notes.append(f"default: {meta['otherwise']}")
    return meta["help"] + (f" ({'; '.join(notes)})" if notes else "")


def _text(value: Any) -> str:
    """A default as one types it."""
    if isinstance(value, bool):
        return str(value).lower()
    return f"[{','.join(map(_text, value))}]" if isinstance(value, tuple) else str(value)
