"""One update of every agent: who learns when, from the equations in `losses`. For one seed."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp
import optax
from jax.flatten_util import ravel_pytree

from matd3_jax.core import losses, minibatch, networks, optimizer, sequential_actors
from matd3_jax.core.agents import Group, JointLayout
from matd3_jax.core.algorithm import HyperParams
from matd3_jax.core.frozen import Scale, unscaled
from matd3_jax.core.minibatch import Minibatch, Noise, Place

UNROLLED_MEMBERS = 4
"""Members of a group that a program holds one after another, instead of in a loop; more take longer to compile."""


class GroupState(NamedTuple):
    """Networks and optimizers of one group. Leaves have leading axes [members], critics [members, critics]."""

    actor: chex.ArrayTree
    critic: chex.ArrayTree
    actor_target: chex.ArrayTree
    critic_target: chex.ArrayTree
    actor_optimizer: optax.OptState
    critic_optimizer: optax.OptState
    actor_average: chex.ArrayTree | None = None
    """With `Algorithm.actor_average` alone."""
    scale: Scale | None = None
    """Of a frozen group, which has an actor besides and nothing else."""


class UpdateMetrics(NamedTuple):
    """Of one update, [num_agents] each."""

    critic_loss: chex.Array
    """Mean squared error, or what another head has in its place, averaged over the critics of the agent."""
    q_value: chex.Array
    """Mean value that the first critic gives to the replayed joint actions."""
    actor_loss: chex.Array
    """NaN where this update left the actor alone; of frozen agents all three are NaN."""


def critic_input_size(layout: JointLayout, group: Group) -> int:
    if group.algorithm.critic == "central":
        return layout.observation_size + layout.action_size
    return group.observation_size + group.action_space.size


def init(layout: JointLayout, key: chex.PRNGKey) -> tuple[GroupState, ...]:
    """Fresh networks and optimizers of all groups; of frozen ones an actor alone, in whose place a given one goes."""

    def one(group: Group, key: chex.PRNGKey) -> GroupState:
        algorithm, keys = group.algorithm, jax.random.split(key, 4)
        observation, inputs = jnp.zeros((1, group.observation_size)), critic_input_size(layout, group)
        if group.frozen:
            mu, nothing = group.actor.init(keys[0], observation)["params"], (None,) * 6
            one = jax.tree.map(lambda leaf: leaf[0], unscaled(1, group.observation_size))
            return GroupState(mu, *nothing, scale=one)  # type: ignore[arg-type]
        mu, q = group.actor.init(keys[0], observation)["params"], group.critic.init(keys[1], inputs)
        if algorithm.sync_targets:
            # Copies, not the same arrays: the state is donated, and one buffer can't be given away twice.
            mu_target, q_target = jax.tree.map(jnp.copy, (mu, q))
        else:
            mu_target = group.actor.init(keys[2], observation)["params"]
            q_target = group.critic.init(keys[3], inputs)
        adam = optimizer.adam(algorithm.adam)
        average = jax.tree.map(jnp.copy, mu) if algorithm.actor_average else None
        return GroupState(mu, q, mu_target, q_target, adam.init(mu), adam.init(q), average)

    keys = jax.random.split(key, layout.num_agents)
    return tuple(
        jax.vmap(lambda k, group=group: one(group, k))(keys[jnp.array(group.members)])  # type: ignore[misc]
        for group in layout.groups
    )


def update(
    layout: JointLayout,
    state: tuple[GroupState, ...],
    hyper: Sequence[HyperParams],
    rows: chex.Array,
    key: chex.PRNGKey,
    move: Sequence[bool],
    sequential: bool = False,
    one_by_one: bool = False,
    axis: str | None = None,
    frozen_next: tuple[chex.Array | None, ...] = (),
    random_order: bool = False,
) -> tuple[tuple[GroupState, ...], UpdateMetrics]:
    """One update of every agent's critics, and of actors and targets where `move` says so.

    Args:
        state, hyper: one element per group.
        rows: replay rows [num_agents, batch, row_size], a minibatch for each agent, or [1, batch, row_size] for all;
            with n_step > 1 as `n_step.draw` gives them.
        move: for each group whether this update moves actors and targets too (every policy_delay-th does).
        sequential: later agents see the earlier ones' moved target actors (the authors' program) instead of all
            learning from the same state.
        one_by_one: compute the agents of a group one after another instead of in one batch: the same numbers, while
            one agent's activations stay in a CPU's cache.
        axis: mesh axis whose devices share the work of each minibatch: `rows` are this device's equal part of it (the
            first rows on the first device), gradients are averaged over all. None: one device has the whole.
        frozen_next: what frozen groups do in x' of the rows (`frozen.next_actions`).
        random_order: actors move one after another in random order, after all critics, against the others' policies as
            they are by then instead of their replayed actions (see `sequential_actors`).
    """
    mu_targets = [group.actor_target for group in state]
    keys = jax.random.split(key, len(layout.groups))
    places = [minibatch.places(layout, group) for group in layout.groups]
    noises = [
        minibatch.draw_noise(layout, group, rows.shape[:2], k, axis) if not group.frozen else None
        for group, k in zip(layout.groups, keys, strict=True)
    ]
    new, metrics = list(state), jnp.full((3, layout.num_agents), jnp.nan)

    def cut(g: int, place: Place) -> Minibatch:
        def own(whole: chex.Array) -> chex.Array:
            return whole[0] if rows.shape[0] == 1 else jax.lax.dynamic_index_in_dim(whole, place.agent, keepdims=False)

        others = jax.tree.map(own, frozen_next)
        return minibatch.minibatch(layout, layout.groups[g], own(rows), place, hyper[g].gamma, others)

    def minibatches(g: int) -> Place | Minibatch:
        """Of all members, stacked; one by one each is cut out in its turn, as all N together hold N times N parts."""
        if one_by_one:
            return places[g]
        members = range(len(layout.groups[g].members))
        return jax.tree.map(
            lambda *m: jnp.stack(m), *(cut(g, jax.tree.map(lambda p, k=k: p[k], places[g])) for k in members)
        )

    def member(g: int, targets: Sequence[chex.ArrayTree], next_action: chex.Array | None = None):
        def f(args):
            state, own_target, batch, noise = args
            batch = cut(g, batch) if one_by_one else batch
            moves = move[g] and not random_order
            return _update_agent(
                layout, layout.groups[g], hyper[g], moves, axis, targets, state, own_target, batch, noise, next_action
            )

        return f

    def move_actor(g: int, k: chex.Array, states: tuple) -> tuple[tuple, chex.Array]:
        """Of member k of a group, against the policies in `states`."""
        own, place, noise = jax.tree.map(lambda leaf: jnp.asarray(leaf)[k], (states[g], places[g], noises[g]))
        batch, group = cut(g, place), layout.groups[g]
        if group.algorithm.critic == "central":
            batch = sequential_actors.by_policies(layout, group, [s.actor for s in states], batch, noise)
        own, loss = _move_actor(layout, group, hyper[g], axis, own, batch, noise)
        after = jax.tree.map(lambda old, one: old.at[k].set(one), states[g], own)
        return (*states[:g], after, *states[g + 1 :]), loss

    if sequential:
        for i in range(layout.num_agents):
            g, k = layout.place(i)
            if layout.groups[g].frozen:
                continue
            args = jax.tree.map(lambda leaf, k=k: leaf[k], (state[g], mu_targets[g], minibatches(g), noises[g]))
            after, m = member(g, mu_targets)(args)
            new[g] = jax.tree.map(lambda old, one, k=k: old.at[k].set(one), new[g], after)
            mu_targets[g] = new[g].actor_target
            metrics = metrics.at[:, i].set(jnp.stack(m))
    else:
        for g, group in enumerate(layout.groups):
            if group.frozen:
                continue
            args = (state[g], mu_targets[g], minibatches(g), noises[g])
            next_action = None
            if rows.shape[0] == 1 and group.algorithm.critic == "central":
                # One minibatch for all: its target actions are the same for every member, so compute them once.
                _, own_target, batch, noise = jax.tree.map(lambda leaf: leaf[0], args)
                batch = cut(g, batch) if one_by_one else batch
                next_action = losses.target_actions(layout, group, hyper[g], mu_targets, own_target, batch, noise)
            new[g], m = _each_member(member(g, mu_targets, next_action), args, one_by_one, rows.shape[1])
            metrics = metrics.at[:, jnp.array(group.members)].set(jnp.stack(m))
    moving = [i for i in layout.learners if move[layout.place(i)[0]]]
    if random_order and moving:
        moved, actor_losses = sequential_actors.move(layout, key, tuple(new), moving, move_actor)
        new = list(moved)
        metrics = metrics.at[2].set(actor_losses)
    return tuple(new), UpdateMetrics(*metrics)


def _each_member(f: Callable, args: chex.ArrayTree, one_by_one: bool, batch: int) -> chex.ArrayTree:
    """`f` of each member of a group, stacked: all at once, or one by one."""
    members = jax.tree.leaves(args)[0].shape[0]
    if one_by_one and members <= UNROLLED_MEMBERS and networks.small_batch(batch):
        # A loop would copy each member's state out of the stack and back, 6 % of an update with 256 transitions.
        each = [f(jax.tree.map(lambda leaf, k=k: leaf[k], args)) for k in range(members)]
        return jax.tree.map(lambda *parts: jnp.stack(parts), *each)
    return jax.lax.map(f, args, batch_size=None if one_by_one else members)


def _update_agent(
    layout: JointLayout,
    group: Group,
    hyper: HyperParams,
    move: bool,
    axis: str | None,
    mu_targets: Sequence[chex.ArrayTree],
    state: GroupState,
    own_target: chex.ArrayTree,
    batch: Minibatch,
    noise: Noise,
    next_action: chex.Array | None = None,
) -> tuple[GroupState, tuple[chex.Array, chex.Array, chex.Array]]:
    """One agent: its state, and (critic loss, Q, actor loss). `state`: without the members' axis; `next_action`: the
    target actions, where they are known already."""
    algorithm = group.algorithm
    if next_action is None:
        next_action = losses.target_actions(layout, group, hyper, mu_targets, own_target, batch, noise)
    y = losses.td_target(layout, group, hyper, state.critic_target, batch, next_action, noise.critics)

    critic_gradient = jax.grad(lambda params: losses.critic_loss(group, params, batch, y), has_aux=True)
    gradients, (loss, q_value) = _mean_over(axis, critic_gradient(state.critic))
    q_params, q_optimizer = optimizer.apply(
        algorithm, state.critic, state.critic_optimizer, gradients, hyper.critic_lr, hyper.max_grad_norm, stack_ndim=1
    )
    state = state._replace(critic=q_params, critic_optimizer=q_optimizer)
    if not move:
        return state, (loss, q_value, jnp.full((), jnp.nan))
    state, mu_loss = _move_actor(layout, group, hyper, axis, state, batch, noise)
    return state, (loss, q_value, mu_loss)


def _move_actor(
    layout: JointLayout,
    group: Group,
    hyper: HyperParams,
    axis: str | None,
    state: GroupState,
    batch: Minibatch,
    noise: Noise,
) -> tuple[GroupState, chex.Array]:
    """Actor and targets of one agent, whose critics have learned already: its state, and the actor loss."""
    algorithm, q_params = group.algorithm, state.critic
    actor_gradient = jax.grad(
        lambda params: losses.actor_loss(layout, group, hyper, params, q_params, batch, noise), has_aux=True
    )
    gradients, mu_loss = _mean_over(axis, actor_gradient(state.actor))
    mu_params, mu_optimizer = optimizer.apply(
        algorithm, state.actor, state.actor_optimizer, gradients, hyper.actor_lr, hyper.max_grad_norm, stack_ndim=0
    )
    # theta' <- tau theta + (1 - tau) theta'
    state = state._replace(
        actor=mu_params,
        actor_optimizer=mu_optimizer,
        actor_target=optax.incremental_update(mu_params, state.actor_target, hyper.tau),
        critic_target=optax.incremental_update(q_params, state.critic_target, hyper.tau),
    )
    if algorithm.actor_average:
        average = optax.incremental_update(mu_params, state.actor_average, algorithm.actor_average)
        state = state._replace(actor_average=average)
    return state, mu_loss


def _mean_over(axis: str | None, tree: chex.ArrayTree) -> chex.ArrayTree:
    """Means over the devices of the axis, as one vector: each array by itself costs a meeting of all devices."""
    if axis is None:
        return tree
    flat, restored = ravel_pytree(tree)
    return restored(jax.lax.pmean(flat, axis))
