"""What there is to know of an environment of JaxMARL before it is stepped: sizes, spaces, teams, its time limit."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np

from matd3_jax.envs.robots.quiet import quiet
from matd3_jax.envs.spaces import ActionSpace, Box, Discrete, MultiDiscrete
from matd3_jax.errors import OptionError, one_line

UNLIMITED = 2**30
"""Env steps of a time limit that is never reached."""


@dataclasses.dataclass(frozen=True)
class Action:
    """An agent's action space, and the way from its elements to JaxMARL's."""

    space: ActionSpace
    shape: tuple[int, ...]
    """JaxMARL's."""
    bounds: tuple[np.ndarray, np.ndarray] | None = None
    """JaxMARL's bounds (low, high), flat [size], where `space` is Box(size, -1, 1) in their place."""

    def to_jaxmarl(self, action: chex.Array) -> chex.Array:
        """An element of JaxMARL's space from one of `space`."""
        if self.bounds is not None:
            low, high = self.bounds
            action = low + (jnp.asarray(action) + 1) / 2 * (high - low)
        return jnp.reshape(action, self.shape)


@dataclasses.dataclass(frozen=True)
class Facts:
    """Of one environment; one entry per agent in each tuple."""

    agents: tuple[str, ...]
    teams: tuple[str, ...]
    observation_sizes: tuple[int, ...]
    actions: tuple[Action, ...]
    state: Any
    """Shapes and types of its state."""
    full_observation_size: int
    world: Callable[[Any], Any] | None
    """The global state from its state; None: it has none, or among its observations."""
    time_limit: int | None
    """Env steps after which it ends an episode; None: unknown."""
    truncation: str | None
    """Key of its infos that says that the time limit ended an episode."""
    unlimited: Any
    """The same environment without its time limit; None: it cannot be taken away."""


@functools.cache
def facts(env: Any) -> Facts:
    """Trace `env` once; nothing is computed. Raises OptionError where it lacks what JaxMARL's environments have."""
    name = type(env).__name__
    lacking = [part for part in ("agents", "reset", "step_env", "action_space") if not hasattr(env, part)]
    if lacking:
        raise OptionError(f"{name} is no environment of JaxMARL: it has no {', '.join(lacking)}")
    if getattr(env, "auto_reset", False):
        raise OptionError(f"{name} resets by itself within a step: make it with auto_reset=False")
    agents = tuple(str(agent) for agent in env.agents)
    world = _world(env)
    try:
        with quiet():
            actions = tuple(_action(agent, env.action_space(agent)) for agent in agents)
            observations, state = jax.eval_shape(env.reset, jax.random.PRNGKey(0))
            sizes = tuple(_size(observations[agent]) for agent in agents)
            infos = jax.eval_shape(*_step(env, state, actions))[4]
            full = jax.eval_shape(world, state) if world is not None else observations.get("world_state")
    except OptionError:
        raise
    except Exception as error:  # whatever the environment's own code raises, or what is not a dictionary
        words = one_line(error)[:300]
        raise OptionError(f"{name} does not keep JaxMARL's interface: {type(error).__name__}: {words}") from error
    flags = {key: infos[key] for key in ("truncation", "truncated") if key in infos}
    truncation = next((key for key, value in flags.items() if getattr(value, "shape", None) == ()), None)
    return Facts(
        agents=agents,
        teams=_teams(env, agents),
        observation_sizes=sizes,
        actions=actions,
        state=state,
        full_observation_size=sum(sizes) if full is None else _size(full),
        world=world,
        time_limit=_time_limit(env),
        truncation=truncation,
        unlimited=None if truncation is not None else _without_limit(env, state, actions),
    )


def _world(env: Any) -> Callable[[Any], Any] | None:
    if hasattr(env, "map_global_obs_to_agents"):  # MABrax: brax's observation, of which each agent sees a selection
        return lambda state: state.obs
    found = getattr(env, "get_world_state", None)
    return found if callable(found) else None


def _size(tree: Any) -> int:
    """Numbers in all its arrays."""
    return sum(int(np.prod(leaf.shape)) for leaf in jax.tree.leaves(tree))


def _step(env: Any, state: Any, actions: tuple[Action, ...]) -> tuple:
    """`env.step_env` and shapes to trace it with."""
    taken = {
        agent: jax.ShapeDtypeStruct(action.shape, jnp.float32 if isinstance(action.space, Box) else jnp.int32)
        for agent, action in zip(env.agents, actions, strict=True)
    }
    return env.step_env, jax.random.PRNGKey(0), state, taken


def _action(agent: str, space: Any) -> Action:
    """By the attributes that JaxMARL's spaces, gymnax's and ours have."""
    shape = tuple(getattr(space, "shape", ()))
    sizes = getattr(space, "num_categories", None)
    if hasattr(space, "n"):
        return Action(Discrete(int(space.n)), ())
    if sizes is not None and np.ndim(sizes) == 1:
        return Action(MultiDiscrete(tuple(int(size) for size in np.asarray(sizes))), shape)
    if hasattr(space, "low") and hasattr(space, "high"):
        low, high = (np.ravel(np.broadcast_to(np.asarray(bound), shape)) for bound in (space.low, space.high))
        if not (np.isfinite(low).all() and np.isfinite(high).all()):
            raise OptionError(f"the action space of {agent!r} has no finite bounds, to which actors are squashed")
        if (low == low[0]).all() and (high == high[0]).all():
            return Action(Box(low.size, float(low[0]), float(high[0])), shape)
        return Action(Box(low.size, -1.0, 1.0), shape, (low.astype(np.float32), high.astype(np.float32)))
    raise OptionError(
        f"the action space of {agent!r} is a {type(space).__name__}: must be Box, Discrete, MultiDiscrete"
    )


def _teams(env: Any, agents: tuple[str, ...]) -> tuple[str, ...]:
    """Adversaries are those that MPE's environments list as such, and whoever is called one."""
    listed: set[str] = set()
    for name in ("adversaries", "leader"):
        found = getattr(env, name, ())
        listed |= {found} if isinstance(found, str) else set(found)
    return tuple("adversaries" if agent in listed or "adversary" in agent else "agents" for agent in agents)


def _time_limit(env: Any) -> int | None:
    if hasattr(env, "max_steps"):
        # MPE's base class looks at the counter before it counts the step; the others afterwards.
        counts_from_zero = any(base.__name__ == "SimpleMPE" for base in type(env).__mro__)
        return int(env.max_steps) + counts_from_zero
    if hasattr(env, "num_inner_steps") and hasattr(env, "num_outer_steps"):  # the coin game
        return int(env.num_inner_steps) * int(env.num_outer_steps)
    found = getattr(env, "episode_length", None)
    return None if found is None else int(found)


def _without_limit(env: Any, state: Any, actions: tuple[Action, ...]) -> Any:
    """A copy of `env` with a `max_steps` that is never reached; None where its steps do not look at that."""
    if not hasattr(env, "max_steps"):
        return None
    copy = object.__new__(type(env))  # without copy.copy, which SMAX's `__getattr__` sends into a circle
    copy.__dict__.update(vars(env))
    if "max_steps" in vars(env):
        copy.max_steps = UNLIMITED
    elif "max_steps" in vars(inner := vars(env).get("_env", env)):  # SMAX's against built-in enemies wraps another
        copy._env = object.__new__(type(inner))
        copy._env.__dict__.update(vars(inner) | {"max_steps": UNLIMITED})
    else:
        return None
    with quiet():
        same = str(jax.make_jaxpr(_step(copy, state, actions)[0])(*_step(copy, state, actions)[1:])) == str(
            jax.make_jaxpr(_step(env, state, actions)[0])(*_step(env, state, actions)[1:])
        )
    return None if same else copy
