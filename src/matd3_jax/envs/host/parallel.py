"""Environments with PettingZoo's parallel API."""

import abc
import dataclasses
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import Any

import chex
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces

from matd3_jax.envs.environment import check_count
from matd3_jax.envs.host import sources
from matd3_jax.envs.host.environment import HostEnvironment, HostState
from matd3_jax.envs.host.pool import Outcome, quiet
from matd3_jax.envs.host.spaces import Actions, flat_size, flatten
from matd3_jax.envs.spaces import ActionSpace
from matd3_jax.errors import OptionError, nearest

EXAMPLE = "a module with a parallel_env, or module:function, for instance env.id=mpe2.simple_spread_v3"

LIMITS = ("max_cycles", "_max_episode_steps", "max_episode_steps", "episode_length", "max_steps")
"""Attributes in which environments keep after how many env steps they truncate."""


@dataclasses.dataclass(frozen=True)
class Facts:
    """What is known of an environment before it is played."""

    agents: tuple[str, ...]
    actions: tuple[Actions, ...]
    observations: tuple[Any, ...]
    """gymnasium's spaces."""
    sizes: tuple[int, ...]
    state: Any
    """The space of `state()`, or None where only its size is known."""
    state_size: int
    """0: there is no `state()`."""
    limit: int | None
    """Env steps after which it truncates, where it says so."""


class _Parallel(HostEnvironment):
    """What the environments with PettingZoo's parallel API share; see `PettingZoo`."""

    adversaries: tuple[str, ...] | None
    shared_reward: bool

    def _settle(self) -> None:
        """Check the options, and ask the environment what it is."""
        if self.episode_length is not None:
            check_count("episode_length", self.episode_length, 1)
        name = self.name
        facts = self.facts
        if self.adversaries is not None:
            if isinstance(self.adversaries, str) or not isinstance(self.adversaries, Sequence):
                raise OptionError(f"adversaries={self.adversaries!r}: must be a list of agents' names")
            object.__setattr__(self, "adversaries", tuple(self.adversaries))
            for agent in self.adversaries:
                if agent not in facts.agents:
                    raise OptionError(f"adversaries: {name} has no agent {agent!r}; {nearest(agent, facts.agents)}")
        if self.episode_length is None:
            if facts.limit is None:
                raise OptionError(
                    f"{name} does not say after how many env steps it truncates: give env.episode_length="
                )
            object.__setattr__(self, "episode_length", facts.limit)
        if self.pickle:
            self.check_pickle()

    @abc.abstractmethod
    def _source(self) -> tuple[Callable[[], Any], Any]:
        """(a function that makes copies, the first copy)"""

    @cached_property
    def _made(self) -> tuple[Callable[[], Any], Facts, list[Any]]:
        """(what makes copies, what they are, the first copy until it is used)"""
        make, first = self._source()
        if not is_parallel(first):
            hint = ": convert it with pettingzoo.utils.aec_to_parallel" if hasattr(first, "agent_iter") else ""
            raise OptionError(f"{self.name} gives a {type(first).__name__}, which has no parallel API{hint}")
        facts = ask(first, self.name)
        return make, facts, [first]

    @property
    def facts(self) -> Facts:
        return self._made[1]

    def simulation(self) -> "ParallelSimulation":
        make, facts, first = self._made
        try:
            return ParallelSimulation(first.pop(), facts)
        except IndexError:
            return ParallelSimulation(make(), facts)

    # ---- the contract ------------------------------------------------------------------------------------------------

    @property
    def agents(self) -> tuple[str, ...]:
        return self.facts.agents

    @property
    def teams(self) -> tuple[str, ...]:
        adversaries = self.adversaries
        if adversaries is None:
            adversaries = tuple(a for a in self.agents if a.startswith(("adversary", "leadadversary")))
        return tuple("adversaries" if agent in adversaries else "agents" for agent in self.agents)

    @property
    def observation_sizes(self) -> tuple[int, ...]:
        return self.facts.sizes

    @property
    def action_spaces(self) -> tuple[ActionSpace, ...]:
        return tuple(actions.ours for actions in self.facts.actions)

    @property
    def return_weights(self) -> tuple[float, ...]:
        if not self.shared_reward:
            return (1.0,) * len(self.agents)
        return tuple(1 / self.teams.count(team) for team in self.teams)

    @property
    def full_observation_size(self) -> int:
        return self.facts.state_size or sum(self.facts.sizes)

    @property
    def num_rewards(self) -> int:
        return len(self.agents)

    @property
    def seen_size(self) -> int:
        return sum(self.facts.sizes) + self.facts.state_size

    def observe(self, state: HostState) -> tuple[chex.Array, ...]:
        ends = np.cumsum(self.facts.sizes)
        return tuple(jnp.split(state.seen, ends)[: len(self.agents)])

    def full_observation(self, state: HostState) -> chex.Array:
        """The environment's `state()`, or without one all observations."""
        return state.seen[sum(self.facts.sizes) :] if self.facts.state_size else state.seen


@dataclasses.dataclass(frozen=True, kw_only=True)
class PettingZoo(_Parallel):
    """An environment with PettingZoo's parallel API: `env=pettingzoo env.id=mpe2.simple_spread_v3`.

    Options: `id`, a module with a function `parallel_env`, or `module:function`; `kwargs`, what it is called with;
    `adversaries`, names of the agents of that team (None: whose names start with "adversary" or "leadadversary");
    `shared_reward`, whether all agents of a team get the same reward, so that a team's return is reported as their mean
    and not as their sum; `episode_length`, env steps after which an episode is truncated (None: what the environment
    says, in an attribute `max_cycles` for instance); `pickle`, whether checkpoints hold the environments.

    Boxes of actions are [-1, 1], stretched to the environment's own bounds; Discrete and MultiDiscrete are what they
    are. Observations are flattened as `gymnasium.spaces.flatten` does (choices one-hot). An agent that leaves sees
    zeros and gets reward 0 until the episode ends, and whatever it does is ignored. The episode ends when no agent is
    left: terminated if all of them were, truncated if one was truncated. `state()`, where there is one, is the full
    observation.

    Raises OptionError for what cannot be made, or has other spaces.
    """

    id: str | None = None
    kwargs: Mapping[str, Any] = sources.Kwargs({})
    adversaries: tuple[str, ...] | None = None
    shared_reward: bool = False
    episode_length: int | None = None  # type: ignore[assignment]
    pickle: bool = False  # type: ignore[assignment]

    def __post_init__(self) -> None:
        object.__setattr__(self, "kwargs", sources.Kwargs(self.kwargs))
        self._settle()

    @property
    def name(self) -> str:
        return f"pettingzoo {self.id}"

    def _source(self) -> tuple[Callable[[], Any], Any]:
        found = sources.named("env.id", self.id, EXAMPLE)
        function = found if callable(found) else getattr(found, "parallel_env", None)
        if function is None:
            raise OptionError(f"env.id={self.id}: it has no parallel_env; name {EXAMPLE}")

        def make() -> Any:
            return function(**self.kwargs)

        try:
            with quiet():
                return make, make()
        except Exception as error:
            words = " ".join(str(error).split())
            raise OptionError(
                f"env.id={self.id} cannot be made with env.kwargs={self.kwargs!r}: {type(error).__name__}: {words}"
            ) from error


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class PettingZooObject(_Parallel):
    """An instance with PettingZoo's parallel API, which is copied, or a function that makes one: see
    `envs.from_pettingzoo`, and `PettingZoo` for what follows from it and the other options."""

    source: Any
    adversaries: tuple[str, ...] | None = None
    shared_reward: bool = False
    episode_length: int | None = None  # type: ignore[assignment]
    pickle: bool = False  # type: ignore[assignment]

    def __post_init__(self) -> None:
        self._settle()

    @property
    def name(self) -> str:
        return getattr(self.source, "__qualname__", type(self.source).__name__)

    def _source(self) -> tuple[Callable[[], Any], Any]:
        return sources.maker(self.source, is_parallel)


def is_parallel(env: Any) -> bool:
    """Whether an object has the parallel API."""
    return not isinstance(env, type) and not hasattr(env, "agent_iter") and all(
        callable(getattr(env, name, None)) for name in ("reset", "step", "observation_space", "action_space")
    )  # fmt: skip


def ask(env: Any, name: str) -> Facts:
    """What an environment is. It is reset once."""
    observations, infos = env.reset(seed=0)
    agents = tuple(map(str, getattr(env, "possible_agents", None) or env.agents))
    if any(isinstance(info, Mapping) and "action_mask" in info for info in dict(infos).values()):
        raise OptionError(f"{name} gives an action_mask, which is not supported: wrap it away")
    whose = [f"{agent!r} in {name}" for agent in agents]
    seen = tuple(env.observation_space(agent) for agent in agents)
    sizes = tuple(flat_size(space, who) for space, who in zip(seen, whose, strict=True))
    actions = tuple(Actions.of(env.action_space(agent), who) for agent, who in zip(agents, whose, strict=True))
    state, state_size = _state(env)
    return Facts(agents, actions, seen, sizes, state, state_size, _limit(env))


def _state(env: Any) -> tuple[Any, int]:
    """The space and the size of `state()`; (None, 0) where there is none."""
    try:
        found = env.state()
    except Exception:  # NotImplementedError, mostly: what the API says of environments without one
        return None, 0
    space = getattr(env, "state_space", None)
    if not (isinstance(space, spaces.Space) and space.is_np_flattenable and space.contains(found)):
        space = None
    return space, len(_flat_state(space, found))


def _flat_state(space: Any, found: Any) -> np.ndarray:
    return np.asarray(found, np.float32).ravel() if space is None else flatten(space, found)


def _limit(env: Any) -> int | None:
    layers = [env, getattr(env, "unwrapped", None), getattr(env, "single_agent_env", None)]
    for layer in [one for one in layers if one is not None]:
        for owner in (layer, getattr(layer, "spec", None)):
            for name in LIMITS:
                value = getattr(owner, name, None)
                if isinstance(value, int | np.integer) and not isinstance(value, bool) and value > 0:
                    return int(value)
    return None


class ParallelSimulation:
    """One copy of an environment with the parallel API."""

    def __init__(self, env: Any, facts: Facts):
        self.env, self.facts = env, facts
        self.observations: Mapping[str, Any] = {}
        self.left: dict[str, bool] = {}
        """Agents that are out of the episode, and whether they were truncated."""
        self.ends = np.cumsum([actions.width for actions in facts.actions])[:-1]

    def reset(self, seed: int) -> None:
        self.observations, _ = self.env.reset(seed=seed)
        self.left = {}

    def step(self, action: np.ndarray) -> Outcome:
        facts, env = self.facts, self.env
        parts = dict(zip(facts.agents, np.split(action, self.ends), strict=True))
        spaces_ = dict(zip(facts.agents, facts.actions, strict=True))
        before = list(env.agents)
        observations, rewards, terminations, truncations, _ = env.step(
            {agent: spaces_[agent].back(parts[agent]) for agent in before}
        )
        playing = [agent for agent in facts.agents if agent not in self.left]
        reward = np.array([rewards.get(a, 0.0) if a in playing else 0.0 for a in facts.agents], np.float32)
        self.observations = {agent: observations[agent] for agent in playing if agent in observations}
        present = set(env.agents)
        for agent in playing:
            truncated = bool(truncations.get(agent, False)) and not terminations.get(agent, False)
            if truncated or terminations.get(agent, False) or (agent in before and agent not in present):
                self.left[agent] = truncated
        ended = not any(agent not in self.left for agent in present)
        truncated = ended and any(self.left.values())
        return Outcome(reward, ended and not truncated, truncated)

    def seen(self) -> np.ndarray:
        facts, found = self.facts, []
        for agent, space, size in zip(facts.agents, facts.observations, facts.sizes, strict=True):
            there = agent in self.observations
            found.append(flatten(space, self.observations[agent]) if there else np.zeros(size, np.float32))
        if facts.state_size:
            found.append(_flat_state(facts.state, self.env.state()))
        return np.concatenate(found)

    def memory(self) -> Any:
        return self.env, self.observations, self.left

    def remember(self, memory: Any) -> None:
        self.env, self.observations, self.left = memory
