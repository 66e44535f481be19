"""A replay in a checkpoint: written and read one seed at a time, so that it never stands in memory twice."""

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp

from matd3_jax.errors import UserError
from matd3_jax.runtime.multihost import Share
from matd3_jax.training.loop import TrainLoop
from matd3_jax.training.state import TrainState


def filled_rows(trainer: TrainLoop, state: TrainState) -> Iterator[tuple[int, np.ndarray]]:
    """Give (seed number, its filled rows [rows, row size]) one after the other."""
    filled = trainer.schedule.filled_rows(int(state.rollouts))
    for shard in state.replay.addressable_shards:
        if shard.replica_id:
            continue  # a copy on another device that works on the same seeds
        first = shard.index[0].start or 0
        for index in range(shard.data.shape[0]):
            if first + index < trainer.num_seeds:
                yield first + index, np.asarray(shard.data[index, :filled])


def restore(
    path: Path,
    trainer: TrainLoop,
    share: Share,
    rollouts: int,
    convert: Callable[[np.ndarray], np.ndarray] = lambda rows: rows,
) -> jax.Array:
    """The replay in the checkpoint at `path`, after `rollouts` rollouts, one seed at a time. Raises UserError where it
    does not fit the trainer.

    Args:
        convert: what its rows [rows, row size] become.
    """
    filled, local = trainer.schedule.filled_rows(rollouts), []
    with ocp.StandardCheckpointer() as checkpointer:
        for device, seeds in trainer.sharding.device_seeds():
            shape = (len(seeds), trainer.schedule.replay_capacity, trainer.layout.row_size)
            rows = jax.device_put(jnp.zeros(shape, jnp.float32, device=device), device)
            for index, seed in enumerate(seeds):
                if not filled:
                    continue
                one = convert(np.asarray(checkpointer.restore(path / "replay" / str(share.first + seed))["rows"]))
                if one.shape[0] > shape[1] or one.shape[0] < filled or one.shape[1] != shape[2]:
                    raise UserError(f"{path}: a replay of shape {one.shape} does not fit these settings")
                rows = _put_rows(rows, jax.device_put(one[None], device), index)
            local.append(rows)
    shape = (trainer.sharding.padded_seeds, trainer.schedule.replay_capacity, trainer.layout.row_size)
    return jax.make_array_from_single_device_arrays(shape, trainer.shardings.replay, local)


@partial(jax.jit, donate_argnums=0, static_argnums=2)
def _put_rows(rows: jax.Array, one: jax.Array, index: int) -> jax.Array:
    return jax.lax.dynamic_update_slice(rows, one, (index, 0, 0))
