"""Stacks of perceptrons: the members of a group, and the twin critics of each, are one batched network."""

import math

import chex
import flax.linen as nn
import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero


class StackedMLP(nn.Module):
    """A stack of independent ReLU perceptrons with linear outputs, computed as batched products.

    Every parameter has the stack's axes in front: kernels [*stack, inputs, outputs], biases [*stack, outputs]. Weights
    are Glorot uniform (each network's own fans), biases zero: PAPER appendix and the authors' program.
    """

    stack: tuple[int, ...]
    features: tuple[int, ...]
    """Widths of the hidden layers and of the output."""
    layer_norm: bool = False
    """Normalize the inputs of every ReLU over the layer's units, then scale and shift each unit by learned numbers
    [*stack, width], which start at 1 and 0 (Ba et al. 2016)."""

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
            y = product(x, kernel)
            if layer == 0 and correction is not None:
                k = correction.shape[-1]
                y = y + product(correction, jax.lax.dynamic_slice_in_dim(kernel, column, k, axis=-2))
            y = y + bias[..., None, :]
            if layer == len(self.features) - 1:
                return y
            if self.layer_norm:
                gain = self.param(f"gain_{layer}", nn.initializers.ones, (*self.stack, width))
                shift = self.param(f"shift_{layer}", nn.initializers.zeros, (*self.stack, width))
                y = normalized(y) * gain[..., None, :] + shift[..., None, :]
            x = nn.relu(y)
            inputs = width
        raise ValueError("a network has at least an output layer")


def normalized(x: chex.Array) -> chex.Array:
    """x shifted and scaled to mean 0 and variance 1 along its last axis, 1e-6 added to the variance."""
    centered = x - x.mean(axis=-1, keepdims=True)
    return centered * jax.lax.rsqrt(jnp.square(centered).mean(axis=-1, keepdims=True) + 1e-6)


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


def product(x: chex.Array, kernel: chex.Array) -> chex.Array:
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


def apply(network: StackedMLP, params: chex.ArrayTree, *args) -> chex.Array:
    """Outputs of a network with the parameters `params`."""
    return network.apply({"params": params}, *args)  # type: ignore[return-value]
