"""What one agent learns from in one update: its parts of replay rows, and its random numbers."""

from functools import partial
from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np

from matd3_jax.core.agents import JointLayout, RowParts
from matd3_jax.core.group import Group
from matd3_jax.core.gru import History
from matd3_jax.core.policies import Policy, flat_draw


class Place(NamedTuple):
    """Where an agent stands, int32 scalars; leaves [members] for several."""

    agent: chex.Array
    """Its number."""
    observation: chex.Array
    """First entry of o_i in x."""
    action: chex.Array
    """First entry of a_i in the joint action."""


class Minibatch(NamedTuple):
    """What one agent learns from in one update."""

    observation: chex.Array
    """[batch, observation size] o_i."""
    action: chex.Array
    """[batch, action size] a_i as replayed."""
    inputs: chex.Array
    """[batch, critic inputs] what the critics read: x and a, or o_i and a_i."""
    reward: chex.Array
    """[batch] r_i, or its team's mean where the team has one critic; with n_step > 1 the return's sum of discounted
    rewards."""
    discount: chex.Array
    """[batch] 0 where the episode terminated, else 1; with n_step > 1 times gamma^(m - 1)."""
    next_observations: tuple[chex.Array | None, ...]
    """o' of those whose target actors the target needs, one array [agents, batch, observation size] per group; None for
    frozen groups."""
    next_x: chex.Array
    """[batch, critic inputs without actions] x', or o'_i."""
    action_column: chex.Array | int
    """Where a_i stands in `inputs`."""
    frozen_next: tuple[chex.Array | None, ...] = ()
    """What frozen groups do in x', [members, batch, action size] each, None for groups that learn; () where none is
    frozen."""
    history: History | None = None
    """Of a recurrent agent's own observations and actions, no axes of a stack."""
    histories: tuple[History | None, ...] = ()
    """The same of those whose target actors the target needs, [agents] per group of `next_observations` with central
    critics; None for groups without states."""
    critic_history: History | None = None
    """What a recurrent agent's critics remember: x and a, or o_i and a_i."""


class Noise(NamedTuple):
    """All random numbers of one agent's update; a leading axis [members] for several."""

    target: tuple[chex.Array | None, ...]
    """Of the target actors' own sampling, [agents, batch, action size] per group of `next_observations`."""
    smoothing: tuple[chex.Array | None, ...]
    """Standard normal, of the same shapes; None without smoothing."""
    action: chex.Array | None
    """[batch, action size] of the own new action."""
    critics: chex.Array | None = None
    """int32 [target_critics] numbers of the critics that make the target; None: all do."""


def places(layout: JointLayout, group: Group) -> Place:
    """Of all members, leaves [members]."""
    members = np.array(group.members)
    return Place(members, np.array(layout.observation_starts)[members], np.array(layout.action_starts)[members])


def minibatch(
    layout: JointLayout,
    group: Group,
    rows: chex.Array,
    place: Place,
    gamma: chex.Array | float,
    frozen_next: tuple[chex.Array | None, ...] = (),
    sequences: chex.Array | None = None,
) -> Minibatch:
    """The minibatch of one member from its rows [batch, row_size]; frozen_next: see there.

    sequences: [sequences, steps, row_size] whose steps after the first `burn_in` are the rows, where anybody is
        recurrent.
    """
    central = group.algorithm.central
    parts = layout.row_parts(rows)
    observation = _entries(parts.x, place.observation, group.observation_size)
    action = _entries(parts.action, place.action, group.action_space.size)
    own_next = _entries(parts.next_x, place.observation, group.observation_size)
    every_next = tuple(
        None if other.frozen else jnp.stack([layout.observation_part(parts.next_x, j) for j in other.members])
        for other in layout.groups
    )
    whole = Minibatch(
        observation=observation,
        action=action,
        inputs=parts.inputs if central else jnp.concatenate([observation, action], axis=-1),
        reward=_entries(layout.team_mean(parts.reward), place.agent, 1)[..., 0],
        discount=parts.discount if layout.n_step == 1 or parts.more is None else parts.discount * gamma**parts.more,
        next_observations=every_next if central else (own_next,),
        next_x=parts.next_x if central else own_next,
        action_column=layout.observation_size + place.action if central else group.observation_size,
        frozen_next=frozen_next if central else (),
    )
    return whole if sequences is None else _with_histories(layout, group, whole, layout.row_parts(sequences), place)


def _entries(whole: chex.Array, start: chex.Array, size: int) -> chex.Array:
    """`size` entries of the last axis, from `start` on."""
    return jax.lax.dynamic_slice_in_dim(whole, start, size, axis=-1)


def _with_histories(layout: JointLayout, group: Group, batch: Minibatch, parts: RowParts, place: Place) -> Minibatch:
    """The minibatch of one member with what recurrent networks take of its sequences [sequences, steps]."""
    assert parts.more is not None and parts.state is not None
    more, first = parts.more, parts.state[:, 0]

    def of(other: Group) -> History | None:
        if not other.recurrent:
            return None
        inputs, start = [], []
        for j in other.members:
            seen, done = layout.observation_part(parts.x, j), layout.action_part(parts.action, j)
            inputs.append(jnp.concatenate([seen, done], axis=-1))
            start.append(layout.state_part(first, j))
        return History(jnp.stack(inputs), more, jnp.stack(start))

    own = None
    if group.recurrent:
        observation = _entries(parts.x, place.observation, group.observation_size)
        action = _entries(parts.action, place.action, group.action_space.size)
        starts = np.cumsum([0, *layout.state_sizes[:-1]])
        start = _entries(first, jnp.asarray(starts)[place.agent], group.state_size)
        own = History(jnp.concatenate([observation, action], axis=-1), more, start)
    central = group.algorithm.central
    critic = None if own is None else History(parts.inputs if central else own.inputs, more)
    everybody = tuple(of(other) for other in layout.groups) if central else (own,)
    return batch._replace(history=own, histories=everybody, critic_history=critic)


def draw_noise(layout: JointLayout, group: Group, shape: tuple[int, int], key: chex.PRNGKey, axis: str | None) -> Noise:
    """The random numbers of a group's members; `shape`: minibatches (1: shared) and their size, on each device of
    `axis` (which draws those of the whole minibatch, as one device would, and takes its own)."""
    batches, local = shape
    if group.team_critic:
        batches = 1  # of the team
    size = local * (1 if axis is None else jax.lax.axis_size(axis))
    members = len(group.members)
    action_key, target_key, smooth_key = jax.random.split(key, 3)
    wanted: list[tuple[Policy | None, tuple[int, ...]]]
    if group.algorithm.central:
        wanted = [(None if other.frozen else other.policy, (len(other.members), size)) for other in layout.groups]
    else:
        wanted, batches = [(group.policy, (size,))], members  # nobody shares an own action

    def draws(draw, key):
        drawn = []
        for j, (policy, lead) in enumerate(wanted):
            shape = (1 if batches == 1 else members, *lead)
            one = None if policy is None else draw(policy, jax.random.fold_in(key, j), shape)
            # With a shared minibatch all agents look at the same target actions.
            drawn.append(None if one is None else jnp.broadcast_to(one, (members, *one.shape[1:])))
        return tuple(drawn)

    def own(policy, key, lead):
        return policy.own_noise(key, lead)

    def normal(policy, key, lead):
        return flat_draw(jax.random.normal, key, (*lead, policy.size)) if group.algorithm.smoothing else None

    noise = Noise(
        target=draws(own, target_key),
        smoothing=draws(normal, smooth_key),
        action=group.policy.own_noise(action_key, (members, size)),
    )
    noise = jax.tree.map(lambda draw: own_part(draw, axis, dimension=-2), noise)
    if group.algorithm.target_critics is None:
        return noise
    keys = jax.random.split(jax.random.fold_in(key, 3), members)  # 0 to 2 would be the keys above
    orders = jax.vmap(partial(jax.random.permutation, x=group.algorithm.num_critics))(keys)
    return noise._replace(critics=orders[:, : group.algorithm.target_critics])


def own_part(whole: chex.Array, axis: str | None, dimension: int) -> chex.Array:
    """This device's equal part of an array along `dimension`, one of as many as the mesh axis has devices."""
    if axis is None:
        return whole
    size = whole.shape[dimension] // jax.lax.axis_size(axis)
    return jax.lax.dynamic_slice_in_dim(whole, jax.lax.axis_index(axis) * size, size, dimension)
