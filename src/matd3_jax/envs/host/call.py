"""Calls from the compiled program to functions on the host, in whole batches, a row of int32 each way."""

from collections.abc import Callable

import chex
import jax
import jax.numpy as jnp
import numpy as np


def call(function: Callable[[np.ndarray], np.ndarray], size: int, row: chex.Array) -> chex.Array:
    """Call `function` with a row of int32, and return the row [size] of int32 that it answers with.

    Under `jax.vmap`, of any depth, it is called once for the whole batch, with rows [batch, row.shape[0]]. Numbers of
    other types travel as their bits (`bits`, `floats`): one array each way, as each costs as much as the call.

    To JAX it is pure, so that loops whose ends differ between seeds take it. What it changes must follow from its rows
    alone: calls are in order where one's row depends on the other's answer, and a call may come twice (`pool.Pool`).
    """

    def on_host(rows: np.ndarray) -> np.ndarray:
        rows = np.asarray(rows)  # NumPy only: jax#24255
        return function(rows.reshape(-1, rows.shape[-1])).reshape(*rows.shape[:-1], size)

    shape = jax.ShapeDtypeStruct((size,), jnp.int32)
    return jax.pure_callback(on_host, shape, row, vmap_method="broadcast_all")


def bits(values: chex.Array) -> chex.Array:
    """The bits of float32 numbers as int32, which nothing on the way changes."""
    return jax.lax.bitcast_convert_type(jnp.asarray(values, jnp.float32), jnp.int32)


def floats(row: chex.Array) -> chex.Array:
    """What `bits` made into int32."""
    return jax.lax.bitcast_convert_type(row, jnp.float32)
