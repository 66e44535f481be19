"""Seeds that take over what other seeds have learned, on the devices: what population-based training copies."""

from collections.abc import Collection, Mapping
from functools import cached_property, partial
from typing import Any

import chex
import jax
import numpy as np
from jax.sharding import PartitionSpec as P

from matd3_jax.training.loop import TrainLoop
from matd3_jax.training.state import TrainState


class Copier:
    """Copies between the seeds of a `TrainLoop`."""

    def __init__(self, loop: TrainLoop):
        self.loop = loop

    def copy(
        self,
        state: TrainState,
        sources: Mapping[int, int],
        replay: Collection[int] = (),
        environments: Collection[int] = (),
    ) -> TrainState:
        """Give seeds the networks, targets, optimizers and running statistics of others, and what their critics are
        judged on. Their keys stay their own.

        Args:
            state: its replay is donated.
            sources: for the seeds that change, by their places, the seeds that they copy; these do not change.
            replay: which of them take the replay rows, too.
            environments: which of them take the environments, too, in the middle of their episodes.
        """
        pairs = state.reservoir and state.reservoir.pairs
        learned = (state.groups, state.statistics, pairs, state.earlier, state.stopped)
        groups, statistics, pairs, earlier, stopped = self._gather(learned, self._rows(sources))
        state = state._replace(groups=groups, statistics=statistics, earlier=earlier, stopped=stopped)
        if state.reservoir is not None:
            state = state._replace(reservoir=state.reservoir._replace(pairs=pairs))
        if environments:
            rows = self._rows({seed: sources[seed] for seed in environments})
            state = state._replace(env=self._gather(state.env, rows))
        if replay:
            state = state._replace(replay=self._copy_replay(state.replay, {seed: sources[seed] for seed in replay}))
        return state

    def _rows(self, sources: Mapping[int, int]) -> np.ndarray:
        """[padded_seeds] which row each row is taken from; copies that fill up the devices go with the last seed."""
        sharding = self.loop.sharding
        rows = np.arange(sharding.num_seeds)
        rows[list(sources)] = list(sources.values())
        return np.append(rows, np.repeat(rows[-1:], sharding.padded_seeds - sharding.num_seeds))

    @cached_property
    def _gather(self) -> Any:
        def gather(tree: chex.ArrayTree, rows: chex.Array) -> chex.ArrayTree:
            return jax.tree.map(lambda leaf: leaf[rows], tree)

        return jax.jit(gather, out_shardings=self.loop.sharding.named(P("seeds")))

    def _copy_replay(self, replay: jax.Array, sources: Mapping[int, int]) -> jax.Array:
        """Write rows in place, one seed after another: a gather would need the whole replay twice."""
        shards = replay.addressable_shards
        first = [shard.index[0].start or 0 for shard in shards]
        parts = [shard.data for shard in shards]
        last, padded = self.loop.sharding.num_seeds - 1, self.loop.sharding.padded_seeds
        for seed, source in sources.items():
            holder = next(k for k, part in enumerate(parts) if 0 <= source - first[k] < part.shape[0])
            rows = _take(parts[holder], source - first[holder])
            for place in (seed, *(range(last + 1, padded) if seed == last else ())):
                for k, part in enumerate(parts):
                    if 0 <= place - first[k] < part.shape[0]:
                        parts[k] = _put(part, jax.device_put(rows, shards[k].device), place - first[k])
        return jax.make_array_from_single_device_arrays(replay.shape, replay.sharding, parts)


@jax.jit
def _take(rows: jax.Array, place: chex.Array) -> jax.Array:
    return jax.lax.dynamic_slice_in_dim(rows, place, 1)


@partial(jax.jit, donate_argnums=0)
def _put(rows: jax.Array, one: jax.Array, place: chex.Array) -> jax.Array:
    return jax.lax.dynamic_update_slice_in_dim(rows, one, place, 0)
