"""Environments in pure JAX under one contract (`base.Environment`); made by name with `make`.

Importing this package loads no environment: each is imported when it is first asked for.
"""

import dataclasses
import importlib
from typing import Any

from .base import (
    ActionSpace,
    Box,
    Discrete,
    Environment,
    MultiDiscrete,
    OptionError,
    Simplex,
    TimeStep,
    nearest,
)

__all__ = [
    "ActionSpace",
    "Box",
    "Discrete",
    "Environment",
    "MultiDiscrete",
    "OptionError",
    "Simplex",
    "TimeStep",
    "make",
    "names",
    "options",
]

_CLASSES = {
    "simple_spread": (".particle.simple_spread", "SimpleSpread"),
    "simple_speaker_listener": (".particle.simple_speaker_listener", "SimpleSpeakerListener"),
    "simple_crypto": (".particle.simple_crypto", "SimpleCrypto"),
    "simple_push": (".particle.simple_push", "SimplePush"),
    "simple_adversary": (".particle.simple_adversary", "SimpleAdversary"),
    "simple_tag": (".particle.simple_tag", "SimpleTag"),
    "simple": (".particle.simple", "Simple"),
    "simple_reference": (".particle.simple_reference", "SimpleReference"),
    "simple_world_comm": (".particle.simple_world_comm", "SimpleWorldComm"),
    "point_reach": (".point", "PointReach"),
    "ant": (".mjx.ant", "Ant"),
    "half_cheetah": (".mjx.planar", "HalfCheetah"),
    "hopper": (".mjx.planar", "Hopper"),
    "walker2d": (".mjx.planar", "Walker2d"),
    "humanoid": (".mjx.humanoid", "Humanoid"),
    "swimmer": (".mjx.planar", "Swimmer"),
    "brax_ant": (".brax", "BraxAnt"),
    "brax_half_cheetah": (".brax", "BraxHalfCheetah"),
    "brax_hopper": (".brax", "BraxHopper"),
    "brax_walker2d": (".brax", "BraxWalker2d"),
    "brax_humanoid": (".brax", "BraxHumanoid"),
    "brax_swimmer": (".brax", "BraxSwimmer"),
}


def names() -> tuple[str, ...]:
    """Names `make` knows."""
    return tuple(_CLASSES)


def options(name: str) -> dict[str, Any]:
    """Option names of an environment and their defaults. Raises OptionError for an unknown name."""
    return {field.name: field.default for field in dataclasses.fields(_find(name))}


def make(name: str, **options_: Any) -> Environment:
    """The environment called `name`.

    Raises OptionError (a ValueError) for an unknown name, an unknown option, or an impossible value.
    """
    known = options(name)
    for key in options_:
        if key not in known:
            raise OptionError(f"{name} has no option {key!r}; {nearest(key, known)}")
    return _find(name)(**options_)


def _find(name: str) -> Any:
    if name not in _CLASSES:
        raise OptionError(f"no environment is called {name!r}; {nearest(name, _CLASSES)}")
    module, class_ = _CLASSES[name]
    return getattr(importlib.import_module(module, __name__), class_)
