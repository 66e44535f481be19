"""Environments in pure JAX under one contract (`environment.Environment`); made by name with `make`.

Importing this package loads no environment: each is imported when it is first asked for.
"""

import dataclasses
import importlib
from typing import Any

from matd3_jax.envs.check import check
from matd3_jax.envs.environment import Environment, TimeStep
from matd3_jax.envs.spaces import ActionSpace, Box, Discrete, MultiDiscrete, Simplex
from matd3_jax.errors import OptionError, nearest

__all__ = [
    "ActionSpace",
    "Box",
    "Discrete",
    "Environment",
    "MultiDiscrete",
    "OptionError",
    "Simplex",
    "TimeStep",
    "check",
    "foreign",
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
    "point_reach": (".point_reach", "PointReach"),
    "ant": (".robots.ant", "Ant"),
    "half_cheetah": (".robots.planar", "HalfCheetah"),
    "hopper": (".robots.planar", "Hopper"),
    "walker2d": (".robots.planar", "Walker2d"),
    "humanoid": (".robots.humanoid", "Humanoid"),
    "swimmer": (".robots.planar", "Swimmer"),
    "brax_ant": (".robots.brax", "BraxAnt"),
    "brax_half_cheetah": (".robots.brax", "BraxHalfCheetah"),
    "brax_hopper": (".robots.brax", "BraxHopper"),
    "brax_walker2d": (".robots.brax", "BraxWalker2d"),
    "brax_humanoid": (".robots.brax", "BraxHumanoid"),
    "brax_swimmer": (".robots.brax", "BraxSwimmer"),
}

_FOREIGN = {
    "jaxmarl": ("..interop.from_jaxmarl", "JaxMARLTask"),
    "playground": ("..interop.from_playground", "PlaygroundTask"),
}
"""Environments of other libraries, whose option `id` names one of theirs: they need extras."""


def names() -> tuple[str, ...]:
    """Names `make` knows, but for those of `foreign`."""
    return tuple(_CLASSES)


def foreign() -> tuple[str, ...]:
    """Names `make` knows that stand for the environments of another library, chosen by the option `id`."""
    return tuple(_FOREIGN)


def options(name: str) -> dict[str, Any]:
    """Option names of an environment and their defaults. Raises OptionError for an unknown name."""
    return {field.name: field.default for field in dataclasses.fields(_find(name))}


def make(name: str, **options_: Any) -> Environment:
    """The environment called `name`.

    Raises OptionError (a ValueError) for an unknown name, an unknown option, or an impossible value.

    Example:
        >>> import jax
        >>> env = make("simple_spread", num_agents=2)
        >>> env.agents, env.observation_sizes
        (('agent_0', 'agent_1'), (12, 12))
        >>> state, observations = env.reset(jax.random.key(0))
        >>> actions = tuple(jax.numpy.full(space.size, 1 / space.size) for space in env.action_spaces)
        >>> env.step(jax.random.key(1), state, actions).reward.shape
        (2,)
    """
    known = options(name)
    for key in options_:
        if key not in known:
            raise OptionError(f"{name} has no option {key!r}; {nearest(key, known)}")
    return _find(name)(**options_)


def _find(name: str) -> Any:
    known = _CLASSES | _FOREIGN
    if name not in known:
        raise OptionError(f"no environment is called {name!r}; {nearest(name, known)}")
    module, class_ = known[name]
    return getattr(importlib.import_module(module, __name__), class_)
