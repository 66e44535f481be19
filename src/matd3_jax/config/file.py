"""The settings of a run in a YAML file, as `write` leaves them and older versions left them."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from matd3_jax.config.plain_values import environment, from_dict
from matd3_jax.config.schema import ADDED_LATER, OPTIONS_ADDED_LATER, RENAMED, Config
from matd3_jax.errors import UserError, one_line
from matd3_jax.runtime import files

DEEPEST, LARGEST_FILE = 20, 10**6
"""Groups within each other, and characters, of a file of settings that is read."""

_MALFORMED = (yaml.YAMLError, OmegaConfBaseException)


def read(path: Path) -> Config:
    """The configuration that `write` left. Raises UserError if it cannot be read."""
    try:
        written = path.read_text(encoding="utf-8")
        _check_plain(written)
        found = OmegaConf.to_container(OmegaConf.create(written)) if written.strip() else None
        if not isinstance(found, dict):
            raise UserError("it has no settings")
        values = completed(found)
        if "physics" in values["env"]:
            from matd3_jax.envs.robots.engines.engine import RENAMED

            physics = values["env"]["physics"]
            values["env"] = {**values["env"], "physics": RENAMED.get(physics, physics)}
        return from_dict(values)
    except (OSError, ValueError, TypeError, AttributeError, AssertionError, *_MALFORMED) as error:
        raise UserError(f"cannot read the configuration {path}: {omegaconf_error(error)}") from error


def _check_plain(text: str) -> None:
    """Raise UserError where YAML is not of the kind that `write` leaves: values that refer to each other may stand for
    any number, and deep ones for more calls than there may be."""
    depth = 0
    if len(text) > LARGEST_FILE:
        raise UserError(f"it has more than {LARGEST_FILE:,} characters")
    for event in yaml.parse(text):
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        if isinstance(event, yaml.AliasEvent):
            raise UserError(f"*{event.anchor} refers to another value, which settings do not")
        if depth > DEEPEST:
            raise UserError(f"it has more than {DEEPEST} groups inside each other")


def completed(found: Mapping[Any, Any]) -> dict[Any, Any]:
    """Plain settings of any version under the names that keys have now, with what was in effect where they lack one."""
    values = _with_defaults(with_logger_list(renamed(found)), ADDED_LATER)
    env = environment(values)
    return {**values, "env": {**OPTIONS_ADDED_LATER.get(env["name"], {}), **env}}


def renamed(values: Mapping[Any, Any]) -> dict[Any, Any]:
    """Plain settings with the names that keys have now, in their groups, too."""
    return {
        RENAMED.get(key, key): renamed(value) if isinstance(value, Mapping) else value for key, value in values.items()
    }


def with_logger_list(values: Mapping[Any, Any]) -> dict[Any, Any]:
    """Plain settings with the list `logger` where older ones have `tensorboard: true` or false."""
    found = dict(values)
    if "tensorboard" in found:
        wanted = found.pop("tensorboard")
        found.setdefault("logger", ["csv", "tensorboard"] if wanted else ["csv"])
    return found


def text(config: Config) -> str:
    """Every resolved value, as YAML."""
    return OmegaConf.to_yaml(OmegaConf.create(config.to_dict()))


def write(config: Config, path: Path) -> None:
    """Leave every resolved value in a YAML file."""
    files.write_text(path, text(config))


def _with_defaults(found: Mapping[Any, Any], defaults: Mapping[str, Any]) -> dict[Any, Any]:
    """`found` with the keys that it lacks, also within its groups."""
    values = {**defaults, **found}
    for key, default in defaults.items():
        if isinstance(default, Mapping) and isinstance(values[key], Mapping):
            values[key] = {**default, **values[key]}
    return values


def omegaconf_error(error: BaseException) -> str:
    """Say what an error says, without what OmegaConf adds on further lines but for the key."""
    if isinstance(error, OmegaConfBaseException):
        key = f"{error.full_key}: " if error.full_key else ""
        return key + str(error).split("\n")[0]
    return one_line(error)
