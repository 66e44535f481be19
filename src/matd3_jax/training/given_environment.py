"""What a run keeps of an environment that it was given as an object: its class, and its options where it shows them."""

import dataclasses
import re
from collections.abc import Mapping, Sequence
from typing import Any

from matd3_jax import envs
from matd3_jax.config import parse
from matd3_jax.config.diff import text
from matd3_jax.envs.environment import Environment
from matd3_jax.errors import UserError

UNWRITABLE = re.compile(r" at 0x[0-9a-f]+|\$\{")
"""In what Python says of an object that does not describe itself, and what a settings file would look up."""

LONGEST = 1_000
"""Characters of an option that are worth keeping: arrays are not."""


def recorded(env: Environment) -> dict[str, Any]:
    """The name of an environment's class and the fields of a dataclass; without those that cannot be written down."""
    found: dict[str, Any] = {"name": type(env).__name__}
    fields: tuple[dataclasses.Field[Any], ...] = dataclasses.fields(env) if dataclasses.is_dataclass(env) else ()
    for field in fields:
        value = _plain(getattr(env, field.name))
        if field.name != "name" and len(str(value)) <= LONGEST and not UNWRITABLE.search(str(value)):
            found[field.name] = value
    return found


def check_same(settings: Mapping[str, Any], env: Environment | None, where: object) -> None:
    """Raise UserError where an environment is not the one that a run was given.

    Args:
        settings: of the run's environment; what they lack (older runs' options) is not compared.
        env: None: none was given now.
        where: the run, for the message.
    """
    name = settings["name"]
    if name in envs.names():
        if env is not None:
            raise UserError(f"{where} has its environment, {name}, by name: leave env= out")
        return
    if env is None:
        raise UserError(f"{where} was given its environment as an object: give env={name}(...)")
    here = recorded(env)
    for key, was in settings.items():
        if key in here and here[key] != was:
            raise UserError(f"{where}: env.{key}={text(was)} there, {text(here[key])} here")


def check_options(env: Environment, overrides: Sequence[str]) -> None:
    """Raise UserError for options of the environment beside one that is given as an object."""
    for override in parse(overrides):
        if override.key_or_group.split(".")[0] == "env":
            name = type(env).__name__
            raise UserError(f"{override.input_line}: env= is an object, which has its options already: {name}(...)")


def _plain(value: Any) -> Any:
    """A value as settings have it: numbers, words and lists; of anything else what it says of itself."""
    for kind in (bool, int, float, str):  # NumPy's and words of an Enum are of these, too
        if isinstance(value, kind):
            return kind(value)
    if value is None:
        return None
    if isinstance(value, list | tuple):
        return [_plain(one) for one in value]
    return repr(value)
