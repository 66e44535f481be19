"""Actors that move one after another in random order, each against the policies as they are by then (HATD3)."""

from collections.abc import Callable, Sequence

import chex
import jax
import jax.numpy as jnp
import numpy as np

from matd3_jax.core.agents import JointLayout
from matd3_jax.core.group import Group
from matd3_jax.core.minibatch import Minibatch, Noise

ORDER = 2**31 - 1
"""What the order's key is folded from the update's with, apart from all keys that are split off it."""


def permutation(key: chex.PRNGKey, agents: Sequence[int]) -> chex.Array:
    """Draw the order of the `agents`, int32 [agents]; key: of the update."""
    return jax.random.permutation(jax.random.fold_in(key, ORDER), jnp.array(agents, jnp.int32))


def move(
    layout: JointLayout,
    key: chex.PRNGKey,
    state: tuple,
    agents: Sequence[int],
    one: Callable[[int, chex.Array, tuple], tuple],
) -> tuple[tuple, chex.Array]:
    """Move the actors of the `agents` in random order.

    Args:
        state: one element per group.
        one: (group number, place among its members, state so far) -> (state after it, actor loss); the place is an
            int32 scalar.

    Returns:
        The state after all, and the actor losses [num_agents], nan of all others.
    """
    places = [layout.place(i) for i in range(layout.num_agents)]
    group, member = (np.array([place[k] for place in places], np.int32) for k in (0, 1))
    there = sorted({places[i][0] for i in agents})
    branch = np.array([there.index(g) if g in there else 0 for g in group], np.int32)

    def step(carry, agent):
        state, losses = carry
        k = jnp.asarray(member)[agent]
        branches = [lambda state, g=g: one(g, k, state) for g in there]
        state, loss = jax.lax.switch(jnp.asarray(branch)[agent], branches, state)
        return (state, losses.at[agent].set(loss)), None

    losses = jnp.full(layout.num_agents, jnp.nan, jax.tree.leaves(state)[0].dtype)
    (state, losses), _ = jax.lax.scan(step, (state, losses), permutation(key, agents))
    return state, losses


def by_policies(
    layout: JointLayout, group: Group, actors: Sequence[chex.ArrayTree], batch: Minibatch, noise: Noise
) -> Minibatch:
    """The minibatch of a member of a `group` with central critics, its joint actions those of the policies as they are
    now: a_j = mu_j(o_j), drawn with the `noise` of the target's; of frozen teams the replayed ones, which they play.

    The gradient of Q_i(x, mu_1(o_1), ..., mu_N(o_N)) with respect to mu_i alone is that of `losses.actor_loss` there
    (Zhong et al. 2024, HATD3).

    Args:
        actors: of all members of each group, stacked.
    """
    x, replayed = jnp.split(batch.inputs, [layout.observation_size], axis=-1)
    parts = []
    for j, (other, params) in enumerate(zip(layout.groups, actors, strict=True)):
        if other.frozen:
            parts.append(jnp.stack([layout.action_part(replayed, i) for i in other.members]))
            continue
        seen = jnp.stack([layout.observation_part(x, i) for i in other.members])
        parts.append(other.policy.sample(other.outputs(params, seen), noise.target[j]))
    joint = jax.lax.stop_gradient(layout.join_actions(parts))
    start = batch.action_column - layout.observation_size
    own = jax.lax.dynamic_slice_in_dim(joint, start, group.action_space.size, axis=-1)
    return batch._replace(inputs=jnp.concatenate([x, joint], axis=-1), action=own)
