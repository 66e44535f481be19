"""Experience replay: a ring of flat transition rows for every seed, on the device.

Rows are [seeds, capacity, row_size]. All seeds write equally much at the same time, so the write position is one number
for all of them, derived from the count of rollouts: a write is one contiguous slice update with an explicit seed axis
(under `vmap` it would turn into a scatter), and a batch is one gather.
"""

from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp


def allocate(num_seeds: int, capacity: int, row_size: int) -> chex.Array:
    """An empty replay: zeros [seeds, capacity, row_size]."""
    return jnp.zeros((num_seeds, capacity, row_size), jnp.float32)


def write(rows: chex.Array, new: chex.Array, count: chex.Array) -> chex.Array:
    """Write the rows `new` [seeds, n, row_size] of rollout number `count` (from 0); n divides the capacity, so that no
    write wraps."""
    capacity, n = rows.shape[1], new.shape[1]
    if capacity % n:
        raise ValueError(f"replay capacity {capacity} is not a multiple of the {n} rows of one write")
    return jax.lax.dynamic_update_slice(rows, new, (0, count % (capacity // n) * n, 0))


def filled(capacity: int, n: int, count: chex.Array | int) -> chex.Array:
    """Number of valid rows after `count` writes of n rows each."""
    return jnp.minimum(count, capacity // n) * n


class Written(NamedTuple):
    """What has been written: `count` rollouts of n rows each into `capacity` rows."""

    capacity: int
    n: int
    count: chex.Array


def successors(written: Written, indices: chex.Array, stride: int, steps: int) -> tuple[chex.Array, chex.Array]:
    """Row numbers int32 [*indices.shape, steps] of each row and those after it in its environment, and whether they are
    there [*indices.shape, steps]: what follows the newest row in the ring is the oldest one.

    Args:
        indices: numbers of rows that are there.
        stride: rows from one of an environment to its next: a rollout's rows are time-major [length, num_envs], and
            the next rollout follows.
    """
    capacity, size = written.capacity, filled(*written)
    first = oldest(written)
    offsets = stride * jnp.arange(steps)
    there = ((indices - first) % capacity)[..., None] + offsets < size
    return (indices[..., None] + offsets) % capacity, there


def oldest(written: Written) -> chex.Array:
    """Row number of the oldest row."""
    capacity, n, count = written
    # Modulo before the product, which overflows otherwise.
    return jnp.where(count < capacity // n, 0, count % (capacity // n) * n)


def following(written: Written, ages: chex.Array, stride: int, steps: int) -> chex.Array:
    """Row numbers int32 [*ages.shape, steps] of rows and those after them in their environments.

    Args:
        ages: places of the first rows, counted from the oldest row; so that all that follow are there.
        stride: as in `successors`.
    """
    return (oldest(written) + ages[..., None] + stride * jnp.arange(steps)) % written.capacity


def sample_indices(key: chex.PRNGKey, size: chex.Array, shape: tuple[int, ...]) -> chex.Array:
    """Row numbers, uniform on [0, size) and independent (with replacement), int32 [*shape]."""
    return jax.random.randint(key, shape, 0, size)


def gather(rows: chex.Array, seed: chex.Array | int, indices: chex.Array, columns: slice = slice(None)) -> chex.Array:
    """The rows [*indices.shape, row_size] of one seed, or a part of them."""
    return rows.at[seed, indices, columns].get(mode="promise_in_bounds")
