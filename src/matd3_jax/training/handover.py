"""One agent in a team's place begins with the networks of the team's agents: the same actions, the same mean value.

The networks stand side by side in one with the sum of their widths: weights between them start at 0 and are learned
from then on, like all others.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import optax

from matd3_jax.core.agents import JointLayout
from matd3_jax.core.algorithm import Algorithm
from matd3_jax.core.running_statistics import Statistics
from matd3_jax.core.update import GroupState, critic_input_size
from matd3_jax.envs.environment import Environment, consecutive
from matd3_jax.envs.wrappers.joint_team import innermost
from matd3_jax.errors import UserError


def widened(algorithm: Algorithm, agents: int) -> Algorithm:
    """Give the algorithm of one agent in the place of several the room for their networks side by side."""
    return dataclasses.replace(algorithm, hidden=tuple(agents * width for width in algorithm.hidden))


Params = dict[str, np.ndarray]
"""Of a `StackedMLP`: kernel_0, bias_0, kernel_1, ..."""


class Team(NamedTuple):
    """The agents of a team, and where what they see is in what one agent in their place sees."""

    name: str
    agents: tuple[int, ...]
    """Their numbers in the layout that they learned in."""
    entries: tuple[tuple[int, ...], ...]
    """For each of them where the entries of its observation are in that of the one agent."""
    size: int
    """Entries of what the one agent sees in the environment that they learned in."""

    @classmethod
    def of(cls, source: str, name: str, layout: JointLayout, env: Environment, full: bool = True) -> "Team":
        """The team `name` of the run that `source` names, whose agents' layout and environment it has.

        Args:
            full: one agent in everybody's place sees the full observation, not all agents' behind each other.

        Raises UserError where nobody knows what the agents see of what one agent in their place sees.
        """
        agents = tuple(i for i, team in enumerate(layout.teams) if team == name)
        if not full or len(agents) < layout.num_agents:  # one agent for one of several teams never sees the full one
            sizes = [layout.observation_sizes[i] for i in agents]
            return cls(name, agents, consecutive(sizes), sum(sizes))
        entries = innermost(env).entries_in_full_observation
        if entries is None:
            raise UserError(
                f"{source}: one agent sees the environment's own full observation, and where those of the agents are "
                "in it is not known"
            )
        return cls(name, agents, entries, innermost(env).full_observation_size)

    def check_size(self, source: str, size: int) -> None:
        """Raise UserError unless the one agent sees here, `size` entries, what it sees there."""
        if size != self.size:
            raise UserError(
                f"{source}: one agent in the place of {self.name} sees {self.size} numbers there, {size} here"
            )

    def check_widths(self, source: str, there: Algorithm, here: Algorithm) -> None:
        """Raise UserError unless the hidden layers of the one agent `here` hold those of all agents."""
        wanted = widened(there, len(self.agents)).hidden
        if wanted != here.hidden:
            raise UserError(
                f"{source}: the networks of {len(self.agents)} agents with hidden={_list(there.hidden)} stand side by "
                f"side in those of one agent with hidden={_list(wanted)}, not {_list(here.hidden)}"
            )


def actor(team: Team, each: Sequence[Params], size: int, fill: bool = False) -> Params:
    """Join the agents' actors into one that sees `size` entries and does what they all do.

    Leaves: leading axis [seeds]. fill: as for `_blocks`.
    """
    return _side_by_side(each, team.entries, size, fill, _layers(each[0]))


def critic(each: Sequence[Params], columns: Sequence[Sequence[int]], size: int, fill: bool = False) -> Params:
    """Join the agents' critics into those of the mean of their values: Q_j = 1/N sum_i Q_ij.

    Leaves: leading axes [seeds, critics].

    Args:
        columns: for each agent where in the one agent's inputs its critics' inputs are (`critic_columns`).
        size: of the one agent's inputs.
        fill: as for `_blocks`.
    """
    last, share = _layers(each[0]) - 1, np.float32(1 / len(each))
    return {
        **_side_by_side(each, columns, size, fill, last),
        f"kernel_{last}": share * np.concatenate([one[f"kernel_{last}"] for one in each], axis=-2),
        f"bias_{last}": share * np.sum([one[f"bias_{last}"] for one in each], axis=0),
    }


def actor_moments(team: Team, each: Sequence[optax.ScaleByAdamState], size: int) -> optax.ScaleByAdamState:
    """Join the moments of the agents' actors; weights between them have none yet, and squares like the others'."""
    mu = actor(team, [one.mu for one in each], size)
    nu = actor(team, [one.nu for one in each], size, fill=True)
    return optax.ScaleByAdamState(each[0].count, mu, nu)


def critic_moments(
    each: Sequence[optax.ScaleByAdamState], columns: Sequence[Sequence[int]], size: int
) -> optax.ScaleByAdamState:
    """Join the moments of the agents' critics, as gradients are where each value counts 1/N: those of hidden layers
    are 1/N of what they were, those of the last layer's weights as large."""
    number = np.float32(len(each))

    def scaled(params: Params, power: int) -> Params:
        last = _layers(params) - 1
        return {
            name: leaf * (number if name == f"kernel_{last}" else 1 if name == f"bias_{last}" else number**-power)
            for name, leaf in params.items()
        }

    mu = critic([scaled(one.mu, 1) for one in each], columns, size)
    nu = critic([scaled(one.nu, 2) for one in each], columns, size, fill=True)
    return optax.ScaleByAdamState(each[0].count, mu, nu)


def critic_columns(source: str, team: Team, there: JointLayout, here: JointLayout, one: int) -> list[list[int]]:
    """For each agent of the team where in the inputs of the critics of agent `one` each input of its own critics is.

    Raises UserError where the agents' critics see what those of agent `one` do not.
    """
    central = here.algorithms[one].central
    observations, actions = here.observation_size, here.observation_starts[one]
    if not central:
        observations, actions = here.observation_sizes[one], 0
    action = 0
    place: dict[int, tuple[list[int], list[int]]] = {}
    for agent, entries in zip(team.agents, team.entries, strict=True):
        size = there.action_spaces[agent].size
        start = observations + (here.action_starts[one] if central else 0) + action
        place[agent] = ([actions + entry for entry in entries], list(range(start, start + size)))
        action += size
    for agent in range(there.num_agents):
        if agent not in place and central:
            seen, acted = _start(there, here, agent)
            size = there.action_spaces[agent].size
            start = observations + acted
            place[agent] = ([*range(seen, seen + there.observation_sizes[agent])], [*range(start, start + size)])
    found = []
    for agent in team.agents:
        read = range(there.num_agents) if there.algorithms[agent].central else [agent]
        if unseen := [there.agents[i] for i in read if i not in place]:
            raise UserError(
                f"{source}: the critics of {there.agents[agent]} see {unseen[0]}, those of {here.agents[one]} do not: "
                "take critic=central"
            )
        found.append([column for part in (0, 1) for i in read for column in place[i][part]])
    return found


def _start(there: JointLayout, here: JointLayout, agent: int) -> tuple[int, int]:
    """Where the observation and the action of an agent of `there` begin in the joint ones of `here`, where another
    agent may have taken the place of its team, too."""
    if there.agents[agent] in here.agents:
        i, before = here.agents.index(there.agents[agent]), []
    else:
        i = here.agents.index(there.teams[agent])
        before = [k for k in range(agent) if there.teams[k] == there.teams[agent]]
    return (
        here.observation_starts[i] + sum(there.observation_sizes[k] for k in before),
        here.action_starts[i] + sum(there.action_spaces[k].size for k in before),
    )


def networks(
    source: str, team: Team, each: Sequence[GroupState], there: JointLayout, here: JointLayout, one: int
) -> GroupState:
    """Join the networks of a team's agents into those of agent `one` in their place.

    Args:
        each: of the agents, leading axis [seeds]; optimizers may be left out.
        there, here: the agents' layout, and that of the one agent.

    Raises UserError where the networks cannot stand side by side in those of the one agent.
    """
    name, wanted = here.agents[one], here.algorithms[one]
    for agent in team.agents:
        algorithm = there.algorithms[agent]
        for field in ("actor", "actor_output", "num_critics", "critic_head", "critic_norm"):
            a, b = getattr(algorithm, field), getattr(wanted, field)
            if a != b:
                raise UserError(f"{source}: {there.agents[agent]} has {field}={a} there, {name} {field}={b} here")
    for field, plain in (("actor", "mlp"), ("critic_head", "scalar"), ("critic_norm", "none")):
        if getattr(wanted, field) != plain:
            raise UserError(f"{source}: networks stand side by side in those of one agent with {field}={plain} only")
    team.check_size(source, here.observation_sizes[one])
    team.check_widths(source, there.algorithms[team.agents[0]], wanted)
    columns = critic_columns(source, team, there, here, one)
    size, inputs = here.observation_sizes[one], critic_input_size(here, here.groups[here.place(one)[0]])

    def actors(part: str) -> Params:
        return actor(team, [getattr(own, part) for own in each], size)

    def critics(part: str) -> Params:
        return critic([getattr(own, part) for own in each], columns, inputs)

    nothing: Any = None
    moments: Any = None
    if each[0].actor_optimizer is not None:
        moments = [own.actor_optimizer for own in each], [own.critic_optimizer for own in each]
    return GroupState(
        actor=actors("actor"),
        critic=critics("critic"),
        actor_target=actors("actor_target"),
        critic_target=critics("critic_target"),
        actor_optimizer=nothing if moments is None else actor_moments(team, moments[0], size),
        critic_optimizer=nothing if moments is None else critic_moments(moments[1], columns, inputs),
        actor_average=nothing if each[0].actor_average is None else actors("actor_average"),
    )


def statistics(source: str, team: Team, parts: Sequence[Statistics], size: int) -> Statistics:
    """Statistics of what one agent sees from those of what the agents saw, leading axis [seeds].

    Raises UserError where one agent sees more than they did, or not what it sees in their environment.
    """
    team.check_size(source, size)
    unseen = set(range(size)) - {entry for entries in team.entries for entry in entries}
    if unseen:
        raise UserError(
            f"{source}: one agent sees {len(unseen)} entries that the agents did not, and there are no statistics of "
            "them: train both with normalize_observations=false"
        )
    joined = []
    for leaves in zip(*parts, strict=True):
        whole = np.zeros((*leaves[0].shape[:-1], size), np.float32)
        for leaf, entries in zip(leaves, team.entries, strict=True):
            whole[..., list(entries)] = leaf
        joined.append(whole)
    return Statistics(*joined)


def _layers(params: Params) -> int:
    return sum(name.startswith("kernel_") for name in params)


def _side_by_side(
    each: Sequence[Params], places: Sequence[Sequence[int]], size: int, fill: bool, layers: int
) -> Params:
    """The first `layers` layers of several networks as those of one with `size` inputs; places, fill: as for
    `_first` and `_blocks`."""
    joined = {}
    for layer in range(layers):
        kernels = [one[f"kernel_{layer}"] for one in each]
        joined[f"kernel_{layer}"] = _blocks(kernels, fill) if layer else _first(kernels, places, size, fill)
        joined[f"bias_{layer}"] = np.concatenate([one[f"bias_{layer}"] for one in each], axis=-1)
    return joined


def _first(kernels: Sequence[np.ndarray], places: Sequence[Sequence[int]], size: int, fill: bool) -> np.ndarray:
    """First layers [..., inputs, units] side by side, each of which reads its inputs among `size`: [..., size, units].

    Inputs with the same place are the same number, and their weights are added. fill: as for `_blocks`.
    """
    found = []
    for kernel, own in zip(kernels, places, strict=True):
        where = np.zeros((size, len(own)), np.float32)
        where[list(own), np.arange(len(own))] = 1
        spread = where @ np.asarray(kernel)
        if fill:
            unread = where.sum(axis=1) == 0
            spread[..., unread, :] = np.mean(kernel, axis=(-2, -1), keepdims=True)
        found.append(spread)
    return np.concatenate(found, axis=-1)


def _blocks(kernels: Sequence[np.ndarray], fill: bool) -> np.ndarray:
    """Kernels [..., inputs, outputs] along the diagonal of one that is 0 elsewhere; fill: the mean of theirs."""
    rows, columns = (sum(kernel.shape[axis] for kernel in kernels) for axis in (-2, -1))
    whole = np.zeros((*kernels[0].shape[:-2], rows, columns), np.float32)
    if fill:
        whole += np.mean([np.mean(kernel, axis=(-2, -1), keepdims=True) for kernel in kernels], axis=0)
    row = column = 0
    for kernel in kernels:
        whole[..., row : row + kernel.shape[-2], column : column + kernel.shape[-1]] = kernel
        row, column = row + kernel.shape[-2], column + kernel.shape[-1]
    return whole


def _list(widths: Sequence[int]) -> str:
    return "[" + ",".join(map(str, widths)) + "]"
