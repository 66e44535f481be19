"""What other libraries' environments have in common: options that can be hashed, keys as they store them."""

from collections.abc import Mapping
from typing import Any

import chex
import jax
import jax.numpy as jnp
from flax.core import FrozenDict

from matd3_jax.errors import OptionError


def hashable(name: str, value: Any) -> Any:
    """`value` with its mappings as FrozenDict and its lists as tuples, at every depth.

    Raises OptionError, naming the option `name`, for what cannot be hashed even so.
    """
    if isinstance(value, Mapping):
        return FrozenDict({str(key): hashable(name, inner) for key, inner in value.items()})
    if isinstance(value, list | tuple):
        return tuple(hashable(name, inner) for inner in value)
    try:
        hash(value)
    except TypeError as error:
        raise OptionError(
            f"{name}: {type(value).__name__} is no plain value; make the environment yourself, and wrap the instance"
        ) from error
    return value


def thawed(value: Any, sequence: type = tuple) -> Any:
    """Of `hashable`'s result: dictionaries for its mappings, `sequence` (tuple or list) for its tuples."""
    if isinstance(value, Mapping):
        return {key: thawed(inner, sequence) for key, inner in value.items()}
    if isinstance(value, tuple):
        return sequence(thawed(inner, sequence) for inner in value)
    return value


def options_of(name: str, value: Any) -> FrozenDict:
    """A group of options as `hashable` makes it. Raises OptionError where `value` is no mapping."""
    if not isinstance(value, Mapping):
        raise OptionError(f"{name}={value!r}: must be a group of keys, for instance {{max_steps: 50}}")
    return hashable(name, value)


def raw(key: chex.PRNGKey) -> chex.Array:
    """A key as the uint32 array that other libraries keep in their states; the same random numbers."""
    return jax.random.key_data(key) if jnp.issubdtype(key.dtype, jax.dtypes.prng_key) else key


def like(tree: Any, shapes: Any) -> Any:
    """`tree` with the leaves' types of `shapes`, none of them weak: a state that can be carried through a loop.

    A `tree` of another structure is returned as it is, for `envs.check` to say so.
    """
    if jax.tree.structure(tree) != jax.tree.structure(shapes):
        return tree
    return jax.tree.map(lambda leaf, shape: jnp.asarray(leaf, shape.dtype), tree, shapes)


def flat(tree: Any) -> chex.Array:
    """All numbers of an array, or of the arrays of a tree, as one float32 vector."""
    return jnp.concatenate([jnp.ravel(leaf).astype(jnp.float32) for leaf in jax.tree.leaves(tree)])
