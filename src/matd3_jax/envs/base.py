"""The contract every environment keeps: what it is made of, how it resets and how it steps."""

import abc
import dataclasses
import difflib
import math
from collections.abc import Iterable
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp

LIMIT = 1e5
"""Of a robot's positions (m, rad) and velocities (m/s, rad/s): nothing gets beyond but by blowing up numerically."""


class OptionError(ValueError):
    """A name or an option that no environment takes; the message names the key, the value and what is allowed."""


@dataclasses.dataclass(frozen=True)
class Box:
    """A vector of `size` real numbers, each between `low` and `high`."""

    size: int
    low: float = -float("inf")
    high: float = float("inf")

    @property
    def shape(self) -> tuple[int, ...]:
        return (self.size,)

    def sample(self, key: chex.PRNGKey) -> chex.Array:
        """Uniform draw, [size]. Raises ValueError when a bound is infinite."""
        if not (math.isfinite(self.low) and math.isfinite(self.high)):
            raise ValueError(f"cannot sample from an unbounded {self}")
        return jax.random.uniform(key, self.shape, minval=self.low, maxval=self.high)


@dataclasses.dataclass(frozen=True)
class Simplex:
    """Soft choices: for each entry of `sizes` a vector of that many non-negative numbers summing to 1, concatenated.

    A one-hot vector is the hard choice. The environments take the vector as it is; nothing is rounded.
    """

    sizes: tuple[int, ...]

    @property
    def size(self) -> int:
        return sum(self.sizes)

    @property
    def shape(self) -> tuple[int, ...]:
        return (self.size,)

    def sample(self, key: chex.PRNGKey) -> chex.Array:
        """Softmax of Gumbel noise in each part, [size]: what a soft categorical policy with equal logits plays."""
        noise = jax.random.gumbel(key, self.shape)
        ends = [sum(self.sizes[: i + 1]) for i in range(len(self.sizes))]
        return jnp.concatenate([jax.nn.softmax(part) for part in jnp.split(noise, ends[:-1])])


@dataclasses.dataclass(frozen=True)
class Discrete:
    """One hard choice among `n`: an int32 scalar in [0, n)."""

    n: int

    @property
    def size(self) -> int:
        """Entries of the one-hot vector that stands for the choice in joint vectors."""
        return self.n

    @property
    def sizes(self) -> tuple[int, ...]:
        return (self.n,)

    @property
    def shape(self) -> tuple[int, ...]:
        return ()

    def sample(self, key: chex.PRNGKey) -> chex.Array:
        """Uniform draw, int32 scalar."""
        return jax.random.randint(key, (), 0, self.n, jnp.int32)


@dataclasses.dataclass(frozen=True)
class MultiDiscrete:
    """Several hard choices at once: an int32 vector, entry k in [0, sizes[k])."""

    sizes: tuple[int, ...]

    @property
    def size(self) -> int:
        """Entries of the concatenated one-hot vectors that stand for the choices in joint vectors."""
        return sum(self.sizes)

    @property
    def shape(self) -> tuple[int, ...]:
        return (len(self.sizes),)

    def sample(self, key: chex.PRNGKey) -> chex.Array:
        """Independent uniform draws, int32 [len(sizes)]."""
        return jax.random.randint(key, self.shape, 0, jnp.array(self.sizes, jnp.int32), jnp.int32)


ActionSpace = Box | Simplex | Discrete | MultiDiscrete


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
    """Boolean scalar: the time limit cut the episode, the value goes on."""


class Environment(abc.ABC):
    """A multi-agent environment as pure functions of keys, states and actions.

    An instance is static and hashable (a frozen dataclass of its options), so that it can be closed over or passed as
    a static argument; everything dynamic lives in the state pytree. `reset` and `step` act on one environment: batch
    them with `jax.vmap`. Nothing resets by itself: after `terminated` or `truncated` the caller calls `reset`.
    """

    @property
    @abc.abstractmethod
    def agents(self) -> tuple[str, ...]:
        """Names of the agents, in the order of every per-agent tuple and array."""

    @property
    def teams(self) -> tuple[str, ...]:
        """Team of each agent: "agents" or "adversaries" (joined teams: see `joint.JointTeam`)."""
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
    def measures(self) -> tuple[str, ...]:
        """Names of what `measure` gives, units in the docstring of the environment: evaluations report their means."""
        return ()

    @abc.abstractmethod
    def reset(self, key: chex.PRNGKey) -> tuple[Any, tuple[chex.Array, ...]]:
        """Start an episode: (state, one observation per agent)."""

    @abc.abstractmethod
    def step(self, key: chex.PRNGKey, state: Any, action: tuple[chex.Array, ...]) -> TimeStep:
        """Let all agents act once. `action`: one element of `action_spaces[i]` per agent."""

    @abc.abstractmethod
    def observe(self, state: Any) -> tuple[chex.Array, ...]:
        """What each agent sees in `state`."""

    def full_observation(self, state: Any) -> chex.Array:
        """What a single agent in everybody's place sees: [full_observation_size]. By default all observations."""
        return jnp.concatenate(self.observe(state))

    def measure(self, state: Any) -> chex.Array:
        """Quantities of the env step that led to `state`, besides the rewards: [len(measures)]."""
        return jnp.zeros(len(self.measures))


def nearest(word: object, known: Iterable[str]) -> str:
    """The end of an error message: what was probably meant, or else everything that is known."""
    known = sorted(known)
    close = difflib.get_close_matches(str(word), known, n=3, cutoff=0.5)
    return f"did you mean {' or '.join(repr(name) for name in close)}?" if close else f"known: {', '.join(known)}"


def check_choice(key: str, value: object, allowed: tuple[str, ...]) -> None:
    """Raise OptionError unless `value` is one of `allowed`."""
    if value not in allowed:
        raise OptionError(f"{key}={value!r}: must be one of {', '.join(map(repr, allowed))}")


def check_count(key: str, value: object, least: int) -> None:
    """Raise OptionError unless `value` is an integer of at least `least`."""
    if not isinstance(value, int) or isinstance(value, bool) or value < least:
        raise OptionError(f"{key}={value!r}: must be an integer of at least {least}")
