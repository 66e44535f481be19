"""Actors and critics. The members of a group, and the twin critics of each, are one batched network."""

import math
from collections.abc import Callable

import chex
import flax.linen as nn
import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero

from matd3_jax.envs.spaces import ActionSpace, Box, Discrete, Simplex


class StackedMLP(nn.Module):
    """A stack of independent ReLU perceptrons with linear outputs, computed as batched products.

    Every parameter has the stack's axes in front: kernels [*stack, inputs, outputs], biases [*stack, outputs]. Weights
    are Glorot uniform (each network's own fans), biases zero: PAPER appendix and the authors' program.
    """

    stack: tuple[int, ...]
    features: tuple[int, ...]
    """Widths of the hidden layers and of the output."""

    @nn.compact
    def __call__(self, x: chex.Array, correction: chex.Array | None = None, column: chex.Array | int = 0) -> chex.Array:
        """Outputs [*stack, batch, features[-1]].

        Args:
            x: [*leading, batch, inputs], where `leading` is the stack's axes or its first few: networks along the
                axes left out read the same input, and their first layers are one wide product.
            correction: [*leading, batch, k], added to the inputs `column : column + k`. Equal to changing x there, but
                a gradient with respect to it costs k columns instead of all.
        """
        axes = tuple(range(len(self.stack)))
        glorot = nn.initializers.glorot_uniform(batch_axis=axes)
        inputs = x.shape[-1]
        for layer, width in enumerate(self.features):
            kernel = self.param(f"kernel_{layer}", glorot, (*self.stack, inputs, width))
            bias = self.param(f"bias_{layer}", nn.initializers.zeros, (*self.stack, width))
            y = _product(x, kernel)
            if layer == 0 and correction is not None:
                k = correction.shape[-1]
                y = y + _product(correction, jax.lax.dynamic_slice_in_dim(kernel, column, k, axis=-2))
            y = y + bias[..., None, :]
            x = y if layer == len(self.features) - 1 else nn.relu(y)
            inputs = width
        return x


SMALL_BATCH = 512
"""Rows of a minibatch up to which a CPU is quicker with small programs: transposed copies instead of transposing
products (`_matmul`), agents one after another without a loop (`update.update`)."""


def small_batch(rows: int) -> bool:
    """Whether a minibatch of `rows` transitions is a small one, and this is a CPU."""
    return rows <= SMALL_BATCH and jax.default_backend() == "cpu"


@jax.custom_vjp
def _matmul(x: chex.Array, kernel: chex.Array) -> chex.Array:
    """x [..., batch, i] times kernel [..., i, j], whose kernel's gradient is a product of a transposed copy of x.

    Products that transpose an operand themselves miss XLA's quick library on a CPU (jax 0.10): at 256 rows the kernels'
    gradients of two 128-wide critics took up to five times as long.
    """
    return x @ kernel


def _matmul_forward(x, kernel):
    # Kept is only what a wanted gradient needs: nobody asks for that of a minibatch.
    return x.value @ kernel.value, (x.value if kernel.perturbed else None, kernel.value if x.perturbed else None)


def _matmul_backward(kept, slope):
    x, kernel = kept
    if isinstance(slope, SymbolicZero):
        return None, None
    x_slope = None if kernel is None else slope @ jnp.swapaxes(kernel, -1, -2)
    if x is None:
        return x_slope, None
    # The barrier keeps XLA from putting the transposition back into the product.
    return x_slope, jax.lax.optimization_barrier(jnp.swapaxes(x, -1, -2)) @ slope


_matmul.defvjp(_matmul_forward, _matmul_backward, symbolic_zeros=True)


def _product(x: chex.Array, kernel: chex.Array) -> chex.Array:
    """x [*leading, batch, i] times kernel [*leading, *rest, i, j]: [*leading, *rest, batch, j], as one product of
    width rest x j for each of `leading`."""
    leading = x.ndim - 2
    rest = kernel.shape[leading:-2]
    matmul = _matmul if small_batch(x.shape[-2]) else jnp.matmul
    if not rest:
        return matmul(x, kernel)
    i, j = kernel.shape[-2:]
    wide = jnp.moveaxis(kernel.reshape(*kernel.shape[:leading], math.prod(rest), i, j), -3, -2)
    y = matmul(x, wide.reshape(*kernel.shape[:leading], i, math.prod(rest) * j))
    y = y.reshape(*y.shape[:-1], math.prod(rest), j)
    return jnp.moveaxis(y, -2, -3).reshape(*kernel.shape[:leading], *rest, *x.shape[leading:-1], j)


def actor_network(stack: tuple[int, ...], hidden: tuple[int, ...], space: ActionSpace) -> StackedMLP:
    """Actors: observations [*stack, batch, size] to outputs [*stack, batch, action size]."""
    return StackedMLP(stack, (*hidden, space.size))


def critic_network(num_critics: int, hidden: tuple[int, ...]) -> StackedMLP:
    """The critics of one agent: inputs [batch, size] to values [num_critics, batch, 1]."""
    return StackedMLP((num_critics,), (*hidden, 1))


# ---- actions from actor outputs --------------------------------------------------------------------------------------


def noise(key: chex.PRNGKey, space: ActionSpace, shape: tuple[int, ...]) -> chex.Array:
    """The noise that `act` takes for one space, [*shape, space.size]: Gumbel for choices, standard normal for a Box."""
    draw = jax.random.normal if isinstance(space, Box) else jax.random.gumbel
    return flat_draw(draw, key, (*shape, space.size))


def flat_draw(draw: Callable, key: chex.PRNGKey, shape: tuple[int, ...]) -> chex.Array:
    """`draw(key, shape)`, computed along one long axis: three times as fast on a CPU as with a short last axis."""
    return draw(key, (math.prod(shape),)).reshape(shape)


def policy_noise(key: chex.PRNGKey, space: ActionSpace, shape: tuple[int, ...]) -> chex.Array | None:
    """The noise of the policy itself, without exploration: Gumbel for choices, none for a Box."""
    return None if isinstance(space, Box) else noise(key, space, shape)


def act(
    space: ActionSpace,
    output: chex.Array,
    draw: chex.Array | None,
    scale: chex.Array | float = 0.0,
    squash: str = "sigmoid",
) -> chex.Array:
    """Action vectors [..., space.size] from actor outputs [..., space.size].

    Choices: softmax(logits + Gumbel noise) at temperature 1 for each part, soft as it is for a `Simplex`; one-hot with
    the soft sample's gradient (straight-through) for hard choices. Box: the squashed output, plus `scale` half ranges
    of Gaussian noise, kept inside the Box.

    Args:
        draw: noise as from `noise`; None for the deterministic action (no noise: softmax(logits), the likeliest
            choice, or the squashed output).
        scale: standard deviation of the Gaussian noise in half ranges; only for a Box.
        squash: `Algorithm.actor_output`; only for a Box.
    """
    if isinstance(space, Box):
        half = (space.high - space.low) / 2
        if squash == "tanh":
            action = space.low + half + half * jnp.tanh(output)
        else:
            action = space.low + 2 * half * jax.nn.sigmoid(output)
        if draw is None:
            return action
        return jnp.clip(action + scale * half * draw, space.low, space.high)
    logits = output if draw is None else output + draw
    return jnp.concatenate([_choose(part, isinstance(space, Simplex)) for part in split(logits, space)], axis=-1)


def random_action(key: chex.PRNGKey, space: ActionSpace, shape: tuple[int, ...]) -> chex.Array:
    """Action vectors [*shape, space.size] drawn uniformly: from the Box, or by zero logits."""
    if isinstance(space, Box):
        return jax.random.uniform(key, (*shape, space.size), minval=space.low, maxval=space.high)
    return act(space, jnp.zeros((*shape, space.size)), noise(key, space, shape))


def smooth(space: ActionSpace, action: chex.Array, draw: chex.Array, sigma: chex.Array, clip: chex.Array) -> chex.Array:
    """Target policy smoothing (PAPER eq. for y_i): action + clip(sigma * draw, -clip, clip), in half ranges and kept
    inside a Box; for choices added to the vectors without projecting back, as in the authors' program."""
    epsilon = jnp.clip(sigma * draw, -clip, clip)
    if isinstance(space, Box):
        return jnp.clip(action + epsilon * (space.high - space.low) / 2, space.low, space.high)
    return action + epsilon


def split(vector: chex.Array, space: ActionSpace) -> list[chex.Array]:
    """The parts of a vector of several choices, each [..., size of the part]."""
    assert not isinstance(space, Box)
    ends = [sum(space.sizes[: i + 1]) for i in range(len(space.sizes))]
    return [vector[..., end - size : end] for end, size in zip(ends, space.sizes, strict=True)]


def _choose(logits: chex.Array, soft: bool) -> chex.Array:
    sample = jax.nn.softmax(logits)
    if soft:
        return sample
    hard = jax.nn.one_hot(jnp.argmax(sample, -1), sample.shape[-1], dtype=sample.dtype)
    return hard + (sample - jax.lax.stop_gradient(sample))  # the bracket is exactly 0: the choice stays one-hot


def to_env(space: ActionSpace, action: chex.Array) -> chex.Array:
    """What `Environment.step` takes for an action vector: the vector, or the number(s) of hard choices."""
    if isinstance(space, Box | Simplex):
        return action
    chosen = [jnp.argmax(part, -1).astype(jnp.int32) for part in split(action, space)]
    return chosen[0] if isinstance(space, Discrete) else jnp.stack(chosen, -1)
