"""Teams that do not learn: they play a given policy, deterministically, as long as a run goes."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import chex
import jax.numpy as jnp

from matd3_jax.core import networks
from matd3_jax.core.agents import JointLayout
from matd3_jax.core.group import Group


class Scale(NamedTuple):
    """How a frozen policy sees observations: as in the run that it was trained in, whatever the learners do."""

    mean: chex.Array
    """[members, observation size]"""
    deviation: chex.Array
    """[members, observation size]"""
    bound: chex.Array
    """[members] of the scaled entries."""


def unscaled(members: int, size: int) -> Scale:
    """Observations as they are."""
    ones = jnp.ones((members, size))
    return Scale(0 * ones, ones, jnp.full(members, jnp.finfo(jnp.float32).max))


def scaled(scale: Scale, observations: chex.Array) -> chex.Array:
    """Observations [members, batch, size] as the policies see them."""
    bound = scale.bound[:, None, None]
    return jnp.clip((observations - scale.mean[:, None]) / scale.deviation[:, None], -bound, bound)


def outputs(group: Group, actor: chex.ArrayTree, scale: Scale, observations: chex.Array) -> chex.Array:
    """What a frozen group's actors give [members, batch, action size] for observations [members, batch, size]."""
    return networks.apply(group.actors, actor, scaled(scale, observations))


def next_actions(layout: JointLayout, state: Sequence[Any], rows: chex.Array) -> tuple[chex.Array | None, ...]:
    """What frozen groups will do in x', for the targets of the others: [minibatches, members, batch, action size] each,
    None for groups that learn.

    Args:
        state: `update.GroupState` of one seed, one per group.
        rows: replay rows [minibatches, batch, row_size] as they were collected, not normalized.
    """
    found: list[chex.Array | None] = []
    next_x = None
    for group, own in zip(layout.groups, state, strict=True):
        if not group.frozen:
            found.append(None)
            continue
        if next_x is None:
            next_x = layout.row_parts(rows).next_x
        seen = jnp.stack([layout.observation_part(next_x, i) for i in group.members])
        members, batches, batch, size = seen.shape
        output = outputs(group, own.actor, own.scale, seen.reshape(members, batches * batch, size))
        action = group.policy.mode(output).reshape(members, batches, batch, -1)
        found.append(jnp.moveaxis(action, 0, 1))
    return tuple(found)
