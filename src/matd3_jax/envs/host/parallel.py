"""Environments with PettingZoo's parallel API."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import chex
import jax.numpy as jnp
import numpy as np

from matd3_jax.envs.environment import consecutive
from matd3_jax.envs.host import sources
from matd3_jax.envs.host.environment import HostState
from matd3_jax.envs.host.made import MadeEnvironment
from matd3_jax.envs.host.parallel_simulation import Facts, ParallelSimulation, ask
from matd3_jax.envs.host.pool import quiet
from matd3_jax.envs.spaces import ActionSpace
from matd3_jax.errors import OptionError, nearest

EXAMPLE = "a module with a parallel_env, or module:function, for instance env.id=mpe2.simple_spread_v3"


class _Parallel(MadeEnvironment[Facts]):
    """What the environments with PettingZoo's parallel API share; see `PettingZoo`."""

    adversaries: tuple[str, ...] | None
    shared_reward: bool

    def _settle(self) -> None:
        """Check the options, and ask the environment what it is."""
        self._check_length()
        name = self.name
        facts = self.facts
        if self.adversaries is not None:
            if isinstance(self.adversaries, str) or not isinstance(self.adversaries, Sequence):
                raise OptionError(f"adversaries={self.adversaries!r}: must be a list of agents' names")
            object.__setattr__(self, "adversaries", tuple(self.adversaries))
            for agent in self.adversaries:
                if agent not in facts.agents:
                    raise OptionError(f"adversaries: {name} has no agent {agent!r}; {nearest(agent, facts.agents)}")
        self._take_length("does not say after how many env steps it truncates")
        self.begin()

    def _wrong(self, found: Any) -> str | None:
        if is_parallel(found):
            return None
        hint = ": convert it with pettingzoo.utils.aec_to_parallel" if hasattr(found, "agent_iter") else ""
        return f"has no parallel API{hint}"

    def _ask(self, found: Any) -> Facts:
        return ask(found, self.name)

    def _simulation(self, found: Any) -> ParallelSimulation:
        return ParallelSimulation(found, self.facts)

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
    def entries_in_full_observation(self) -> tuple[tuple[int, ...], ...] | None:
        return None if self.facts.state_size else consecutive(self.facts.sizes)

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
            raise OptionError(sources.unmade(self.id, self.kwargs, error)) from error


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
        return sources.called(self.source)

    def _source(self) -> tuple[Callable[[], Any], Any]:
        return sources.maker(self.source, is_parallel)


def is_parallel(env: Any) -> bool:
    """Whether an object has the parallel API."""
    return not isinstance(env, type) and not hasattr(env, "agent_iter") and all(
        callable(getattr(env, name, None)) for name in ("reset", "step", "observation_space", "action_space")
    )  # fmt: skip
