"""One update of every agent: targets, critic and actor losses. The paper's equations, for one seed.

Symbols (paper, section 4): x joint observation, o_i agent i's part, a joint action, mu actor, Q critic, primes targets.
"""

from collections.abc import Sequence
from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp
import optax

from matd3_jax import networks, optimiser
from matd3_jax.algorithms import HyperParams
from matd3_jax.spec import Block, Group, RowParts, Spec


class GroupState(NamedTuple):
    """Networks and optimisers of one group; parameters have leading axes [members] (actor), [members, critics] (critic)."""

    actor: chex.ArrayTree
    critic: chex.ArrayTree
    actor_target: chex.ArrayTree
    critic_target: chex.ArrayTree
    actor_optimiser: optax.OptState
    critic_optimiser: optax.OptState


class UpdateMetrics(NamedTuple):
    """Of one update, [num_agents] each."""

    critic_loss: chex.Array
    """Mean squared error, averaged over the critics of the agent."""
    q_value: chex.Array
    """Mean value that the first critic gives to the replayed joint actions."""
    actor_loss: chex.Array
    """NaN where this update left the actor alone."""


def actor_of(group: Group) -> networks.StackedMLP:
    return networks.actor_network(len(group.members), group.algorithm.hidden, group.action_space)


def critic_of(group: Group) -> networks.StackedMLP:
    return networks.critic_network(len(group.members), group.algorithm.num_critics, group.algorithm.hidden)


def critic_input_size(spec: Spec, group: Group) -> int:
    if group.algorithm.critic == "central":
        return spec.observation_size + spec.action_size
    return group.observation_size + group.action_space.size


def init(spec: Spec, key: chex.PRNGKey) -> tuple[GroupState, ...]:
    """Fresh networks and optimisers of all groups."""

    def one(group: Group, key: chex.PRNGKey) -> GroupState:
        keys = jax.random.split(key, 4)
        members = len(group.members)
        observation = jnp.zeros((members, 1, group.observation_size))
        inputs = jnp.zeros((members, 1, critic_input_size(spec, group)))
        actor, critic = actor_of(group), critic_of(group)
        mu, q = actor.init(keys[0], observation)["params"], critic.init(keys[1], inputs)["params"]
        if group.algorithm.sync_targets:
            # Copies, not the same arrays: the state is donated, and one buffer can't be given away twice.
            mu_target, q_target = jax.tree.map(jnp.copy, (mu, q))
        else:
            mu_target = actor.init(keys[2], observation)["params"]
            q_target = critic.init(keys[3], inputs)["params"]
        adam = optimiser.adam(group.algorithm.adam)
        return GroupState(mu, q, mu_target, q_target, adam.init(mu), adam.init(q))

    keys = jax.random.split(key, len(spec.groups))
    return tuple(one(group, k) for group, k in zip(spec.groups, keys, strict=True))


def apply(network: networks.StackedMLP, params: chex.ArrayTree, *args) -> chex.Array:
    return network.apply({"params": params}, *args)  # type: ignore[return-value]


def update(
    spec: Spec,
    state: tuple[GroupState, ...],
    hyper: Sequence[HyperParams],
    rows: chex.Array,
    key: chex.PRNGKey,
    move: Sequence[bool],
    sequential: bool = False,
) -> tuple[tuple[GroupState, ...], UpdateMetrics]:
    """One update of every agent's critics, and of actors and targets where `move` says so.

    Args:
        state, hyper: one element per group.
        rows: replay rows [num_agents, batch, row_size], a minibatch for each agent, or [1, batch, row_size], one for all.
        move: for each group whether this update moves actors and targets too (every policy_delay-th does).
        sequential: update the agents one after another, later ones with the earlier ones' moved targets (the authors'
            program) instead of all from the same state.
    """
    mu_targets = [group.actor_target for group in state]
    new = list(state)
    metrics = jnp.full((3, spec.num_agents), jnp.nan)
    shared = rows.shape[0] == 1
    for number, block in enumerate(spec.blocks(sequential)):
        members = spec.members(block)
        batch = spec.row_parts(rows if shared else rows[jnp.array(members)])
        before = _slice(state[block.group], block)
        after, block_metrics = _update_block(
            spec,
            block,
            before,
            mu_targets,
            hyper[block.group],
            batch,
            jax.random.fold_in(key, number),
            move[block.group],
        )
        new[block.group] = _put(new[block.group], block, after)
        if sequential:
            mu_targets[block.group] = new[block.group].actor_target
        metrics = metrics.at[:, jnp.array(members)].set(jnp.stack(block_metrics))
    return tuple(new), UpdateMetrics(*metrics)


def _update_block(
    spec: Spec,
    block: Block,
    state: GroupState,
    mu_targets: Sequence[chex.ArrayTree],
    hyper: HyperParams,
    batch: RowParts,
    key: chex.PRNGKey,
    move: bool,
) -> tuple[GroupState, UpdateMetrics]:
    group = spec.groups[block.group]
    members = spec.members(block)
    algorithm, m = group.algorithm, len(spec.members(block))
    actor = networks.actor_network(m, algorithm.hidden, group.action_space)
    critic = networks.critic_network(m, algorithm.num_critics, algorithm.hidden)
    target_key, action_key = jax.random.split(key)

    # y_i = r_i + gamma * min_j Q'_ij(x', mu'_1(o'_1) + epsilon, ..., mu'_N(o'_N) + epsilon)
    next_inputs = _next_inputs(spec, block, mu_targets, hyper, batch, target_key)
    next_q = apply(critic, state.critic_target, next_inputs)[..., 0].min(axis=1)
    reward = jnp.moveaxis(batch.reward[..., list(members)], -1, 0)
    reward = reward[:, 0] if batch.reward.shape[0] == 1 else _diagonal(reward)
    y = reward + hyper.gamma * batch.discount * next_q

    def critic_loss(params):
        q = apply(critic, params, _inputs(spec, block, batch))[..., 0]
        loss = jnp.mean(jnp.square(q - y[:, None, :]), axis=-1)
        return loss.sum(), (loss.mean(axis=1), q[:, 0].mean(axis=-1))

    gradients, (losses, q_values) = jax.grad(critic_loss, has_aux=True)(state.critic)
    q_params, q_optimiser = optimiser.apply(
        algorithm, state.critic, state.critic_optimiser, gradients, hyper.critic_lr, hyper.max_grad_norm, stack_ndim=2
    )
    state = state._replace(critic=q_params, critic_optimiser=q_optimiser)
    if not move:
        return state, UpdateMetrics(losses, q_values, jnp.full(m, jnp.nan))

    # -E[Q_i1(x, a_1, ..., mu_i(o_i), ..., a_N)] + regulariser: the own action anew, the others' from the replay
    observation = _own(spec, batch.x, members, spec.observation_part)
    draw = networks.policy_noise(action_key, group.action_space, observation.shape[:-1])
    replayed = _own(spec, batch.action, members, spec.action_part)
    first = networks.critic_network(m, 1, algorithm.hidden)
    q1_params = jax.tree.map(lambda p: p[:, :1], state.critic)
    inputs = _inputs(spec, block, batch)
    if algorithm.critic == "central":
        starts = [spec.observation_size + spec.action_starts[i] for i in members]
    else:
        starts = [group.observation_size] * m

    def actor_loss(params):
        output = apply(actor, params, observation)
        action = networks.act(group.action_space, output, draw)
        q1 = apply(first, q1_params, inputs, ((action - replayed)[:, None], starts))
        loss = -q1[:, 0, :, 0].mean(axis=-1) + hyper.logit_regulariser * jnp.mean(jnp.square(output), axis=(-2, -1))
        return loss.sum(), loss

    gradients, actor_losses = jax.grad(actor_loss, has_aux=True)(state.actor)
    mu_params, mu_optimiser = optimiser.apply(
        algorithm, state.actor, state.actor_optimiser, gradients, hyper.actor_lr, hyper.max_grad_norm, stack_ndim=1
    )
    # theta' <- tau theta + (1 - tau) theta'
    state = state._replace(
        actor=mu_params,
        actor_optimiser=mu_optimiser,
        actor_target=optax.incremental_update(mu_params, state.actor_target, hyper.tau),
        critic_target=optax.incremental_update(q_params, state.critic_target, hyper.tau),
    )
    return state, UpdateMetrics(losses, q_values, actor_losses)


def _next_inputs(
    spec: Spec,
    block: Block,
    mu_targets: Sequence[chex.ArrayTree],
    hyper: HyperParams,
    batch: RowParts,
    key: chex.PRNGKey,
) -> chex.Array:
    """What the target critics of a block read: [members or 1, batch, critic inputs], the target actors' actions sampled
    once for all critics of an agent."""
    group = spec.groups[block.group]
    smoothing = group.algorithm.smoothing
    act_key, smooth_key = jax.random.split(key)

    def actions(other: Group, params: chex.ArrayTree, observation: chex.Array, number: int) -> chex.Array:
        """[agents, ..., batch, action size] for observations of the same leading axes."""
        space, lead = other.action_space, observation.shape[:-1]
        flat = observation.reshape(lead[0], -1, observation.shape[-1])
        network = networks.actor_network(lead[0], other.algorithm.hidden, space)
        output = apply(network, params, flat).reshape(*lead, space.size)
        action = networks.act(space, output, networks.policy_noise(jax.random.fold_in(act_key, number), space, lead))
        if smoothing:
            draw = jax.random.normal(jax.random.fold_in(smooth_key, number), action.shape)
            action = networks.smooth(space, action, draw, hyper.target_noise, hyper.target_noise_clip)
        return action

    if group.algorithm.critic == "own":
        observation = _own(spec, batch.next_x, spec.members(block), spec.observation_part)
        params = _slice(mu_targets[block.group], block)
        return jnp.concatenate([observation, actions(group, params, observation, 0)], axis=-1)
    parts = [
        actions(other, params, spec.stack_observations(batch.next_x, other.members), number)
        for number, (other, params) in enumerate(zip(spec.groups, mu_targets, strict=True))
    ]
    joint = jnp.concatenate([batch.next_x, spec.join_actions(parts)], axis=-1)
    return joint[0] if joint.shape[0] == 1 < len(spec.members(block)) else joint


def _inputs(spec: Spec, block: Block, batch: RowParts) -> chex.Array:
    """What the critics of a block read of replayed transitions: [members, batch, inputs], or [batch, inputs] for all."""
    members = spec.members(block)
    if spec.groups[block.group].algorithm.critic == "own":
        observation = _own(spec, batch.x, members, spec.observation_part)
        return jnp.concatenate([observation, _own(spec, batch.action, members, spec.action_part)], axis=-1)
    return batch.inputs[0] if batch.inputs.shape[0] == 1 < len(members) else batch.inputs


def _own(spec: Spec, joint: chex.Array, members: Sequence[int], part) -> chex.Array:
    """Each member's own part [members, batch, size] of its own minibatch in joint [members or 1, batch, joint size]."""
    shared = joint.shape[0] == 1
    return jnp.stack([part(joint[0 if shared else k], i) for k, i in enumerate(members)])


def _diagonal(x: chex.Array) -> chex.Array:
    """x [members, members, ...] to x[k, k]: each member's entry of its own minibatch."""
    return jnp.stack([x[k, k] for k in range(x.shape[0])])


def _slice(tree: chex.ArrayTree, block: Block) -> chex.ArrayTree:
    return jax.tree.map(lambda leaf: leaf[block.start : block.stop] if leaf.ndim else leaf, tree)


def _put(state: GroupState, block: Block, part: GroupState) -> GroupState:
    def put(old, new):
        if not old.ndim or old.shape == new.shape:
            return new
        return old.at[block.start : block.stop].set(new)

    return jax.tree.map(put, state, part)
