"""Agents and teams, and where each agent's part stands in the joint vectors and the replay rows."""

import dataclasses
from collections.abc import Mapping, Sequence
from functools import cached_property

import chex
import jax
import jax.numpy as jnp

from matd3_jax.core import policies
from matd3_jax.core.algorithm import Algorithm
from matd3_jax.core.group import Group
from matd3_jax.core.policies import Policy
from matd3_jax.envs.environment import Environment
from matd3_jax.envs.spaces import ActionSpace


@dataclasses.dataclass(frozen=True)
class JointLayout:
    """Who learns, and the layout of joint vectors.

    The joint observation x [observation_size] and the joint action [action_size] hold the agents' parts in the order
    of `agents`. A replay row is `x, actions, rewards, x', discount` with discount = 1 - terminated: [row_size] float32.
    With n_step > 1, and with recurrent networks, an entry `more` stands between rewards and x': 0 where the episode
    ended, either way, or 1; behind it the states of recurrent actors before the transition.
    """

    agents: tuple[str, ...]
    teams: tuple[str, ...]
    observation_sizes: tuple[int, ...]
    action_spaces: tuple[ActionSpace, ...]
    algorithms: tuple[Algorithm, ...]
    """One per agent."""
    n_step: int = 1
    """Rewards in a target before it bootstraps (see `n_step`)."""
    sequence_length: int = 1
    """Transitions of a sequence that recurrent networks learn from."""
    burn_in: int = 0
    """Those before, which only bring their states up to date."""

    @classmethod
    def of(
        cls,
        env: Environment,
        algorithms: Mapping[str, Algorithm],
        n_step: int = 1,
        sequence_length: int = 1,
        burn_in: int = 0,
    ) -> "JointLayout":
        """The joint layout of `env` with the algorithm of each team given by name."""
        return cls(
            agents=env.agents,
            teams=env.teams,
            observation_sizes=env.observation_sizes,
            action_spaces=env.action_spaces,
            algorithms=tuple(algorithms[team] for team in env.teams),
            n_step=n_step,
            sequence_length=sequence_length,
            burn_in=burn_in,
        )

    @property
    def num_agents(self) -> int:
        return len(self.agents)

    def by_team(self) -> dict[str, list[str]]:
        """Names of the agents that learn, of each team that does."""
        learning = [self.teams[i] for i in self.learners]
        return {t: [self.agents[i] for i in self.learners if self.teams[i] == t] for t in learning}

    @property
    def learning_agents(self) -> tuple[str, ...]:
        """Names of the agents that learn."""
        return tuple(self.agents[i] for i in self.learners)

    @cached_property
    def learners(self) -> tuple[int, ...]:
        """Numbers of the agents that learn: all but those of frozen teams."""
        return tuple(i for i, algorithm in enumerate(self.algorithms) if not algorithm.frozen)

    @property
    def learning_groups(self) -> tuple[Group, ...]:
        """The groups that learn."""
        return tuple(group for group in self.groups if not group.frozen)

    @property
    def observation_size(self) -> int:
        return sum(self.observation_sizes)

    @property
    def action_size(self) -> int:
        return sum(space.size for space in self.action_spaces)

    @cached_property
    def state_sizes(self) -> tuple[int, ...]:
        """Entries of the state of each agent's actor."""
        groups = (self.groups[self.place(i)[0]] for i in range(self.num_agents))
        return tuple(group.state_size for group in groups)

    @property
    def state_size(self) -> int:
        """Of all agents together; 0 where nobody is recurrent."""
        return sum(self.state_sizes)

    @property
    def recurrent(self) -> bool:
        """Whether any networks have states: updates take sequences."""
        return self.state_size > 0

    @cached_property
    def observation_starts(self) -> tuple[int, ...]:
        """First entry of each agent's part in the joint observation."""
        return _starts(self.observation_sizes)

    @cached_property
    def action_starts(self) -> tuple[int, ...]:
        """First entry of each agent's part in the joint action."""
        return _starts([space.size for space in self.action_spaces])

    @cached_property
    def groups(self) -> tuple[Group, ...]:
        """The groups, in the order of their first members; teams have hyper-parameters, and so groups, of their own."""
        members: dict[tuple[tuple[int, ActionSpace, Algorithm], str], list[int]] = {}
        for i, key in enumerate(zip(self.observation_sizes, self.action_spaces, self.algorithms, strict=True)):
            members.setdefault((key, self.teams[i]), []).append(i)
        return tuple(Group(tuple(who), *key) for (key, _), who in members.items())

    def place(self, agent: int) -> tuple[int, int]:
        """(group number, place among its members) of an agent."""
        g = next(g for g, group in enumerate(self.groups) if agent in group.members)
        return g, self.groups[g].members.index(agent)

    @cached_property
    def minibatches(self) -> tuple[int, ...]:
        """Number of the minibatch that each agent learns from: its own, or its team's with a critic of the team."""
        found: dict[str | int, int] = {}
        keys = [team if self._team_critic(i) else i for i, team in enumerate(self.teams)]
        return tuple(found.setdefault(key, len(found)) for key in keys)

    @property
    def num_minibatches(self) -> int:
        """How many of them there are."""
        return max(self.minibatches) + 1

    def critic_group(self, g: int) -> int:
        """Number of the group whose state has the critics of group g: itself, or the first of a team with one set."""
        if not self.groups[g].team_critic:
            return g
        teams = [self.teams[group.members[0]] for group in self.groups]
        return teams.index(teams[g])

    def team_mean(self, rewards: chex.Array) -> chex.Array:
        """What critics learn from, [..., num_agents] as `rewards`: their agent's, or the mean of their team's."""
        if not any(map(self._team_critic, range(self.num_agents))):
            return rewards
        parts = []
        for i, team in enumerate(self.teams):
            who = [j for j, other in enumerate(self.teams) if other == team] if self._team_critic(i) else [i]
            parts.append(rewards[..., jnp.array(who)].mean(axis=-1))
        return jnp.stack(parts, axis=-1)

    def _team_critic(self, agent: int) -> bool:
        return self.algorithms[agent].critic == "shared" and not self.algorithms[agent].frozen

    def policy(self, agent: int) -> Policy:
        """How an agent's action follows from its actor's output."""
        return policies.of(self.action_spaces[agent], self.algorithms[agent])

    # ---- replay rows -------------------------------------------------------------------------------------------------

    @property
    def row_size(self) -> int:
        more = int(self.n_step > 1 or self.recurrent)
        return 2 * self.observation_size + self.action_size + self.num_agents + 1 + more + self.state_size

    def pack_rows(
        self,
        x: chex.Array,
        action: chex.Array,
        reward: chex.Array,
        next_x: chex.Array,
        terminated: chex.Array,
        truncated: chex.Array,
        state: chex.Array | None = None,
    ) -> chex.Array:
        """Replay rows [..., row_size] of x, next_x [..., observation_size], action [..., action_size],
        reward [..., num_agents], terminated and truncated [...], state [..., state_size]."""
        more = [] if state is None else [state]
        if self.n_step > 1 or self.recurrent:
            more.insert(0, 1.0 - (terminated | truncated).astype(jnp.float32)[..., None])
        discount = 1.0 - terminated.astype(jnp.float32)[..., None]
        return jnp.concatenate([x, action, reward, *more, next_x, discount], axis=-1, dtype=jnp.float32)

    @property
    def observation_columns(self) -> tuple[slice, slice]:
        """Where x and x' stand in a row."""
        return slice(0, self.observation_size), slice(-1 - self.observation_size, -1)

    def row_parts(self, rows: chex.Array) -> "RowParts":
        """The parts of rows [..., row_size]."""
        x, next_x = self.observation_columns
        joint = self.observation_size + self.action_size
        end = joint + self.num_agents
        return RowParts(
            inputs=rows[..., :joint],
            x=rows[..., x],
            action=rows[..., self.observation_size : joint],
            reward=rows[..., joint:end],
            more=rows[..., end] if self.n_step > 1 or self.recurrent else None,
            next_x=rows[..., next_x],
            discount=rows[..., -1],
            state=rows[..., end + 1 : end + 1 + self.state_size] if self.recurrent else None,
        )

    # ---- joint vectors -----------------------------------------------------------------------------------------------

    def observation_part(self, x: chex.Array, agent: int) -> chex.Array:
        """o_i [..., observation_sizes[agent]] of joint observations x."""
        start = self.observation_starts[agent]
        return x[..., start : start + self.observation_sizes[agent]]

    def action_part(self, action: chex.Array, agent: int) -> chex.Array:
        """a_i [..., action size of the agent] of joint actions."""
        start = self.action_starts[agent]
        return action[..., start : start + self.action_spaces[agent].size]

    def state_part(self, state: chex.Array, agent: int) -> chex.Array:
        """What an agent's actor has [..., units] of the states of all, [..., state_size]."""
        start = sum(self.state_sizes[:agent])
        return state[..., start : start + self.state_sizes[agent]]

    def join_actions(self, parts: Sequence[chex.Array]) -> chex.Array:
        """Joint actions [..., action_size] (or states) from one array [members, ..., size] per group."""
        by_group = zip(self.groups, parts, strict=True)
        by_agent = {i: part[k] for group, part in by_group for k, i in enumerate(group.members)}
        return jnp.concatenate([by_agent[i] for i in range(self.num_agents)], axis=-1)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class RowParts:
    """Named parts of replay rows [..., row_size]."""

    inputs: chex.Array
    """x and actions side by side: what a central critic reads."""
    x: chex.Array
    action: chex.Array
    reward: chex.Array
    more: chex.Array | None
    """Whether the episode continues; in rows that `n_step.draw` gives, how many steps of a return follow the first.
    None with n_step = 1, unless networks are recurrent."""
    next_x: chex.Array
    discount: chex.Array
    state: chex.Array | None = None
    """[..., state_size] of recurrent actors, before the transition."""


def _starts(sizes: Sequence[int]) -> tuple[int, ...]:
    return tuple(sum(sizes[:i]) for i in range(len(sizes)))
