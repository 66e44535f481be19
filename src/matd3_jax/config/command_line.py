"""The shortest command line that gives settings again."""

import dataclasses
from collections.abc import Mapping
from typing import Any

from matd3_jax.config import diff
from matd3_jax.config.load import load
from matd3_jax.config.schema import Config
from matd3_jax.errors import UserError

PLACE = ("name", "out")


def overrides(config: Config) -> list[str] | None:
    """What `load` makes these settings of: files, and the values that differ from theirs; without the run's name and
    place (`PLACE`), which are taken.

    None where no command line does: an environment that was given as an object, say.
    """
    names = [f"env={config.env['name']}", f"algo={config.algo.name}"]
    names += [f"adversary={config.adversary.name}"] if config.adversary is not None else []
    try:
        if config.recipe != load(names).recipe:
            names.append(f"recipe={config.recipe}")
        base = _flat(load(names).to_dict())
        wanted = _flat(config.to_dict())
        other = {key: value for key, value in wanted.items() if base.get(key, _ABSENT) != value and key not in PLACE}
        found = [*names, *(_line(key, value) for key, value in other.items())]
        same = dataclasses.replace(load(found), **{key: getattr(config, key) for key in PLACE})
        return found if same == config else None
    except (UserError, KeyError):
        return None


_ABSENT = object()


def _line(key: str, value: Any) -> str:
    if isinstance(value, str) and not value.replace("_", "").isalnum():
        escaped = value.replace("\\", "\\\\").replace("'", "\\'")
        return f"{key}='{escaped}'"
    return f"{key}={diff.text(value)}"


def _flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    found: dict[str, Any] = {}
    for key, value in values.items():
        found.update(_flat(value, f"{prefix}{key}.") if isinstance(value, Mapping) else {prefix + key: value})
    return found
