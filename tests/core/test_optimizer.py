"""Clipping and Adam of stacked networks against one network at a time."""

import dataclasses

import jax
import numpy as np
import optax
import pytest
import reference

from matd3_jax.core import optimizer
from matd3_jax.core.algorithm import Algorithm

TOLERANCE = 1e-12  # both sides in float64: only the order of sums of a few dozen terms differs


def stacked(rng, stack, scale=1.0):
    """Random numbers in the form of two layers, each network of the stack of another size of numbers."""
    size = np.exp(rng.normal(size=stack) * 2)
    return {
        name: rng.normal(size=(*stack, *shape)) * scale * size.reshape(*stack, *[1] * len(shape))
        for name, shape in {"kernel_0": (3, 4), "bias_0": (4,), "kernel_1": (4, 2), "bias_1": (2,)}.items()
    }


def network(tree, place):
    return [(tree[f"kernel_{n}"][place], tree[f"bias_{n}"][place]) for n in range(2)]


@pytest.mark.parametrize("mode", ["variable", "network", "none"])
@pytest.mark.parametrize("stack", [(3,), (3, 2)])
def test_clip(mode, stack):
    """Each variable, or each network, of the stack has its own norm: agents and twin critics do not share one. The
    bound lies among the norms, so that some are too large and some are not."""
    gradients = stacked(np.random.default_rng(0), stack)
    norms = [np.linalg.norm(leaf[place]) for leaf in gradients.values() for place in np.ndindex(stack)]
    bound = float(np.median(norms))
    with jax.enable_x64(True):
        got = optimizer.clip(gradients, Algorithm(clip=mode), len(stack), bound)
    too_large = 0
    for place in np.ndindex(stack):
        want, count = reference.clip(network(gradients, place), mode, bound)
        too_large += count
        for pair, other in zip(network(got, place), want, strict=True):
            for leaf, expected in zip(pair, other, strict=True):
                np.testing.assert_allclose(leaf, expected, rtol=TOLERANCE)
    assert too_large == 0 if mode == "none" else 0 < too_large < 4 * np.prod(stack)


@pytest.mark.parametrize("mode", ["variable", "network"])
def test_clip_of_nothing_and_of_a_norm_at_the_bound(mode):
    """Zero gradients stay zero (no 0 / 0), and a norm within the bound is left bit for bit."""
    zero = {"w": np.zeros((2, 3), np.float32)}
    got = optimizer.clip(zero, Algorithm(clip=mode), 1, np.float32(0.5))
    np.testing.assert_array_equal(got["w"], zero["w"])
    small = {"w": np.array([[0.3, 0.4, 0.0], [3, 4, 0]], np.float32)}
    got = optimizer.clip(small, Algorithm(clip=mode), 1, np.float32(0.5))
    np.testing.assert_array_equal(got["w"][0], small["w"][0])
    np.testing.assert_allclose(got["w"][1], [0.3, 0.4, 0], rtol=1e-6)  # float32


@pytest.mark.parametrize("kind", ["standard", "epsilon_hat"])
def test_adam(kind):
    """Ten steps as in Kingma and Ba's algorithm, or in TensorFlow 1's form of it. Gradients of about 1e-7 let epsilon
    (1e-8) matter, and its place: the two forms differ by a tenth there, and hardly at gradients of order 1."""
    rng = np.random.default_rng(1)
    algorithm = Algorithm(clip="none", adam=kind)
    params = stacked(rng, (2,))
    layers = [network(params, place) for place in range(2)]
    empty = [(np.zeros((3, 4)), np.zeros(4)), (np.zeros((4, 2)), np.zeros(2))]
    states = [reference.Adam(empty, empty, 0)] * 2
    with jax.enable_x64(True):
        state = optimizer.adam(kind).init(jax.tree.map(jax.numpy.asarray, params))
        step = jax.jit(lambda p, s, g: optimizer.apply(algorithm, p, s, g, 0.01, 0.5, 1))
        for _ in range(10):
            gradients = stacked(rng, (2,), scale=1e-7)
            params, state = step(params, state, gradients)
            for k in range(2):
                layers[k], states[k] = reference.adam_step(layers[k], states[k], network(gradients, k), 0.01, kind)
    params, state = jax.tree.map(np.asarray, (params, state))
    assert isinstance(state, optax.ScaleByAdamState) and state.count == 10
    for k in range(2):
        for tree, want in ((params, layers[k]), (state.mu, states[k].first), (state.nu, states[k].second)):
            for pair, other in zip(network(tree, k), want, strict=True):
                for leaf, expected in zip(pair, other, strict=True):
                    np.testing.assert_allclose(leaf, expected, rtol=1e-11, atol=0)  # ten steps of rounding
    # The other form is elsewhere.
    other = {"standard": "epsilon_hat", "epsilon_hat": "standard"}[kind]
    wrong, _ = reference.adam_step(network(params, 0), states[0], network(gradients, 0), 0.01, other)
    right, _ = reference.adam_step(network(params, 0), states[0], network(gradients, 0), 0.01, kind)
    assert np.abs(wrong[0][0] - right[0][0]).max() > 1e-6


def test_learning_rate_is_a_step_size():
    """lr scales the step, clipping comes before the moments, and parameters without gradient stay."""
    params = {"w": np.ones((2, 3), np.float32)}
    gradients = {"w": np.array([[0, 0, 0], [3, 4, 0]], np.float32)}
    algorithm = dataclasses.replace(Algorithm(), clip="variable")
    state = optimizer.adam("standard").init(params)
    for lr in (0.01, 0.1):
        moved, after = optimizer.apply(algorithm, params, state, gradients, lr, 0.5, 1)
        # Adam's first step is lr times the sign (float32; epsilon is 1e-8 / 0.3 of it).
        np.testing.assert_allclose(moved["w"], [[1, 1, 1], [1 - lr, 1 - lr, 1]], rtol=1e-6)
        np.testing.assert_allclose(after.mu["w"][1], [0.03, 0.04, 0], rtol=1e-6)
