"""States of other libraries' environments: what makes them fit to be carried through a compiled loop."""

from typing import Any

import chex
import jax
import jax.numpy as jnp


def raw(key: chex.PRNGKey) -> chex.Array:
    """A key as the uint32 array that other libraries keep in their states; the same random numbers."""
    return jax.random.key_data(key) if jnp.issubdtype(key.dtype, jax.dtypes.prng_key) else key


def like(tree: Any, shapes: Any) -> Any:
    """`tree` with the leaves' types of `shapes`, none of them weak: a state that can be carried through a loop.

    A `tree` of another structure is returned as it is, for `envs.check` to say so.
    """
    found: Any = jax.tree.structure(tree)
    wanted: Any = jax.tree.structure(shapes)
    if found != wanted:
        return tree
    return jax.tree.map(lambda leaf, shape: jnp.asarray(leaf, shape.dtype), tree, shapes)


def flat(tree: Any) -> chex.Array:
    """All numbers of an array, or of the arrays of a tree, as one float32 vector."""
    return jnp.concatenate([jnp.ravel(leaf).astype(jnp.float32) for leaf in jax.tree.leaves(tree)])
