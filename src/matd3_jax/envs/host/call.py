"""Calls from the compiled program to functions on the host that have a memory: once for each step, in whole batches."""

from collections.abc import Callable

import chex
import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import io_callback


def call(function: Callable[[np.ndarray], np.ndarray], size: int, row: chex.Array) -> chex.Array:
    """Call `function` with a row of int32, and return the row [size] of int32 that it answers with.

    Under `jax.vmap`, of any depth, it is called once for the whole batch, with rows [batch, row.shape[0]]. Unlike
    `jax.pure_callback` it is called exactly once for each time that the program comes by: what it changes counts.

    Numbers of other types travel as their bits (`bits`, `floats`): one array each way, as each costs as much as the
    call.
    """

    def on_host(rows: np.ndarray) -> np.ndarray:
        rows = np.asarray(rows)  # NumPy only: jax#24255
        return function(rows.reshape(-1, rows.shape[-1])).reshape(*rows.shape[:-1], size)

    @jax.custom_batching.custom_vmap
    def call_all(rows: chex.Array) -> chex.Array:
        shape = jax.ShapeDtypeStruct((*rows.shape[:-1], size), jnp.int32)
        return io_callback(on_host, shape, rows, ordered=False)

    @call_all.def_vmap
    def _(axis_size: int, in_batched: list[bool], rows: chex.Array) -> tuple[chex.Array, bool]:
        del axis_size, in_batched  # the batch's axis is the first
        return call_all(rows), True

    return call_all(row)


def bits(values: chex.Array) -> chex.Array:
    """The bits of float32 numbers as int32, which nothing on the way changes."""
    return jax.lax.bitcast_convert_type(jnp.asarray(values, jnp.float32), jnp.int32)


def floats(row: chex.Array) -> chex.Array:
    """What `bits` made into int32."""
    return jax.lax.bitcast_convert_type(row, jnp.float32)
