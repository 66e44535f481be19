"""JointTeam: a team seen as one agent, for single-agent algorithms (TD3, DDPG) and for joint controllers."""

import dataclasses
from typing import Any

import chex
import jax.numpy as jnp

from matd3_jax.envs.environment import Environment, TimeStep
from matd3_jax.envs.spaces import ActionSpace, Box, Discrete, MultiDiscrete, Simplex
from matd3_jax.errors import OptionError, nearest


@dataclasses.dataclass(frozen=True)
class JointTeam(Environment):
    """`env` with all agents of `teams` (one name or several) joined into one agent.

    The joined agent stands where its first member stood and bears the name of its team (names joined by "+"). It sees
    `env.full_observation` if it is everybody and `full`, otherwise its members' observations behind each other. Its
    action is theirs behind each other: Simplex with all parts, Box of the summed size, MultiDiscrete for integers. Its
    reward is the mean of theirs and its return weight the sum of theirs, so that the return of the team stays what it
    was where the members share their reward. The state is the wrapped environment's.

    Raises OptionError for an unknown team, and where the members' action spaces do not fit into one.
    """

    env: Environment
    teams_joined: tuple[str, ...] | str = "agents"
    full: bool = True

    def __post_init__(self) -> None:
        teams = (self.teams_joined,) if isinstance(self.teams_joined, str) else tuple(self.teams_joined)
        if not teams:
            raise OptionError("teams_joined=(): name at least one team")
        for team in teams:
            if team not in self.env.teams:
                raise OptionError(f"teams_joined={team!r}: no such team; {nearest(team, set(self.env.teams))}")
        object.__setattr__(self, "teams_joined", teams)
        join_spaces(tuple(self.env.action_spaces[i] for i in self.members))

    @property
    def members(self) -> tuple[int, ...]:
        """Indices of the joined agents in `env`."""
        return tuple(i for i, team in enumerate(self.env.teams) if team in self.teams_joined)

    @property
    def agents(self) -> tuple[str, ...]:
        return self._replace(self.env.agents, self._name)

    @property
    def teams(self) -> tuple[str, ...]:
        return self._replace(self.env.teams, self._name)

    @property
    def observation_sizes(self) -> tuple[int, ...]:
        sizes = self.env.observation_sizes
        joined = self.env.full_observation_size if self._sees_all else sum(sizes[i] for i in self.members)
        return self._replace(sizes, joined)

    @property
    def action_spaces(self) -> tuple[ActionSpace, ...]:
        spaces = self.env.action_spaces
        return self._replace(spaces, join_spaces(tuple(spaces[i] for i in self.members)))

    @property
    def episode_length(self) -> int:
        return self.env.episode_length

    @property
    def return_weights(self) -> tuple[float, ...]:
        weights = self.env.return_weights
        return self._replace(weights, sum(weights[i] for i in self.members))

    @property
    def full_observation_size(self) -> int:
        return self.env.full_observation_size

    @property
    def observation_names(self) -> tuple[tuple[str, ...], ...] | None:
        names = self.env.observation_names
        if names is None or self._sees_all:
            whole = self.env.full_observation_names
            return None if whole is None or names is None else (whole,)
        joined = tuple(f"{self.env.agents[i]}: {name}" for i in self.members for name in names[i])
        return self._replace(names, joined)

    @property
    def full_observation_names(self) -> tuple[str, ...] | None:
        return self.env.full_observation_names

    @property
    def action_names(self) -> tuple[tuple[str, ...], ...] | None:
        names = self.env.action_names
        if names is None:
            return None
        return self._replace(names, tuple(f"{self.env.agents[i]}: {name}" for i in self.members for name in names[i]))

    @property
    def measures(self) -> tuple[str, ...]:
        return self.env.measures

    def full_observation(self, state: Any) -> chex.Array:
        return self.env.full_observation(state)

    def measure(self, state: Any) -> chex.Array:
        return self.env.measure(state)

    def reset(self, key: chex.PRNGKey) -> tuple[Any, tuple[chex.Array, ...]]:
        state, observation = self.env.reset(key)
        return state, self.join(state, observation)

    def step(self, key: chex.PRNGKey, state: Any, action: tuple[chex.Array, ...]) -> TimeStep:
        return self._joined(self.env.step(key, state, self.split(action)))

    def _joined(self, inner: TimeStep) -> TimeStep:
        rewards = tuple(inner.reward)
        mean = jnp.mean(jnp.stack([rewards[i] for i in self.members]))
        return inner._replace(
            observation=self.join(inner.state, inner.observation), reward=jnp.stack(self._replace(rewards, mean))
        )

    @property
    def on_host(self) -> bool:
        return self.env.on_host

    @property
    def costly_reset(self) -> bool:
        return self.env.costly_reset

    def step_or_reset(
        self, key: chex.PRNGKey, reset_key: chex.PRNGKey, state: Any, action: tuple[chex.Array, ...]
    ) -> tuple[TimeStep, Any, tuple[chex.Array, ...]]:
        inner, going, observation = self.env.step_or_reset(key, reset_key, state, self.split(action))
        return self._joined(inner), going, self.join(going, observation)

    def observe(self, state: Any) -> tuple[chex.Array, ...]:
        return self.join(state, self.env.observe(state))

    def join(self, state: Any, observation: tuple[chex.Array, ...]) -> tuple[chex.Array, ...]:
        """What this one's agents see, of what the wrapped environment's see in `state`."""
        if self._sees_all:
            return (self.env.full_observation(state),)
        return self._replace(observation, jnp.concatenate([observation[i] for i in self.members]))

    def split(self, action: tuple[chex.Array, ...]) -> tuple[chex.Array, ...]:
        """The actions of the wrapped environment's agents from this one's."""
        first, spaces = self.members[0], self.env.action_spaces
        rest = iter(action[:first] + action[first + 1 :])
        parts, start = [], 0
        for i, space in enumerate(spaces):
            if i not in self.members:
                parts.append(next(rest))
            elif isinstance(space, Discrete):
                parts.append(action[first][start])
                start += 1
            else:
                (width,) = space.shape
                parts.append(action[first][start : start + width])
                start += width
        return tuple(parts)

    @property
    def _name(self) -> str:
        return "+".join(self.teams_joined)

    @property
    def _sees_all(self) -> bool:
        return self.full and len(self.members) == len(self.env.agents)

    def _replace(self, items: tuple, joined: Any) -> tuple:
        """`items` with `joined` for the first member and without the other members."""
        first = self.members[0]
        return tuple(
            joined if i == first else item for i, item in enumerate(items) if i == first or i not in self.members
        )


def join_spaces(spaces: tuple[ActionSpace, ...]) -> ActionSpace:
    """One action space for all. Raises OptionError if they are of different kinds, or boxes of different bounds."""
    if all(isinstance(space, Simplex) for space in spaces):
        return Simplex(tuple(size for space in spaces for size in space.sizes))  # type: ignore[union-attr]
    if all(isinstance(space, Discrete | MultiDiscrete) for space in spaces):
        return MultiDiscrete(tuple(size for space in spaces for size in space.sizes))  # type: ignore[union-attr]
    first = spaces[0]
    if isinstance(first, Box) and all(
        isinstance(space, Box) and (space.low, space.high) == (first.low, first.high) for space in spaces
    ):
        return Box(sum(space.size for space in spaces), first.low, first.high)
    raise OptionError(f"cannot join the action spaces {', '.join(map(str, spaces))}: kinds or bounds differ")


def innermost(env: Environment) -> Environment:
    """An environment as it was before its teams were joined."""
    while isinstance(env, JointTeam):
        env = env.env
    return env
