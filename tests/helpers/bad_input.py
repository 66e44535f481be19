"""Values that an option or a setting cannot have, made from its type and bounds."""

import types
import typing
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from matd3_jax.bounds import Bounds

LONG = "x" * 10_000
DIGITS = "9" * 5_000
"""More than Python turns into a number."""

NO_NUMBER = (
    *("", " ", "x", "one", "0x10", "1_0_", "1,5,", "--1", "+-1", "1 2", "1e", "nan", "NaN", "-nan", "inf", "-inf"),
    *("Infinity", "1e400", "-1e400", "\u0661x", "\u00e9", "\u221e", "\U0001f600", "\x00", "a\nb", "\x1b[31m"),
    *("{a:1}", "{", "}", "[[1]]", "[", "]", "(1)", "'", '"', "$", "${", "%s", "{}", "true", "null ", LONG, DIGITS),
)
NO_BOOL = ("", "x", "2", "-1", "nan", "yes ", "[true]", "{a:true}", "tru\u00e9", LONG)
NO_CHOICE = ("x", "nan", "-1", "[[x]]", "{a:1}", "\u00e9", "\x1b[31m", LONG)


def good(bounds: Bounds) -> str:
    """What an option may have that must be given: one of its choices, or a run that is not there."""
    return "nowhere" if bounds.choices is None else str(next(iter(bounds.choices)))


def beyond(kind: type, bounds: Bounds) -> Iterator[str]:
    """Numbers just outside and far outside of the bounds."""
    step = 1 if kind is int else 1e-6
    if bounds.least is not None:
        yield from (str(kind(bounds.least - step)), str(kind(bounds.least - 10**9)))
    if bounds.most is not None:
        yield from (str(kind(bounds.most + step)), str(kind(bounds.most + 10**9)))
    if bounds.above is not None:
        yield from (str(bounds.above), str(bounds.above - 1), str(kind(bounds.above - 1e9)))
    if kind is int:
        yield from ("0.5", "1.5", "-0.5")


def options(hint: Any, metadata: Mapping[str, Any]) -> Iterator[str]:
    """Texts that a field of an options dataclass must refuse, as they stand after `key=`."""
    if metadata["read"] is not None:
        return
    kinds = [part for part in _parts(hint) if part is not type(None)]
    kind, bounds = kinds[0], metadata["bounds"]
    several = typing.get_origin(kind) is tuple
    kind = typing.get_args(kind)[0] if several else kind
    if kind in (int, float):
        numbers = {"", " ", "[", "]", "1,5,"} if several else set()
        yield from (text for text in NO_NUMBER if text not in numbers)
        yield from beyond(kind, bounds)
        if not several:
            yield from ("1,2", "[1]", "[1,2]")
    elif kind is bool:
        yield from NO_BOOL
    elif bounds.choices is not None:
        yield from NO_CHOICE
    elif kind is Path and not several:
        yield from ("", "/no/such/folder/x.json", "/") if metadata["new_file"] else ("",)


def settings(hint: Any, bounds: Bounds) -> Iterator[str]:
    """Values in Hydra's grammar that a field of the settings' schema must refuse."""
    kinds = [part for part in _parts(hint) if part is not type(None)]
    if type(None) not in _parts(hint):
        yield "null"
    for kind in kinds:
        if kind in (int, float):
            yield from ("", "x", "true", "{a:1}", "{}", "[]", "[[1]]", "[1,2,3]", "\u00e9", "'1'", "nan", "inf", "-inf")
            yield from ("1e400", LONG, "${x}", "${seed", "[", "{", "???", "1;2", DIGITS)
            yield from beyond(kind, bounds)
        elif kind is bool:
            yield from ("", "x", "2", "[true]", "{a:true}", "\u00e9", "nan", LONG, "${x}", "'true'")
        elif kind is str:
            yield from ("[a]", "{a:1}", "1", "nan", "true", "${x}")
            yield from ("\u00e9\u00e9", LONG) if bounds.choices is not None else ()
        elif typing.get_origin(kind) is tuple:
            yield from ("x", "{a:1}", "[x]", "[[1]]", "[{a:1}]", "[nan]", "[inf]", "[null]", "[\u00e9]", "[true]", LONG)
            if typing.get_args(kind)[-1] is Ellipsis:
                yield from (f"[{value}]" for value in beyond(int, bounds))
                yield f"[64,{DIGITS}]"
            else:
                yield from ("[1]", "[1,2,3]", "[2,1]", "[nan,1]", "[1,inf]", "[1,null]", "[1,[2]]")


def _parts(hint: Any) -> list[Any]:
    union = typing.get_origin(hint) in (typing.Union, types.UnionType)
    return list(typing.get_args(hint)) if union else [hint]
