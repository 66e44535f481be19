"""The contract every environment keeps: what it is made of, how it resets and how it steps."""

import abc
import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp

from matd3_jax.envs.spaces import ActionSpace
from matd3_jax.errors import OptionError

LIMIT = 1e5
"""Of a robot's positions (m, rad) and velocities (m/s, rad/s): nothing gets beyond but by blowing up numerically."""


class TimeStep(NamedTuple):
    """What one `Environment.step` returns."""

    state: Any
    observation: tuple[chex.Array, ...]
    """One float array [observation size of agent i] per agent, seen in the new state."""
    reward: chex.Array
    """[num_agents]."""
    terminated: chex.Array
    """Boolean scalar: the task itself ended, there is no value beyond."""
    truncated: chex.Array
    """Boolean scalar: the time limit cut the episode, the value continues."""


class Environment(abc.ABC):
    """A multi-agent environment as pure functions of keys, states and actions.

    An instance is static and hashable (a frozen dataclass of its options), so that it can be closed over or passed as
    a static argument; everything dynamic lives in the state pytree. `reset` and `step` act on one environment: batch
    them with `jax.vmap`. Nothing resets by itself: after `terminated` or `truncated` the caller calls `reset`.
    """

    @property
    @abc.abstractmethod
    def agents(self) -> tuple[str, ...]:
        """Names of the agents, in the order of every per-agent tuple and array; without commas and quotation marks."""

    @property
    def teams(self) -> tuple[str, ...]:
        """Team of each agent: "agents" or "adversaries" (joined teams: see `wrappers.joint_team`)."""
        return ("agents",) * len(self.agents)

    @property
    @abc.abstractmethod
    def observation_sizes(self) -> tuple[int, ...]:
        """Number of entries of each agent's observation."""

    @property
    @abc.abstractmethod
    def action_spaces(self) -> tuple[ActionSpace, ...]:
        """Action space of each agent."""

    @property
    @abc.abstractmethod
    def episode_length(self) -> int:
        """Env steps after which an episode is truncated."""

    @property
    def return_weights(self) -> tuple[float, ...]:
        """Weight of each agent's return in the one number reported for its team.

        The particle tasks report sums over agents (weight 1, as the authors print them); bodies whose agents share one
        reward report that reward (weight 1 / number of agents).
        """
        return (1.0,) * len(self.agents)

    @property
    def full_observation_size(self) -> int:
        """Number of entries of `full_observation`."""
        return sum(self.observation_sizes)

    @property
    def entries_in_full_observation(self) -> tuple[tuple[int, ...], ...] | None:
        """Where in `full_observation` each entry of each agent's observation is; None: it need not be in it."""
        joint = type(self).full_observation is Environment.full_observation
        return consecutive(self.observation_sizes) if joint else None

    @property
    def observation_names(self) -> tuple[tuple[str, ...], ...] | None:
        """What each entry of each agent's observation is, with its unit, for people; None: nobody has said."""
        return None

    @property
    def full_observation_names(self) -> tuple[str, ...] | None:
        """The same of `full_observation`."""
        names = self.observation_names
        return (
            None
            if names is None
            else tuple(f"{a}: {n}" for a, own in zip(self.agents, names, strict=True) for n in own)
        )

    @property
    def action_names(self) -> tuple[tuple[str, ...], ...] | None:
        """What each entry of each agent's action is (of choices: each option), for people; None: nobody has said."""
        return None

    @property
    def measures(self) -> tuple[str, ...]:
        """Names of what `measure` gives, units in the docstring of the environment: evaluations report their means."""
        return ()

    @abc.abstractmethod
    def reset(self, key: chex.PRNGKey) -> tuple[Any, tuple[chex.Array, ...]]:
        """Start an episode: (state, one observation per agent)."""

    @abc.abstractmethod
    def step(self, key: chex.PRNGKey, state: Any, action: tuple[chex.Array, ...]) -> TimeStep:
        """Let all agents act once. `action`: one element of `action_spaces[i]` per agent."""

    @property
    def on_host(self) -> bool:
        """Whether it is stepped in Python on the host, and its states are references to objects there.

        Such states go forward only, and mean nothing in another process (see `envs.host`).
        """
        return False

    @property
    def costly_reset(self) -> bool:
        """Whether a reset takes as long as many steps: training then resets only where an episode has ended."""
        return False

    def step_or_reset(
        self, key: chex.PRNGKey, reset_key: chex.PRNGKey, state: Any, action: tuple[chex.Array, ...]
    ) -> tuple[TimeStep, Any, tuple[chex.Array, ...]]:
        """`step`, then the state and the observations to go on from: those of `reset` where the episode ended.

        What the training loop calls of environments `on_host` and of those with a `costly_reset`; of others it resets
        whole batches beforehand, which is quicker in a compiled program. Under `vmap` a reset is computed where any of
        the environments needs one.
        """
        after = self.step(key, state, action)
        ended = after.terminated | after.truncated

        # A condition would become a selection under vmap, and reset in every step; a loop runs where any is left. With
        # the same key each time around XLA would take the reset out of the loop, and compute it in every step as well.
        def restart(carry: tuple) -> tuple:
            _, key, *_ = carry
            return jnp.zeros((), bool), jax.random.fold_in(key, 0), *self.reset(key)

        start = (ended, reset_key, after.state, after.observation)
        _, _, state, observation = jax.lax.while_loop(lambda carry: carry[0], restart, start)
        return after, state, observation

    @abc.abstractmethod
    def observe(self, state: Any) -> tuple[chex.Array, ...]:
        """What each agent sees in `state`."""

    def full_observation(self, state: Any) -> chex.Array:
        """What a single agent in everybody's place sees: [full_observation_size]. By default all observations."""
        return jnp.concatenate(self.observe(state))

    def measure(self, state: Any) -> chex.Array:
        """Quantities of the env step that led to `state`, besides the rewards: [len(measures)]."""
        return jnp.zeros(len(self.measures))


def consecutive(sizes: Sequence[int]) -> tuple[tuple[int, ...], ...]:
    """Give the entries of each of several vectors of these sizes when they stand behind each other."""
    ends = itertools.accumulate(sizes)
    return tuple(tuple(range(end - size, end)) for end, size in zip(ends, sizes, strict=True))


def check_choice(key: str, value: object, allowed: tuple[str, ...]) -> None:
    """Raise OptionError unless `value` is one of `allowed`."""
    if value not in allowed:
        raise OptionError(f"{key}={value!r}: must be one of {', '.join(map(repr, allowed))}")


def check_flag(key: str, value: object) -> None:
    """Raise OptionError unless `value` is True or False."""
    if not isinstance(value, bool):
        raise OptionError(f"{key}={value!r}: must be true or false")


def check_count(key: str, value: object, least: int) -> None:
    """Raise OptionError unless `value` is an integer of at least `least`."""
    if not isinstance(value, int) or isinstance(value, bool) or value < least:
        raise OptionError(f"{key}={value!r}: must be an integer of at least {least}")
