"""Whether an environment keeps the contract of `environment.Environment`, said before anything is compiled."""

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from matd3_jax.envs.environment import Environment, TimeStep
from matd3_jax.envs.spaces import Box, Discrete, MultiDiscrete, Simplex
from matd3_jax.errors import UserError, one_line
from matd3_jax.thread_pool import calls_lapack, make_room_for_lapack

TEAMS = ("agents", "adversaries")

SEPARATORS = ',"'
"""Of columns in the tables that have the names of agents and measures in their headers."""


def check(env: Environment) -> None:
    """Raise UserError for the first thing about an environment that breaks the contract.

    Looks at what it declares, then traces `reset`, `step` and what reads states once: nothing is computed. The message
    is one line that names the field, what it is, and what it has to be.

    Where LAPACK is called, XLA gets the threads that this takes on a CPU, or a RuntimeWarning says that it is too late
    for that (`thread_pool.make_room_for_lapack`).

    Example:
        >>> from matd3_jax import envs
        >>> envs.check(envs.make("simple_spread"))
    """
    if not isinstance(env, Environment):
        raise UserError(f"{env!r} is no environment: subclass matd3_jax.envs.Environment and pass an instance of it")
    _Check(env).all()


class _Check:
    def __init__(self, env: Environment):
        self.env, self.name = env, type(env).__name__

    def all(self) -> None:
        self.declarations()
        self.behavior()

    def fail(self, what: str) -> None:
        raise UserError(f"{self.name}: {what}")

    # ---- declared ----------------------------------------------------------------------------------------------------

    def declarations(self) -> None:
        env, agents = self.env, self.env.agents
        if not isinstance(agents, tuple) or not agents or not all(isinstance(a, str) and a for a in agents):
            self.fail(f"agents is {agents!r}; must be a tuple of at least one name")
        if len(set(agents)) < len(agents):
            self.fail(f"agents is {agents!r}; names must differ")
        for field, names in (("agents", agents), ("measures", env.measures)):
            for name in names:
                if not name.isprintable() or {*name} & {*SEPARATORS}:
                    self.fail(f"{field} has {name!r}; names must do without commas, quotation marks and line ends")
        for field in ("teams", "observation_sizes", "action_spaces", "return_weights"):
            value = getattr(env, field)
            if not isinstance(value, tuple) or len(value) != len(agents):
                size = f"{len(value)} entries" if isinstance(value, tuple) else f"a {type(value).__name__}"
                self.fail(f"{field} has {size}; must be a tuple with one for each of the {len(agents)} agents")
        for agent, team, entries in zip(agents, env.teams, env.observation_sizes, strict=True):
            if team not in TEAMS:
                self.fail(f"the team of {agent!r} is {team!r}; must be one of {', '.join(map(repr, TEAMS))}")
            if not _whole(entries, 1):
                self.fail(f"the observation size of {agent!r} is {entries!r}; must be a whole number of at least 1")
        for agent, space in zip(agents, env.action_spaces, strict=True):
            self.space(agent, space)
        if not _whole(env.episode_length, 1):
            self.fail(f"episode_length is {env.episode_length!r}; must be a whole number of at least 1")
        try:
            hash(env)
        except TypeError as error:
            self.fail(f"is not hashable ({error}); make it a frozen dataclass of numbers, words and tuples")

    def space(self, agent: str, space: Any) -> None:
        whose = f"the action space of {agent!r} is {space!r}"
        if isinstance(space, Box):
            if not _whole(space.size, 1):
                self.fail(f"{whose}; its size must be a whole number of at least 1")
            bounds = (space.low, space.high)
            if not all(isinstance(bound, int | float) for bound in bounds):
                self.fail(f"{whose}; low and high must be numbers, the same for all entries")
            if not all(map(math.isfinite, bounds)):
                self.fail(f"{whose}; actors are squashed to it, so that low and high must be finite: Box(2, -1.0, 1.0)")
            if not space.low < space.high:
                self.fail(f"{whose}; low must be below high")
        elif isinstance(space, Discrete):
            if not _whole(space.n, 2):
                self.fail(f"{whose}; n must be a whole number of at least 2")
        elif isinstance(space, Simplex | MultiDiscrete):
            sizes = space.sizes
            if not isinstance(sizes, tuple) or not sizes or not all(_whole(size, 2) for size in sizes):
                self.fail(f"{whose}; sizes must be a tuple of whole numbers of at least 2")
        else:
            self.fail(f"{whose}; must be a matd3_jax.envs Box, Simplex, Discrete or MultiDiscrete")

    # ---- traced ------------------------------------------------------------------------------------------------------

    def behavior(self) -> None:
        env, key = self.env, jax.eval_shape(lambda: jax.random.key(0))  # no array yet: JAX is not started by it
        found = self.traced("reset", env.reset, key)
        if not isinstance(found, tuple) or len(found) != 2:
            self.fail(f"reset returns {_shown(found)}; must return (state, observations)")
        state, observations = found
        self.observations("reset", observations)
        actions = tuple(jax.ShapeDtypeStruct(space.shape, _dtype(space)) for space in env.action_spaces)
        step = self.traced("step", env.step, key, state, actions)
        if not isinstance(step, TimeStep):
            self.fail(
                f"step returns {_shown(step)}; must return TimeStep(state, observation, reward, terminated, truncated)"
            )
        self.same_state(state, step.state)
        self.observations("step", step.observation)
        self.array("the reward of step", step.reward, (len(env.agents),), jnp.floating, "one number for each agent")
        for field in ("terminated", "truncated"):
            meaning = "one boolean for all agents"
            self.array(f"{field} of step", getattr(step, field), (), jnp.bool_, meaning)
        self.observations("observe", self.traced("observe", env.observe, state))
        whole = self.traced("full_observation", env.full_observation, state)
        size = env.full_observation_size
        self.array("full_observation", whole, (size,), jnp.floating, f"full_observation_size is {size}")
        measured = self.traced("measure", env.measure, state)
        self.array("measure", measured, (len(env.measures),), jnp.floating, f"measures is {env.measures!r}")

    def traced(self, name: str, function: Callable, *args: Any) -> Any:
        try:
            jaxpr, shapes = jax.make_jaxpr(function, return_shape=True)(*args)
        except UserError:
            raise
        except Exception as error:  # whatever the environment's own code raises
            words = one_line(error)
            short = words if len(words) <= 300 else words[:300] + "..."
            raise UserError(f"{self.name}: {name} cannot be traced by JAX: {type(error).__name__}: {short}") from error
        if calls_lapack(jaxpr):
            make_room_for_lapack(f"{self.name}.{name}")
        return shapes

    def observations(self, where: str, found: Any) -> None:
        agents = self.env.agents
        if not isinstance(found, tuple) or len(found) != len(agents):
            self.fail(
                f"the observations of {where} are {_shown(found)}; must be a tuple of {len(agents)} arrays, one for "
                "each agent"
            )
        for agent, size, one in zip(agents, self.env.observation_sizes, found, strict=True):
            declared = f"observation_sizes says {size}"
            self.array(f"the observation of {agent!r} in {where}", one, (size,), jnp.floating, declared)

    def same_state(self, before: Any, after: Any) -> None:
        """A state that changes its form cannot be carried through a loop."""
        old: Any = jax.tree.structure(before)
        new: Any = jax.tree.structure(after)
        if old != new:
            self.fail(f"step returns a state of another structure than reset: {new}; must be {old}")
        leaves = zip(jax.tree_util.tree_leaves_with_path(before), jax.tree.leaves(after), strict=True)
        for (path, one), other in leaves:
            if (one.shape, one.dtype) != (other.shape, other.dtype):
                where = jax.tree_util.keystr(path)
                self.fail(f"step returns the state's {where or 'array'} as {_shown(other)}; reset as {_shown(one)}")

    def array(self, what: str, found: Any, shape: tuple[int, ...], kind: Any, why: str) -> None:
        if isinstance(found, jax.ShapeDtypeStruct) and found.shape == shape and jnp.issubdtype(found.dtype, kind):
            return
        wanted = f"{'a boolean' if kind is jnp.bool_ else 'a float'} array {list(shape)}"
        self.fail(f"{what} is {_shown(found)}; must be {wanted} ({why})")


def _whole(value: Any, least: int) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value >= least


def _dtype(space: Any) -> Any:
    return jnp.int32 if isinstance(space, Discrete | MultiDiscrete) else jnp.float32


def _shown(found: Any) -> str:
    """An output of a trace in a few words."""
    if isinstance(found, jax.ShapeDtypeStruct):
        return f"{found.dtype}{list(found.shape)}"
    if isinstance(found, tuple | list) and not hasattr(found, "_fields"):
        inside = ", ".join(_shown(one) for one in found[:4]) + (", ..." if len(found) > 4 else "")
        return f"a {type(found).__name__} of {len(found)} ({inside})"
    if isinstance(found, dict):
        return f"a dictionary with the keys {', '.join(map(repr, list(found)[:6]))}"
    return f"a {type(found).__name__}"
