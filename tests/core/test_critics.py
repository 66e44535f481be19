"""Heads and normalization of critics, what the learner's comparison with float64 does not show by itself."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from learner_cases import layers

from matd3_jax.core import critics
from matd3_jax.core.algorithm import Algorithm

CATEGORICAL = Algorithm(hidden=(8,), critic_head="categorical", critic_atoms=11, critic_range=(-3.0, 7.0))
TOLERANCE = 1e-5  # float32 against float64, sums of 11 terms of order 1


def distributions(rng, batch, atoms=11):
    p = rng.dirichlet(np.full(atoms, 0.3), size=batch)
    return np.asarray(p, np.float32)


def project(p, reward, discount):
    found = jax.jit(critics.of(CATEGORICAL).project)(p, jnp.asarray(reward, jnp.float32), jnp.float32(discount))
    return np.asarray(found, np.float64)


def test_projection_keeps_mass_and_mean():
    """Inside the range the projection is a distribution with the mean r + discount * mean."""
    rng = np.random.default_rng(0)
    p, returns = distributions(rng, 200), np.linspace(-3, 7, 11)
    discount = rng.uniform(0, 0.5, 200)
    reward = rng.uniform(-1.5, 3.5, 200)  # with half of the range at most, all stays inside
    found = project(p, reward, discount)
    assert (found >= 0).all()
    np.testing.assert_allclose(found.sum(axis=1), 1, atol=TOLERANCE)
    np.testing.assert_allclose(found @ returns, reward + discount * (p @ returns), atol=10 * TOLERANCE)


def test_projection_beyond_the_range_and_at_a_termination():
    """All mass lies on the nearest end, or around the reward alone."""
    p = distributions(np.random.default_rng(1), 4)
    found = project(p, [100.0, -100.0, 2.0, 2.25], [0.9, 0.9, 0.0, 0.0])
    want = np.zeros((4, 11))
    want[0, 10] = want[1, 0] = want[2, 5] = 1  # atoms are 1 apart from -3 on
    want[3, 5:7] = 0.75, 0.25
    np.testing.assert_allclose(found, want, atol=TOLERANCE)


def test_the_target_is_that_of_the_critic_with_the_smaller_mean():
    """Not the mixture, nor the smaller of each atom: per transition, as the float64 program has it."""
    rng = np.random.default_rng(2)
    critic = critics.of(CATEGORICAL)
    params = critic.init(jax.random.key(0), 5)
    params = jax.tree.map(lambda leaf: 3 * leaf + 0.1 * rng.normal(size=leaf.shape).astype(np.float32), params)
    inputs = rng.normal(size=(64, 5)).astype(np.float32)
    outputs = [reference.forward(layers(params, j), inputs.astype(np.float64))[0] for j in range(2)]
    values = [reference.head(CATEGORICAL).value(output)[0] for output in outputs]
    chosen = np.argmin(values, axis=0)
    assert 10 < chosen.sum() < 54  # both critics are chosen
    reward, discount = rng.normal(size=64).astype(np.float32), np.full(64, 0.9, np.float32)
    want = reference.head(CATEGORICAL).target(outputs, reward, discount)
    np.testing.assert_allclose(critic.target(params, reward, discount, inputs), want, atol=TOLERANCE)
    np.testing.assert_allclose(critic.values(params, inputs), values, atol=10 * TOLERANCE)


@pytest.mark.parametrize("norm", ["none", "layer"])
def test_a_layer_norm_does_not_see_the_scale_of_its_inputs(norm):
    """With inputs a thousand times as large a normalized critic, its biases 0, gives the same; another does not."""
    critic = critics.of(Algorithm(hidden=(16, 16), critic_norm=norm))
    params = critic.init(jax.random.key(3), 6)
    assert ("gain_0" in params) == (norm == "layer")
    inputs = np.random.default_rng(4).normal(size=(32, 6)).astype(np.float32)
    small, large = critic.values(params, inputs), critic.values(params, 1000 * inputs)
    assert np.allclose(small, large, rtol=1e-3, atol=1e-4) == (norm == "layer")


def test_defaults_have_no_new_parameters():
    params = critics.of(Algorithm(hidden=(4,))).init(jax.random.key(0), 3)
    assert {name: leaf.shape for name, leaf in params.items()} == {
        "kernel_0": (2, 3, 4),
        "bias_0": (2, 4),
        "kernel_1": (2, 4, 1),
        "bias_1": (2, 1),
    }
