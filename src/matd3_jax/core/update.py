"""One update of every agent: targets, critic and actor losses. The paper's equations, for one seed.

Symbols (paper, section 4): x joint observation, o_i agent i's part, a joint action, mu actor, Q critic, primes targets.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.flatten_util import ravel_pytree

from matd3_jax.core import networks, optimizer
from matd3_jax.core.agents import Group, Spec
from matd3_jax.core.algorithm import HyperParams
from matd3_jax.envs.spaces import ActionSpace

UNROLLED_MEMBERS = 4
"""Members of a group that a program holds one after another, instead of in a loop; more take longer to compile."""


class GroupState(NamedTuple):
    """Networks and optimisers of one group. Leaves have leading axes [members], critics [members, critics]."""

    actor: chex.ArrayTree
    critic: chex.ArrayTree
    actor_target: chex.ArrayTree
    critic_target: chex.ArrayTree
    actor_optimiser: optax.OptState
    critic_optimiser: optax.OptState
    actor_average: chex.ArrayTree | None = None
    """With `Algorithm.actor_average` alone."""


class UpdateMetrics(NamedTuple):
    """Of one update, [num_agents] each."""

    critic_loss: chex.Array
    """Mean squared error, averaged over the critics of the agent."""
    q_value: chex.Array
    """Mean value that the first critic gives to the replayed joint actions."""
    actor_loss: chex.Array
    """NaN where this update left the actor alone."""


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
    """[batch] r_i; with n_step > 1 the return's sum of discounted rewards."""
    discount: chex.Array
    """[batch] 0 where the episode terminated, else 1; with n_step > 1 times gamma^(m - 1)."""
    next_observations: tuple[chex.Array, ...]
    """o' of those whose target actors the target needs, one array [agents, batch, observation size] per group."""
    next_x: chex.Array
    """[batch, critic inputs without actions] x', or o'_i."""
    action_column: chex.Array | int
    """Where a_i stands in `inputs`."""


class Noise(NamedTuple):
    """All random numbers of one agent's update; a leading axis [members] for several."""

    target: tuple[chex.Array | None, ...]
    """Of the target actors' own sampling, [agents, batch, action size] per group of `next_observations`."""
    smoothing: tuple[chex.Array | None, ...]
    """Standard normal, of the same shapes; None without smoothing."""
    action: chex.Array | None
    """[batch, action size] of the own new action."""


def actor_of(group: Group) -> networks.StackedMLP:
    """The actors of a whole group, [members] stacked."""
    return networks.actor_network((len(group.members),), group.algorithm.hidden, group.action_space)


def critic_input_size(spec: Spec, group: Group) -> int:
    if group.algorithm.critic == "central":
        return spec.observation_size + spec.action_size
    return group.observation_size + group.action_space.size


def init(spec: Spec, key: chex.PRNGKey) -> tuple[GroupState, ...]:
    """Fresh networks and optimisers of all groups."""

    def one(group: Group, key: chex.PRNGKey) -> GroupState:
        algorithm, keys = group.algorithm, jax.random.split(key, 4)
        actor = networks.actor_network((), algorithm.hidden, group.action_space)
        critic = networks.critic_network(algorithm.num_critics, algorithm.hidden)
        observation = jnp.zeros((1, group.observation_size))
        inputs = jnp.zeros((1, critic_input_size(spec, group)))
        mu, q = actor.init(keys[0], observation)["params"], critic.init(keys[1], inputs)["params"]
        if algorithm.sync_targets:
            # Copies, not the same arrays: the state is donated, and one buffer can't be given away twice.
            mu_target, q_target = jax.tree.map(jnp.copy, (mu, q))
        else:
            mu_target = actor.init(keys[2], observation)["params"]
            q_target = critic.init(keys[3], inputs)["params"]
        adam = optimizer.adam(algorithm.adam)
        average = jax.tree.map(jnp.copy, mu) if algorithm.actor_average else None
        return GroupState(mu, q, mu_target, q_target, adam.init(mu), adam.init(q), average)

    keys = jax.random.split(key, spec.num_agents)
    return tuple(
        jax.vmap(lambda k, group=group: one(group, k))(keys[jnp.array(group.members)])  # type: ignore[misc]
        for group in spec.groups
    )


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
    one_by_one: bool = False,
    axis: str | None = None,
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
    """
    mu_targets = [group.actor_target for group in state]
    keys = jax.random.split(key, len(spec.groups))
    places = [_places(spec, group) for group in spec.groups]
    noises = [_noise(spec, group, rows.shape[:2], k, axis) for group, k in zip(spec.groups, keys, strict=True)]
    new, metrics = list(state), jnp.full((3, spec.num_agents), jnp.nan)

    def cut(g: int, place: Place) -> Minibatch:
        own = rows[0] if rows.shape[0] == 1 else jax.lax.dynamic_index_in_dim(rows, place.agent, keepdims=False)
        return _minibatch(spec, spec.groups[g], own, place, hyper[g].gamma)

    def minibatches(g: int) -> Place | Minibatch:
        """Of all members, stacked; one by one each is cut out in its turn, as all N together hold N times N parts."""
        if one_by_one:
            return places[g]
        members = range(len(spec.groups[g].members))
        return jax.tree.map(
            lambda *m: jnp.stack(m), *(cut(g, jax.tree.map(lambda p, k=k: p[k], places[g])) for k in members)
        )

    def member(g: int, targets: Sequence[chex.ArrayTree], next_action: chex.Array | None = None):
        def f(args):
            state, own_target, batch, noise = args
            batch = cut(g, batch) if one_by_one else batch
            return _update_agent(
                spec, spec.groups[g], hyper[g], move[g], axis, targets, state, own_target, batch, noise, next_action
            )

        return f

    if sequential:
        for i in range(spec.num_agents):
            g, k = spec.place(i)
            args = jax.tree.map(lambda leaf, k=k: leaf[k], (state[g], mu_targets[g], minibatches(g), noises[g]))
            after, m = member(g, mu_targets)(args)
            new[g] = jax.tree.map(lambda old, one, k=k: old.at[k].set(one), new[g], after)
            mu_targets[g] = new[g].actor_target
            metrics = metrics.at[:, i].set(jnp.stack(m))
    else:
        for g, group in enumerate(spec.groups):
            args = (state[g], mu_targets[g], minibatches(g), noises[g])
            next_action = None
            if rows.shape[0] == 1 and group.algorithm.critic == "central":
                # One minibatch for all: its target actions are the same for every member, so compute them once.
                _, own_target, batch, noise = jax.tree.map(lambda leaf: leaf[0], args)
                batch = cut(g, batch) if one_by_one else batch
                next_action = _target_actions(spec, group, hyper[g], mu_targets, own_target, batch, noise)
            new[g], m = _each_member(member(g, mu_targets, next_action), args, one_by_one, rows.shape[1])
            metrics = metrics.at[:, jnp.array(group.members)].set(jnp.stack(m))
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
    spec: Spec,
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
    """One agent: (its state, (critic loss, Q, actor loss)). `state`: without the members' axis; `next_action`: the
    target actions, where they are known already."""
    algorithm, space = group.algorithm, group.action_space
    actor = networks.actor_network((), algorithm.hidden, space)
    critic = networks.critic_network(algorithm.num_critics, algorithm.hidden)

    if next_action is None:
        next_action = _target_actions(spec, group, hyper, mu_targets, own_target, batch, noise)

    # y_i = r_i + gamma * min_j Q'_ij(x', a'_1, ..., a'_N)
    next_inputs = jnp.concatenate([batch.next_x, next_action], axis=-1)
    next_q = apply(critic, state.critic_target, next_inputs)[..., 0].min(axis=0)
    reward = batch.reward if algorithm.reward_scale == 1 else algorithm.reward_scale * batch.reward
    y = reward + hyper.gamma * batch.discount * next_q

    def critic_loss(params):
        q = apply(critic, params, batch.inputs)[..., 0]
        loss = jnp.mean(jnp.square(q - y), axis=-1)
        return loss.sum(), (loss.mean(), q[0].mean())

    gradients, (loss, q_value) = _mean_over(axis, jax.grad(critic_loss, has_aux=True)(state.critic))
    q_params, q_optimiser = optimizer.apply(
        algorithm, state.critic, state.critic_optimiser, gradients, hyper.critic_lr, hyper.max_grad_norm, stack_ndim=1
    )
    state = state._replace(critic=q_params, critic_optimiser=q_optimiser)
    if not move:
        return state, (loss, q_value, jnp.full((), jnp.nan))

    # -E[Q_i1(x, a_1, ..., mu_i(o_i), ..., a_N)] + regulariser: the own action anew, the others' from the replay
    first = networks.critic_network(1, algorithm.hidden)
    q1_params = jax.tree.map(lambda p: p[:1], q_params)

    def actor_loss(params):
        output = apply(actor, params, batch.observation)
        action = networks.act(space, output, noise.action, squash=algorithm.actor_output)
        q1 = apply(first, q1_params, batch.inputs, action - batch.action, batch.action_column)
        loss = -q1.mean() + hyper.logit_regulariser * jnp.mean(jnp.square(output))
        return loss, loss

    gradients, mu_loss = _mean_over(axis, jax.grad(actor_loss, has_aux=True)(state.actor))
    mu_params, mu_optimiser = optimizer.apply(
        algorithm, state.actor, state.actor_optimiser, gradients, hyper.actor_lr, hyper.max_grad_norm, stack_ndim=0
    )
    # theta' <- tau theta + (1 - tau) theta'
    state = state._replace(
        actor=mu_params,
        actor_optimiser=mu_optimiser,
        actor_target=optax.incremental_update(mu_params, state.actor_target, hyper.tau),
        critic_target=optax.incremental_update(q_params, state.critic_target, hyper.tau),
    )
    if algorithm.actor_average:
        average = optax.incremental_update(mu_params, state.actor_average, algorithm.actor_average)
        state = state._replace(actor_average=average)
    return state, (loss, q_value, mu_loss)


def _mean_over(axis: str | None, tree: chex.ArrayTree) -> chex.ArrayTree:
    """Means over the devices of the axis, as one vector: each array by itself costs a meeting of all devices."""
    if axis is None:
        return tree
    flat, restored = ravel_pytree(tree)
    return restored(jax.lax.pmean(flat, axis))


def _target_actions(
    spec: Spec,
    group: Group,
    hyper: HyperParams,
    mu_targets: Sequence[chex.ArrayTree],
    own_target: chex.ArrayTree,
    batch: Minibatch,
    noise: Noise,
) -> chex.Array:
    """a'_j = mu'_j(o'_j) + epsilon, one sample for all critics of an agent: [batch, action size], joint or own."""
    if group.algorithm.critic == "central":
        others = [(other, params, actor_of(other)) for other, params in zip(spec.groups, mu_targets, strict=True)]
    else:
        own = networks.actor_network((), group.algorithm.hidden, group.action_space)
        others = [(group, own_target, own)]
    parts = []
    for j, (other, params, network) in enumerate(others):
        space = other.action_space
        output, squash = apply(network, params, batch.next_observations[j]), other.algorithm.actor_output
        part = networks.act(space, output, noise.target[j], squash=squash)
        if noise.smoothing[j] is not None:
            part = networks.smooth(space, part, noise.smoothing[j], hyper.target_noise, hyper.target_noise_clip)
        parts.append(part)
    return spec.join_actions(parts) if group.algorithm.critic == "central" else parts[0]


def _places(spec: Spec, group: Group) -> Place:
    """Of all members, leaves [members]."""
    members = np.array(group.members)
    return Place(members, np.array(spec.observation_starts)[members], np.array(spec.action_starts)[members])


def _minibatch(spec: Spec, group: Group, rows: chex.Array, place: Place, gamma: chex.Array | float) -> Minibatch:
    """The minibatch of one member from its rows [batch, row_size]."""
    central = group.algorithm.critic == "central"
    parts = spec.row_parts(rows)

    def part(whole: chex.Array, start: chex.Array, size: int) -> chex.Array:
        return jax.lax.dynamic_slice_in_dim(whole, start, size, axis=-1)

    observation = part(parts.x, place.observation, group.observation_size)
    action = part(parts.action, place.action, group.action_space.size)
    own_next = part(parts.next_x, place.observation, group.observation_size)
    every_next = tuple(
        jnp.stack([spec.observation_part(parts.next_x, j) for j in other.members]) for other in spec.groups
    )
    return Minibatch(
        observation=observation,
        action=action,
        inputs=parts.inputs if central else jnp.concatenate([observation, action], axis=-1),
        reward=part(parts.reward, place.agent, 1)[..., 0],
        discount=parts.discount if parts.more is None else parts.discount * gamma**parts.more,
        next_observations=every_next if central else (own_next,),
        next_x=parts.next_x if central else own_next,
        action_column=spec.observation_size + place.action if central else group.observation_size,
    )


def _noise(spec: Spec, group: Group, shape: tuple[int, int], key: chex.PRNGKey, axis: str | None) -> Noise:
    """The random numbers of a group's members; `shape`: minibatches (1: shared) and their size, on each device of
    `axis` (which draws those of the whole minibatch, as one device would, and takes its own)."""
    batches, local = shape
    size = local * (1 if axis is None else jax.lax.axis_size(axis))
    members = len(group.members)
    action_key, target_key, smooth_key = jax.random.split(key, 3)
    wanted: list[tuple[ActionSpace, tuple[int, ...]]]
    if group.algorithm.critic == "central":
        wanted = [(other.action_space, (len(other.members), size)) for other in spec.groups]
    else:
        wanted, batches = [(group.action_space, (size,))], members  # nobody shares an own action

    def draws(draw, key):
        drawn = []
        for j, (space, lead) in enumerate(wanted):
            one = draw(jax.random.fold_in(key, j), space, (1 if batches == 1 else members, *lead))
            # With a shared minibatch all agents look at the same target actions.
            drawn.append(None if one is None else jnp.broadcast_to(one, (members, *one.shape[1:])))
        return tuple(drawn)

    def normal(key, space, lead):
        return networks.flat_draw(jax.random.normal, key, (*lead, space.size)) if group.algorithm.smoothing else None

    noise = Noise(
        target=draws(networks.policy_noise, target_key),
        smoothing=draws(normal, smooth_key),
        action=networks.policy_noise(action_key, group.action_space, (members, size)),
    )
    return jax.tree.map(lambda draw: own_part(draw, axis, dimension=-2), noise)


def own_part(whole: chex.Array, axis: str | None, dimension: int) -> chex.Array:
    """This device's equal part of an array along `dimension`, one of as many as the mesh axis has devices."""
    if axis is None:
        return whole
    size = whole.shape[dimension] // jax.lax.axis_size(axis)
    return jax.lax.dynamic_slice_in_dim(whole, jax.lax.axis_index(axis) * size, size, dimension)
