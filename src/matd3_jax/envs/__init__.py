"""Environments under one contract (`environment.Environment`), nearly all in pure JAX; made by name with `make`.

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
    "from_gymnasium",
    "from_jaxmarl",
    "from_pettingzoo",
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
    "pettingzoo": (".host.parallel", "PettingZoo"),
    "gymnasium": (".host.single", "Gymnasium"),
    "jaxmarl": ("..interop.from_jaxmarl", "JaxMARLTask"),
    "playground": ("..interop.from_playground", "PlaygroundTask"),
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


def from_pettingzoo(source: Any, **options_: Any) -> Environment:
    """Take an environment with PettingZoo's parallel API.

    Args:
        source: a function that makes one, or an instance, which is copied: every seed has copies of its own.
        options_: `adversaries`, `shared_reward`, `episode_length`, `pickle` (see `host.parallel.PettingZoo`).

    Raises OptionError for what has no parallel API, cannot be copied, or has other spaces than these.

    Example:
        >>> from mpe2 import simple_push_v3
        >>> env = from_pettingzoo(lambda: simple_push_v3.parallel_env(max_cycles=10))
        >>> env.teams, env.observation_sizes, env.episode_length
        (('adversaries', 'agents'), (8, 19), 10)
    """
    from matd3_jax.envs.host.parallel import PettingZooObject

    return _with_options(PettingZooObject, source, options_)


def from_gymnasium(source: Any, **options_: Any) -> Environment:
    """Take an environment of gymnasium, its action vector shared out among agents.

    Args:
        source: a function that makes one, or an instance, which is copied: every seed has copies of its own.
        options_: `split`, `observation`, `episode_length`, `pickle` (see `host.single.Gymnasium`).

    Raises OptionError for what is no environment of gymnasium, cannot be copied or shared so, or has other spaces.

    Example:
        >>> import gymnasium
        >>> env = from_gymnasium(lambda: gymnasium.make("Reacher-v5"), split="2x1")
        >>> env.agents, env.action_spaces[0]
        (('agent_0', 'agent_1'), Box(size=1, low=-1.0, high=1.0))
    """
    from matd3_jax.envs.host.single import GymnasiumObject

    return _with_options(GymnasiumObject, source, options_)


def from_jaxmarl(env: Any, **options_: Any) -> Environment:
    """Take an environment of JaxMARL, an instance of its `MultiAgentEnv`.

    `options_`: `episode_length` (see `interop.from_jaxmarl.FromJaxMARL`).

    Raises OptionError for what does not have its methods or spaces, or has no time limit and is given none.

    Example:
        >>> from matd3_jax.interop.jaxmarl import JaxMARL
        >>> theirs = JaxMARL(make("simple_push", actions="discrete"))  # as jaxmarl.make("MPE_simple_push_v3") is one
        >>> env = from_jaxmarl(theirs, episode_length=25)
        >>> env.teams, env.observation_sizes
        (('adversaries', 'agents'), (8, 19))
    """
    return _with_options(_class("..interop.from_jaxmarl", "FromJaxMARL"), env, options_)


def _with_options(class_: Any, source: Any, given: dict[str, Any]) -> Environment:
    known = [field.name for field in dataclasses.fields(class_) if field.name != "source"]
    for key in given:
        if key not in known:
            raise OptionError(f"there is no option {key!r}; {nearest(key, known)}")
    return class_(source=source, **given)


def _find(name: str) -> Any:
    if name not in _CLASSES:
        raise OptionError(f"no environment is called {name!r}; {nearest(name, _CLASSES)}")
    return _class(*_CLASSES[name])


def _class(module: str, name: str) -> Any:
    return getattr(importlib.import_module(module, __name__), name)
