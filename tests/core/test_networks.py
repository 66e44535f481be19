"""Stacked perceptrons against single ones in NumPy, and their start."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference

from matd3_jax.core import networks
from matd3_jax.envs import Box, Discrete, MultiDiscrete, Simplex

TOLERANCE = 1e-12  # float64 on both sides; only the order of sums of up to ten terms differs
BOX = Box(2, -1.0, 3.0)
CHOICES = (Simplex((5,)), Simplex((3, 2)), Simplex((5, 10)), Discrete(4), MultiDiscrete((2, 3)))


def random_params(rng, stack, widths):
    pairs = list(zip(widths[:-1], widths[1:], strict=True))
    return {f"kernel_{n}": rng.normal(size=(*stack, *pair)) for n, pair in enumerate(pairs)} | {
        f"bias_{n}": rng.normal(size=(*stack, pair[1])) for n, pair in enumerate(pairs)
    }


def one_network(params, place):
    return [(params[f"kernel_{n}"][place], params[f"bias_{n}"][place]) for n in range(len(params) // 2)]


@pytest.mark.parametrize("column", [None, 0, 3])
@pytest.mark.parametrize(
    "stack, leading",
    [((), ()), ((3,), ()), ((3,), (3,)), ((2, 3), ()), ((2, 3), (2,)), ((2, 3), (2, 3))],
    ids=str,
)
def test_stacked_mlp(stack, leading, column):
    """Every network of a stack is a perceptron of its own, whatever the inputs share; a correction equals changing
    the inputs from `column` on, its gradient, too."""
    rng, batch, widths, k = np.random.default_rng(0), 4, (5, 6, 3, 2), 2
    params = random_params(rng, stack, widths)
    x = rng.normal(size=(*leading, batch, widths[0]))
    weight = rng.normal(size=(*stack, batch, widths[-1]))
    network = networks.StackedMLP(stack, widths[1:])
    changed, args = x.copy(), ()
    if column is not None:
        delta = rng.normal(size=(*leading, batch, k))
        changed[..., column : column + k] += delta
        args = (delta, column)

    def total(*args):
        y = network.apply({"params": params}, x, *args)
        return (y * weight).sum(), y

    with jax.enable_x64(True):
        if args:
            (_, y), slope = jax.jit(jax.value_and_grad(total, has_aux=True), static_argnums=1)(*args)
        else:
            _, y = jax.jit(total)()
    assert y.shape == (*stack, batch, widths[-1])
    want_slope = np.zeros((*leading, batch, k))
    for place in np.ndindex(stack):
        layers, inputs = one_network(params, place), changed[place[: len(leading)]]
        want, read = reference.forward(layers, inputs)
        np.testing.assert_allclose(y[place], want, rtol=TOLERANCE, atol=TOLERANCE)
        if args:
            _, back = reference.backward(layers, read, weight[place])
            want_slope[place[: len(leading)]] += back[:, column : column + k]
    if args:
        np.testing.assert_allclose(slope, want_slope, rtol=TOLERANCE, atol=TOLERANCE)


def test_start_of_a_stack():
    """Glorot's bound of each network by itself: sqrt(6 / (inputs + outputs)), not of the whole stack, and reached to a
    few per cent by thousands of draws; networks differ; biases are zero."""
    stack, inputs, features = (3, 2), 30, (40, 20)
    network = networks.StackedMLP(stack, features)
    params = jax.jit(network.init)(jax.random.key(0), jnp.zeros((1, inputs)))["params"]
    assert {name: leaf.shape for name, leaf in params.items()} == {
        "kernel_0": (3, 2, 30, 40), "bias_0": (3, 2, 40), "kernel_1": (3, 2, 40, 20), "bias_1": (3, 2, 20)
    }  # fmt: skip
    for n, (i, j) in enumerate([(30, 40), (40, 20)]):
        kernel = np.asarray(params[f"kernel_{n}"]).reshape(6, i * j)
        bound = np.sqrt(6 / (i + j))
        # 800 uniform draws: the largest is within 2 % of the bound but for a chance of 1e-7.
        assert (np.abs(kernel).max(axis=1) <= bound).all() and (np.abs(kernel).max(axis=1) > 0.98 * bound).all()
        # The standard deviation of a uniform is bound / sqrt 3; that of 800 draws is off by 1.6 % (one sigma).
        np.testing.assert_allclose(kernel.std(axis=1), bound / np.sqrt(3), rtol=0.08)
        assert not params[f"bias_{n}"].any()
        assert len(np.unique(kernel[:, 0])) == 6
