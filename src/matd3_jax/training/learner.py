"""The updates after a rollout: minibatches from the replay, one seed after another or side by side."""

import math
from collections.abc import Sequence
from functools import partial

import chex
import jax
import jax.numpy as jnp

from matd3_jax.core import frozen, minibatch, n_step, replay, running_statistics, update
from matd3_jax.core.agents import JointLayout
from matd3_jax.core.algorithm import HyperParams
from matd3_jax.core.running_statistics import Statistics
from matd3_jax.core.update import UpdateMetrics
from matd3_jax.training.schedule import Schedule
from matd3_jax.training.sharding import SeedSharding, stack, unstack
from matd3_jax.training.state import TrainState


class Learner:
    """Makes the updates of the seeds of one device.

    Args:
        layout: agents and algorithms.
        least_deviation: of what observations are normalized by.
        unroll: updates that one pass of their compiled loop holds.
    """

    def __init__(
        self, layout: JointLayout, schedule: Schedule, sharding: SeedSharding, least_deviation: float, unroll: int
    ):
        self.layout, self.schedule, self.sharding = layout, schedule, sharding
        self.least_deviation, self.unroll = least_deviation, unroll

    @property
    def period(self) -> int:
        """Updates after which every group's policy delay has come round."""
        return math.lcm(*(group.algorithm.policy_delay for group in self.layout.learning_groups))

    @property
    def sequence_steps(self) -> int:
        """Env steps of what recurrent networks take at a time."""
        return self.layout.burn_in + self.layout.sequence_length

    def scale(self, state: TrainState) -> Statistics | None:
        """What observations are normalized by: running statistics, with the least deviation that is set."""
        if state.statistics is None or not self.least_deviation:
            return state.statistics
        return running_statistics.floored(state.statistics, self.least_deviation)

    def learn(self, state: TrainState, hyper, first: int) -> tuple[TrainState, UpdateMetrics]:
        """Make the updates after one rollout, `seeds_together` of the local seeds at a time; `first`: number of the
        first of them."""
        schedule, groups = self.schedule, self.layout.groups
        size = replay.filled(schedule.replay_capacity, schedule.rollout_steps, state.rollouts)
        places, drawn = size, schedule.batch_size
        if self.layout.recurrent:
            places = size - (self.sequence_steps - 1) * schedule.num_envs
            drawn //= self.layout.sequence_length
        batches = 1 if schedule.shared_minibatch else self.layout.num_minibatches
        unrolled = math.gcd(self.period, schedule.updates_per_collect)
        axis = self.sharding.minibatch_axis

        def period(seed, hyper, carry, keys):
            states, metrics = carry, []
            for u in range(unrolled):
                index_key, update_key = jax.random.split(keys[u])
                indices = replay.sample_indices(index_key, places, (batches, drawn))
                raw = self._drawn(state, hyper, seed, minibatch.own_part(indices, axis, dimension=-1))
                others = frozen.next_actions(self.layout, states, self._learned(raw))
                normalized = self.normalized(state, seed, raw)
                rows, sequences = self._learned(normalized), normalized if self.layout.recurrent else None
                move = [(first + u + 1) % group.algorithm.policy_delay == 0 for group in groups]
                how = (schedule.sequential, self.sharding.on_cpu, axis, others, schedule.random_order, sequences)
                states, m = update.update(self.layout, states, hyper, rows, update_key, move, *how)
                metrics.append(m)
            return states, jax.tree.map(lambda *m: jnp.stack(m), *metrics)

        def one(args):
            seed, states, key, hyper, stopped = args
            if stopped is None or axis is not None:  # a branch that some devices alone take must not talk to others
                return learned(seed, states, key, hyper)
            nothing = jax.tree.map(
                lambda leaf: jnp.full(leaf.shape, jnp.nan), jax.eval_shape(learned, seed, states, key, hyper)[1]
            )
            return jax.lax.cond(stopped, lambda: (states, nothing), lambda: learned(seed, states, key, hyper))

        def learned(seed, states, key, hyper):
            keys = jax.random.split(key, schedule.updates_per_collect).reshape(-1, unrolled)
            if keys.shape[0] == 1:
                states, metrics = period(seed, hyper, states, keys[0])
            else:
                states, metrics = jax.lax.scan(partial(period, seed, hyper), states, keys, unroll=self.unroll)
            return states, jax.tree.map(lambda m: m.reshape(-1, m.shape[-1]), metrics)

        keys = jax.vmap(partial(jax.random.split, num=2))(state.key)
        seeds = jnp.arange(keys.shape[0])
        if isinstance(state.groups, list):
            rest = unstack((seeds, keys[:, 0], hyper, state.stopped), len(state.groups))
            found = [one((seed, g, *own)) for g, (seed, *own) in zip(state.groups, rest, strict=True)]
            states, metrics = [networks for networks, _ in found], stack([m for _, m in found])
        else:
            together = self.sharding.seeds_together
            per_seed = seeds, state.groups, keys[:, 0], hyper, state.stopped
            states, metrics = jax.lax.map(one, per_seed, batch_size=together)
        # The next rollout writes where these updates read. Where the actor is delayed nothing else makes XLA do one
        # after the other, and it would copy the whole replay: so let the count of rollouts, hence the next write's
        # offset, depend on the updates. A mean squared error is never negative; XLA does not know.
        wait = jnp.any(metrics.critic_loss < 0).astype(jnp.int32)
        return state._replace(groups=states, key=keys[:, 1], rollouts=state.rollouts + wait), metrics

    def _learned(self, rows: chex.Array) -> chex.Array:
        """Rows [minibatches, batch, row_size] that networks learn from; of sequences [minibatches, sequences, steps,
        row_size] all steps but the first ones, which only bring states up to date."""
        if not self.layout.recurrent:
            return rows
        return rows[..., self.layout.burn_in :, :].reshape(rows.shape[0], -1, rows.shape[-1])

    def minibatches(
        self, state: TrainState, hyper: Sequence[HyperParams], seed: chex.Array | int, indices: chex.Array
    ) -> chex.Array:
        """What updates take: the rows [*indices.shape, row_size] of a local seed and its `hyper`, rewards of n_step
        steps in them, observations normalized; where anybody is recurrent sequences [*indices.shape, steps, row_size],
        `indices` counted from the oldest row."""
        return self.normalized(state, seed, self._drawn(state, hyper, seed, indices))

    def _drawn(
        self, state: TrainState, hyper: Sequence[HyperParams], seed: chex.Array | int, indices: chex.Array
    ) -> chex.Array:
        """`minibatches` before their observations are normalized."""
        schedule, layout = self.schedule, self.layout
        written = replay.Written(schedule.replay_capacity, schedule.rollout_steps, state.rollouts)
        if layout.recurrent:
            return replay.gather(
                state.replay, seed, replay.following(written, indices, schedule.num_envs, self.sequence_steps)
            )
        if layout.n_step == 1:
            return replay.gather(state.replay, seed, indices)
        gamma = jnp.stack([jnp.asarray(hyper[layout.place(i)[0]].gamma) for i in range(layout.num_agents)])
        return n_step.draw(layout, state.replay, seed, indices, written, schedule.num_envs, gamma)

    def normalized(self, state: TrainState, seed: chex.Array | int, rows: chex.Array) -> chex.Array:
        """Replay rows [..., row_size] of a local seed with x and x' as networks see them."""
        scale = self.scale(state)
        if scale is None:
            return rows
        return running_statistics.normalize_rows(self.layout, jax.tree.map(lambda s: s[seed], scale), rows)
