"""Plain values, as YAML gives them, into dataclasses of the right types and back."""

import typing
from collections.abc import Mapping
from typing import Any

from matd3_jax.errors import UserError, nearest


def typed(cls: Any, values: Mapping[str, Any], prefix: str) -> Any:
    """A dataclass of plain values, each of its field's type."""
    fields = typing.get_type_hints(cls)
    for name in values:
        if name not in fields:
            raise UserError(f"there is no key {prefix + name!r}; {nearest(name, fields)}")
    for name in fields:
        if name not in values:
            raise UserError(f"the key {prefix + name!r} is missing")
    return cls(**{name: _convert(prefix + name, values[name], hint) for name, hint in fields.items()})


def _convert(key: str, value: Any, hint: Any) -> Any:
    if hint == float | tuple[float, float]:
        if isinstance(value, list | tuple):
            if len(value) != 2:
                raise UserError(f"{key}={value!r}: must be a number, or a range [low,high]")
            return tuple(_convert(key, end, float) for end in value)
        return _convert(key, value, float)
    options = typing.get_args(hint) if not hasattr(hint, "__origin__") else ()
    if type(None) in options:
        if value is None:
            return None
        hint = next(option for option in options if option is not type(None))
    if hint == tuple[float, float]:
        if isinstance(value, list | tuple) and len(value) == 2:
            return tuple(_convert(key, end, float) for end in value)
        raise UserError(f"{key}={value!r}: must be a range [low,high]")
    if hint is float and isinstance(value, int | float) and not isinstance(value, bool):
        return float(value)
    if hint is int and isinstance(value, float) and value.is_integer():
        return int(value)  # 1e6 reads better than 1000000
    if hint == tuple[int, ...]:
        if isinstance(value, list | tuple) and all(type(v) is int for v in value):
            return tuple(value)
        raise UserError(f"{key}={value!r}: must be a list of whole numbers, for instance [64,64]")
    if hint == tuple[str, ...]:
        if isinstance(value, str):
            return (value,)
        if isinstance(value, list | tuple) and all(isinstance(v, str) for v in value):
            return tuple(value)
        raise UserError(f"{key}={value!r}: must be a list of words, for instance [csv,wandb]")
    plain = hint if isinstance(hint, type) else Mapping
    if not isinstance(value, plain) or (isinstance(value, bool) and hint is not bool):
        kind = {int: "a whole number", float: "a number", bool: "true or false", str: "a word"}.get(
            hint, "a group of keys"
        )
        raise UserError(f"{key}={value!r}: must be {kind}")
    return value


def plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {k: plain(v) for k, v in value.items()}
    return list(value) if isinstance(value, tuple) else value
