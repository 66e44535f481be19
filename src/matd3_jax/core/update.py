"""One update of every agent: who learns when, from the equations in `losses`. For one seed."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp
import optax

from matd3_jax.core import losses, minibatch, networks, optimizer, sequential_actors, team_critic
from matd3_jax.core.agent_update import move_actor, update_agent, update_together
from matd3_jax.core.agents import JointLayout
from matd3_jax.core.algorithm import HyperParams
from matd3_jax.core.frozen import Scale, unscaled
from matd3_jax.core.group import Group
from matd3_jax.core.minibatch import Minibatch, Place

UNROLLED_MEMBERS = 4
"""Members of a group that a program holds one after another, instead of in a loop; more take longer to compile."""


class GroupState(NamedTuple):
    """Networks and optimizers of one group. Leaves have leading axes [networks], critics [networks, critics]: one for
    each member, or one for all (`Group.networks`). A team's one set of critics is in its first group; others have None.
    """

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
    """Entries of what the critics of a group's agents read."""
    if group.algorithm.central:
        return layout.observation_size + layout.action_size
    return group.observation_size + group.action_space.size


def init(layout: JointLayout, key: chex.PRNGKey) -> tuple[GroupState, ...]:
    """Fresh networks and optimizers of all groups; of frozen ones an actor alone, in whose place a given one goes."""

    def one(group: Group, key: chex.PRNGKey) -> GroupState:
        algorithm, keys = group.algorithm, jax.random.split(key, 4)
        inputs = critic_input_size(layout, group) + (0 if group.team_critic else group.index_size)
        if group.frozen:
            mu, nothing = group.init_actor(keys[0]), (None,) * 6
            one = jax.tree.map(lambda leaf: leaf[0], unscaled(1, group.observation_size))
            return GroupState(mu, *nothing, scale=one)  # type: ignore[arg-type]
        mu, q = group.init_actor(keys[0]), group.init_critics(keys[1], inputs)
        if algorithm.sync_targets:
            # Copies, not the same arrays: the state is donated, and one buffer can't be given away twice.
            mu_target, q_target = jax.tree.map(jnp.copy, (mu, q))
        else:
            mu_target, q_target = group.init_actor(keys[2]), group.init_critics(keys[3], inputs)
        adam = optimizer.adam(algorithm.adam)
        average = jax.tree.map(jnp.copy, mu) if algorithm.actor_average else None
        return GroupState(mu, q, mu_target, q_target, adam.init(mu), adam.init(q), average)

    keys = jax.random.split(key, layout.num_agents)
    state = [
        jax.vmap(lambda k, group=group: one(group, k))(keys[jnp.array(group.members[: group.networks])])  # type: ignore[misc]
        for group in layout.groups
    ]
    for g, group in enumerate(layout.groups):
        if group.team_critic:
            first = {part: jax.tree.map(lambda leaf: leaf[:1], getattr(state[g], part)) for part in team_critic.PARTS}
            state[g] = state[g]._replace(**first) if layout.critic_group(g) == g else team_critic.without(state[g])
    return tuple(state)


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
    sequences: chex.Array | None = None,
) -> tuple[tuple[GroupState, ...], UpdateMetrics]:
    """One update of every agent's critics, and of actors and targets where `move` says so.

    Args:
        state, hyper: one element per group.
        rows: replay rows [minibatches, batch, row_size], a minibatch for each agent or for those of a team with one set
            of critics (`JointLayout.minibatches`), or [1, batch, row_size] for all; with n_step > 1 as `n_step.draw`
            gives them.
        move: for each group whether this update moves actors and targets too (every policy_delay-th does).
        sequential: later agents see the earlier ones' moved target actors (the authors' program) instead of all
            learning from the same state; not where agents share a network.
        one_by_one: compute the agents of a group one after another instead of in one batch: the same numbers, while
            one agent's activations stay in a CPU's cache.
        axis: mesh axis whose devices share the work of each minibatch: `rows` are this device's equal part of it (the
            first rows on the first device), gradients are averaged over all. None: one device has the whole.
        frozen_next: what frozen groups do in x' of the rows (`frozen.next_actions`).
        random_order: actors move one after another in random order, after all critics, against the others' policies as
            they are by then instead of their replayed actions (see `sequential_actors`).
        sequences: where anybody is recurrent, the rows with the steps before them [minibatches, sequences, steps,
            row_size]: `rows` are all steps but the first `layout.burn_in`, one sequence after another.
    """
    mu_targets = [group.actor_target for group in state]
    keys = jax.random.split(key, len(layout.groups))
    places = [minibatch.places(layout, group) for group in layout.groups]
    noises = [
        minibatch.draw_noise(layout, group, rows.shape[:2], k, axis) if not group.frozen else None
        for group, k in zip(layout.groups, keys, strict=True)
    ]
    new, metrics = list(state), jnp.full((3, layout.num_agents), jnp.nan)
    own_minibatches = layout.num_minibatches == layout.num_agents

    def cut(g: int, place: Place) -> Minibatch:
        def own(whole: chex.Array) -> chex.Array:
            if rows.shape[0] == 1:
                return whole[0]
            number = place.agent if own_minibatches else jnp.array(layout.minibatches)[place.agent]
            return jax.lax.dynamic_index_in_dim(whole, number, keepdims=False)

        others, histories = jax.tree.map(own, (frozen_next, sequences))
        return minibatch.minibatch(layout, layout.groups[g], own(rows), place, hyper[g].gamma, others, histories)

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
            return update_agent(
                layout, layout.groups[g], hyper[g], moves, axis, targets, state, own_target, batch, noise, next_action
            )

        return f

    def together(
        g: int,
        state: GroupState,
        next_action: chex.Array | None = None,
        critic: chex.ArrayTree | None = None,
        inputs: chex.Array | None = None,
    ) -> tuple[GroupState, tuple]:
        """All members of a group that share their networks; `critic` of their team, and what it reads."""

        def read(batch: Place | Minibatch) -> Minibatch:
            whole = cut(g, batch) if isinstance(batch, Place) else batch
            return whole if inputs is None else whole._replace(inputs=inputs)

        group, own = layout.groups[g], jax.tree.map(lambda leaf: leaf[0], state)
        agents = jnp.arange(len(group.members)), minibatches(g), noises[g]
        how = (one_by_one, _unrolled(len(group.members), rows.shape[1]))
        own, m = update_together(
            layout, group, hyper[g], move[g], axis, mu_targets, own, agents, read, how, next_action, critic
        )
        return jax.tree.map(lambda leaf: leaf[None], own), m

    def of_team(g: int) -> None:
        """The critics of a team whose first group this is, and its actors unless they move later, in `new`."""
        nonlocal metrics
        groups = [h for h in range(len(layout.groups)) if layout.critic_group(h) == g]
        place, noise = jax.tree.map(lambda leaf: jnp.asarray(leaf)[0], (places[g], noises[g]))
        how, common = (hyper[g], move[g], axis, mu_targets), cut(g, place)
        new[g], loss, q_value = team_critic.update(layout, g, *how, state[g], common, noise)
        critic = jax.tree.map(lambda leaf: leaf[0], new[g].critic)
        for h in groups:
            who = jnp.array(layout.groups[h].members)
            metrics = metrics.at[0, who].set(loss).at[1, who].set(q_value)
            if not move[h] or random_order:
                continue
            actors = team_critic.without(state[h])
            if layout.groups[h].shared:
                actors, (*_, mu_loss) = together(h, actors, critic=critic, inputs=common.inputs)
            else:

                def one(args, h=h):
                    own, batch, noise = args
                    batch = (cut(h, batch) if one_by_one else batch)._replace(inputs=common.inputs)
                    return move_actor(layout, layout.groups[h], hyper[h], axis, own, batch, noise, critic)

                args = (actors, minibatches(h), noises[h])
                actors, mu_loss = _each_member(one, args, one_by_one, rows.shape[1])
            new[h] = actors._replace(**{part: getattr(new[h], part) for part in team_critic.PARTS})
            metrics = metrics.at[2, who].set(mu_loss)

    def move_one(g: int, k: chex.Array, states: tuple) -> tuple[tuple, chex.Array]:
        """Actor of member k of a group, against the policies in `states`."""
        own, place, noise = jax.tree.map(lambda leaf: jnp.asarray(leaf)[k], (states[g], places[g], noises[g]))
        batch, group = cut(g, place), layout.groups[g]
        if group.algorithm.central:
            batch = sequential_actors.by_policies(layout, group, [s.actor for s in states], batch, noise)
        critic = jax.tree.map(lambda leaf: leaf[0], new[layout.critic_group(g)].critic) if group.team_critic else None
        own, loss = move_actor(layout, group, hyper[g], axis, own, batch, noise, critic)
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
            if group.team_critic:
                if layout.critic_group(g) == g:
                    of_team(g)
                continue
            args = (state[g], mu_targets[g], minibatches(g), noises[g])
            next_action = None
            if rows.shape[0] == 1 and group.algorithm.central:
                # One minibatch for all: its target actions are the same for every member, so compute them once.
                _, own_target, batch, noise = jax.tree.map(lambda leaf: leaf[0], args)
                batch = cut(g, batch) if one_by_one else batch
                next_action = losses.target_actions(layout, group, hyper[g], mu_targets, own_target, batch, noise)
            if group.shared:
                new[g], m = together(g, state[g], next_action)
            else:
                new[g], m = _each_member(member(g, mu_targets, next_action), args, one_by_one, rows.shape[1])
            metrics = metrics.at[:, jnp.array(group.members)].set(jnp.stack(m))
    moving = [i for i in layout.learners if move[layout.place(i)[0]]]
    if random_order and moving:
        alone = tuple(
            team_critic.without(own) if group.team_critic else own
            for group, own in zip(layout.groups, new, strict=True)
        )
        moved, actor_losses = sequential_actors.move(layout, key, alone, moving, move_one)
        critics = [{part: getattr(own, part) for part in team_critic.PARTS} for own in new]
        new = [
            own._replace(**parts) if group.team_critic else own
            for group, own, parts in zip(layout.groups, moved, critics, strict=True)
        ]
        metrics = metrics.at[2].set(actor_losses)
    return tuple(new), UpdateMetrics(*metrics)


def _each_member(f: Callable, args: chex.ArrayTree, one_by_one: bool, batch: int) -> chex.ArrayTree:
    """`f` of each member of a group, stacked: all at once, or one by one."""
    members = jax.tree.leaves(args)[0].shape[0]
    if one_by_one and _unrolled(members, batch):
        # A loop would copy each member's state out of the stack and back, 6 % of an update with 256 transitions.
        each = [f(jax.tree.map(lambda leaf, k=k: leaf[k], args)) for k in range(members)]
        return jax.tree.map(lambda *parts: jnp.stack(parts), *each)
    return jax.lax.map(f, args, batch_size=None if one_by_one else members)


def _unrolled(members: int, batch: int) -> bool:
    """Whether members that are computed one by one have no loop."""
    return members <= UNROLLED_MEMBERS and networks.small_batch(batch)
