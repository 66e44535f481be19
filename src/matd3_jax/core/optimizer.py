"""Adam with clipped gradients for stacked networks."""

import chex
import jax
import jax.numpy as jnp
import optax

from matd3_jax.core.algorithm import Algorithm


def adam(kind: str) -> optax.GradientTransformation:
    """Adam's direction (lr 1). "standard" is optax's; "epsilon_hat" adds epsilon to the root of the uncorrected second
    moment, as TensorFlow 1 does (Kingma and Ba 2015, the note after algorithm 1)."""
    standard = optax.scale_by_adam(eps=1e-8)
    if kind == "standard":
        return standard

    def update(gradients, state, params=None):
        mu = optax.tree.update_moment(gradients, state.mu, 0.9, 1)
        nu = optax.tree.update_moment_per_elem_norm(gradients, state.nu, 0.999, 2)
        count = optax.safe_increment(state.count)
        rate = jnp.sqrt(1 - 0.999**count) / (1 - 0.9**count)
        direction = jax.tree.map(lambda m, v: rate * m / (jnp.sqrt(v) + 1e-8), mu, nu)
        return direction, optax.ScaleByAdamState(count=count, mu=mu, nu=nu)

    return optax.GradientTransformation(standard.init, update)


def clip(gradients: chex.ArrayTree, algorithm: Algorithm, stack_ndim: int, max_norm: chex.Array) -> chex.ArrayTree:
    """Gradients scaled down to a norm of at most `max_norm`: each variable, or each network, of the stack by itself.

    gradients: leaves [*stack, ...] with `stack_ndim` stack axes.
    """
    # Not a chain of optax: its clip has no stack; vmapped it is slower and rounds otherwise (but for powers of two).
    if algorithm.clip == "none":
        return gradients
    square = jax.tree.map(lambda g: jnp.sum(jnp.square(g), axis=tuple(range(stack_ndim, g.ndim))), gradients)
    if algorithm.clip == "network":
        total = sum(jax.tree.leaves(square))
        square = jax.tree.map(lambda _: total, square)

    def scaled(g, s):
        factor = max_norm / jnp.maximum(jnp.sqrt(s), max_norm)
        return g * factor.reshape(factor.shape + (1,) * (g.ndim - stack_ndim))

    return jax.tree.map(scaled, gradients, square)


def apply(
    algorithm: Algorithm,
    params: chex.ArrayTree,
    state: optax.OptState,
    gradients: chex.ArrayTree,
    lr: chex.Array,
    max_norm: chex.Array,
    stack_ndim: int,
) -> tuple[chex.ArrayTree, optax.OptState]:
    """One optimizer step: (params, state) after it."""
    gradients = clip(gradients, algorithm, stack_ndim, max_norm)
    direction, state = adam(algorithm.adam).update(gradients, state)
    return jax.tree.map(lambda p, d: p - lr * d, params, direction), state
