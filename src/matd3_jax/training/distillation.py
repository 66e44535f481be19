"""One agent in a team's place learns by supervision what the team's agents do and what they believe it to be worth.

Policy distillation (Rusu et al. 2016), of the critics, too: the agents' networks side by side (see `handover`) are the
teacher of networks with the usual widths.
"""

from functools import partial
from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import PartitionSpec as P

from matd3_jax.core import minibatch, optimizer, replay
from matd3_jax.core.group import Group
from matd3_jax.core.networks import apply
from matd3_jax.core.update import GroupState
from matd3_jax.training.loop import TrainLoop
from matd3_jax.training.state import TrainState

APART = 1
"""Folded into a seed's key, which goes on as it was."""


class Teacher(NamedTuple):
    """Whose actions and values one agent learns."""

    group: Group
    """Its networks' shape; it sees and does what the one agent does."""
    actor: chex.ArrayTree
    """Leaves [seeds, 1, ...], as in a state."""
    critic: chex.ArrayTree


class Fit(NamedTuple):
    """How well the teacher was met, [seeds, updates] each, on each update's minibatch before the update."""

    actor_loss: chex.Array
    """Mean of `Policy.distance`."""
    critic_loss: chex.Array
    """Mean squared difference of the values, over all critics."""
    variance: chex.Array
    """Of the teacher's values."""

    def line(self, name: str) -> str:
        """One line about the agent `name`: means over the seeds and the last tenth of the updates."""
        last = max(1, self.actor_loss.shape[1] // 10)
        actor, critic, variance = (float(np.mean(part[:, -last:])) for part in self)
        explained = 100 * (1 - critic / variance) if variance else np.nan
        return (
            f"{name}: fitted to what the agents did in {self.actor_loss.shape[1]:,} updates; actor loss {actor:.2g}, "
            f"values explain {explained:.1f} % of the variance of the agents'"
        )


def distill(trainer: TrainLoop, state: TrainState, g: int, teacher: Teacher, updates: int) -> tuple[TrainState, Fit]:
    """Fit the networks of the one agent of group `g` to those of its teacher, on the replay of each seed.

    Each update takes `batch_size` replayed observations: the actor meets the teacher's actions in them, the critics its
    values of the replayed actions and of its own. Targets and the averaged actor begin as copies of what was learned,
    the optimizers afresh.
    """
    local = partial(_local, trainer, g, teacher.group, updates)
    given = trainer.specs, P("seeds"), P("seeds"), P("seeds")
    fit = jax.jit(trainer.sharding.sharded(local, given, P("seeds")))
    (actor, critic), found = fit(state, teacher.actor, teacher.critic, trainer.hyper[g])
    old = state.groups[g]
    copy = partial(jax.tree.map, jnp.copy)  # the state is donated, and one buffer can't be given away twice
    new: GroupState = old._replace(
        actor=actor,
        critic=critic,
        actor_target=copy(actor),
        critic_target=copy(critic),
        actor_average=None if old.actor_average is None else copy(actor),
    )
    return state._replace(groups=(*state.groups[:g], new, *state.groups[g + 1 :])), found


def _local(trainer: TrainLoop, g: int, taught: Group, updates: int, state: TrainState, actors, critics, hypers):
    """The seeds of one device: ((actor, critic), fit)."""
    layout, learner, schedule = trainer.layout, trainer.learner, trainer.schedule
    group, algorithm = layout.groups[g], layout.groups[g].algorithm
    place = jax.tree.map(lambda leaf: leaf[0], minibatch.places(layout, group))
    size = replay.filled(schedule.replay_capacity, schedule.rollout_steps, state.rollouts)
    adam = optimizer.adam(algorithm.adam)

    def one(args):
        seed, key, networks, actor, critic, hyper = args
        networks, actor, critic = jax.tree.map(lambda leaf: leaf[0], (networks, actor, critic))  # one member

        def update(carry, key):
            (mine, values), (mine_state, values_state) = carry
            index_key, action_key = jax.random.split(key)
            indices = replay.sample_indices(index_key, size, (schedule.batch_size,))
            rows = learner.normalized(state, seed, replay.gather(state.replay, seed, indices))
            batch = minibatch.minibatch(layout, group, rows, place, hyper.gamma)
            wanted = apply(taught.actor, actor, batch.observation)
            action = group.policy.sample(wanted, group.policy.own_noise(action_key, wanted.shape[:-1]))
            own = jax.lax.dynamic_update_slice_in_dim(batch.inputs, action, batch.action_column, axis=-1)
            inputs = jnp.concatenate([batch.inputs, own])
            theirs = taught.critic.values(critic, inputs)

            def actor_loss(params):
                return group.policy.distance(apply(group.actor, params, batch.observation), wanted).mean()

            def critic_loss(params):
                each = jnp.square(group.critic.values(params, inputs) - theirs).mean(axis=-1)
                return each.sum(), each.mean()

            a_loss, a_gradient = jax.value_and_grad(actor_loss)(mine)
            (_, c_loss), c_gradient = jax.value_and_grad(critic_loss, has_aux=True)(values)
            norm = hyper.max_grad_norm
            mine, mine_state = optimizer.apply(algorithm, mine, mine_state, a_gradient, hyper.actor_lr, norm, 0)
            values, values_state = optimizer.apply(
                algorithm, values, values_state, c_gradient, hyper.critic_lr, norm, 1
            )
            return ((mine, values), (mine_state, values_state)), Fit(a_loss, c_loss, theirs.var())

        begin = networks.actor, networks.critic
        keys = jax.random.split(jax.random.fold_in(key, APART), updates)
        (found, _), fit = jax.lax.scan(update, (begin, (adam.init(begin[0]), adam.init(begin[1]))), keys)
        return jax.tree.map(lambda leaf: leaf[None], found), fit

    seeds = jnp.arange(state.key.shape[0])
    per_seed = seeds, state.key, state.groups[g], actors, critics, hypers
    return jax.lax.map(one, per_seed, batch_size=trainer.sharding.seeds_together)
