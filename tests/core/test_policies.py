"""Actions from actors' outputs, against the reference; their noise; what environments get of them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from scipy.special import rel_entr, softmax

from matd3_jax.core import policies
from matd3_jax.core.algorithm import Algorithm
from matd3_jax.envs import Box, Discrete, MultiDiscrete, Simplex

TOLERANCE = 1e-12  # float64 on both sides; only the order of sums of up to ten terms differs
BOX = Box(2, -1.0, 3.0)
CHOICES = (Simplex((5,)), Simplex((3, 2)), Simplex((5, 10)), Discrete(4), MultiDiscrete((2, 3)))


def policy_of(space, squash="sigmoid"):
    return policies.of(space, Algorithm(actor_output=squash))


@pytest.mark.parametrize("space", CHOICES, ids=str)
def test_choices(space):
    """Soft or hard samples of softmax(logits + noise), part by part, as the reference has them; without noise the
    likeliest; the hard sample has the soft one's gradient."""
    rng = np.random.default_rng(0)
    output, draw, weight = rng.normal(size=(3, 6, space.size))
    with jax.enable_x64(True):
        for noise in (draw, None):

            def act(o, noise=noise):
                action = policy_of(space).sample(o, noise)
                return (action * weight).sum(), action

            slope, got = jax.jit(jax.grad(act, has_aux=True))(output)
            want, kept = reference.act(space, output, 0 if noise is None else noise)
            np.testing.assert_allclose(got, want, rtol=TOLERANCE, atol=TOLERANCE)
            np.testing.assert_allclose(slope, reference.act_slope(space, kept, weight), rtol=TOLERANCE, atol=TOLERANCE)
    if not isinstance(space, Simplex):
        assert set(np.unique(np.round(got, 9))) == {0, 1}


def test_hard_choices_are_exactly_one_hot():
    """Float32 one-hot vectors are 0 and 1 to the bit (the straight-through terms cancel): they go into the replay."""
    output = 3 * jax.random.normal(jax.random.key(0), (1000, 5))
    for f in (policy_of(Discrete(5)).mode, jax.jit(policy_of(Discrete(5)).mode)):
        got = np.asarray(f(output))
        assert set(np.unique(got)) == {0, 1} and (got.sum(axis=1) == 1).all()


@pytest.mark.parametrize("squash", ["sigmoid", "tanh"])
def test_box_actions(squash):
    """low + (high - low) sigmoid(output), or center + half range tanh(output); noise in half ranges, never out of the
    bounds; the deterministic action and the gradient as in the reference."""
    rng = np.random.default_rng(0)
    output, draw, weight = rng.normal(size=(3, 50, 2)) * 3
    with jax.enable_x64(True):
        policy = policy_of(BOX, squash)
        calm, noisy = policy.mode(output), policy.sample(output, draw, 0.1)
        np.testing.assert_array_equal(policy.sample(output, None), calm)
        slope = jax.grad(lambda o: (policy.mode(o) * weight).sum())(output)
    calm, noisy, slope = map(np.asarray, (calm, noisy, slope))
    want, kept = reference.act(BOX, output, None, squash)
    np.testing.assert_allclose(calm, want, rtol=TOLERANCE, atol=TOLERANCE)
    np.testing.assert_allclose(slope, reference.act_slope(BOX, kept, weight), rtol=TOLERANCE, atol=TOLERANCE)
    np.testing.assert_allclose(noisy, np.clip(want + 0.1 * 2 * draw, -1, 3), rtol=TOLERANCE, atol=TOLERANCE)
    assert (noisy == -1).any() and (noisy == 3).any()
    for space, extreme in ((Simplex((3,)), 80.0), (BOX, 80.0)):
        got = np.asarray(policy_of(space).mode(jnp.array([[extreme, -extreme, 0.0][: space.size]])))
        assert np.isfinite(got).all()


@pytest.mark.parametrize("space", [BOX, *CHOICES], ids=str)
def test_smoothing(space):
    """clip(sigma draw) added: in half ranges and inside the bounds for a Box, as it is for choices."""
    rng = np.random.default_rng(0)
    action, draw = rng.uniform(0, 1, (2, 40, space.size))
    action, draw = 4 * action - 1, 6 * draw - 3
    with jax.enable_x64(True):
        got = np.asarray(policy_of(space).smooth(action, draw, 0.2, 0.5))
    want = action + (2 if isinstance(space, Box) else 1) * np.clip(0.2 * draw, -0.5, 0.5)
    want = np.clip(want, -1, 3) if isinstance(space, Box) else want
    np.testing.assert_allclose(got, want, rtol=TOLERANCE, atol=TOLERANCE)
    assert np.isclose(np.abs(got - action).max(), 1.0 if isinstance(space, Box) else 0.5)


@pytest.mark.parametrize("space", [BOX, *CHOICES], ids=str)
def test_random_actions_and_noise(space):
    """Warm-up actions lie in the space and are uniform (means to 5 standard errors); noise is Gumbel or normal (mean
    0.577 or 0); a deterministic policy has no noise of its own."""
    n, key, policy = 4000, jax.random.key(0), policy_of(space)
    action = np.asarray(jax.jit(policy.random, static_argnums=1)(key, (n, 1)))[:, 0]
    draw = np.asarray(jax.jit(policy.noise, static_argnums=1)(key, (n,)))
    own = policy.own_noise(key, (n,))
    assert action.shape == draw.shape == (n, space.size)
    if isinstance(space, Box):
        assert own is None
        assert (action >= -1).all() and (action <= 3).all()
        mean, spread, noise_mean = 1.0, 4 / np.sqrt(12), 0.0
    else:
        np.testing.assert_array_equal(own, draw)
        for part in reference.choices(space):
            np.testing.assert_allclose(action[:, part].sum(axis=1), 1, atol=1e-6)  # float32
        assert (action >= 0).all()
        mean = np.concatenate([np.full(size, 1 / size) for size in space.sizes])
        spread, noise_mean = 0.5, 0.5772  # an entry between 0 and 1 spreads by a half at most
    assert (np.abs(action.mean(axis=0) - mean) < 5 * spread / np.sqrt(n)).all()
    assert (np.abs(draw.mean(axis=0) - noise_mean) < 5 * 1.29 / np.sqrt(n)).all()


@pytest.mark.parametrize("space", [Simplex((5,)), Discrete(4), MultiDiscrete((3, 2))])
def test_distance_of_choices_is_the_divergence_of_their_probabilities(space):
    policy = policies.of(space, Algorithm())
    output, wanted = np.float64(jax.random.normal(jax.random.key(0), (2, 7, space.size)) * 3)
    total, start = np.zeros(7), 0
    for size in space.sizes:
        p, q = (softmax(part[:, start : start + size], axis=-1) for part in (wanted, output))
        total, start = total + rel_entr(p, q).sum(axis=-1), start + size
    np.testing.assert_allclose(policy.distance(jnp.float32(output), jnp.float32(wanted)), total, rtol=1e-4)
    np.testing.assert_array_equal(policy.distance(jnp.float32(wanted), jnp.float32(wanted)), 0)


@pytest.mark.parametrize("squash", ["sigmoid", "tanh"])
def test_distance_of_box_actions_is_in_half_ranges(squash):
    policy = policies.of(Box(2, -1.0, 3.0), Algorithm(actor_output=squash))
    output, wanted = jnp.array([[0.5, -1.0], [2.0, 2.0]]), jnp.array([[0.1, 3.0], [2.0, 2.0]])
    steep = 1.0 if squash == "tanh" else 0.5  # 2 sigmoid(u) - 1 is tanh(u / 2)
    change = np.tanh(steep * np.float64(output)) - np.tanh(steep * np.float64(wanted))
    np.testing.assert_allclose(policy.distance(output, wanted), (change**2).mean(axis=-1), rtol=1e-5)


def test_to_env():
    """Environments get vectors for a Box and a Simplex and int32 numbers for hard choices, of the right type."""
    vector = jnp.array([[0.0, 1.0, 0.0, 0.0, 1.0], [0.9, 0.1, 0.2, 0.3, 0.25]])
    for space in (Simplex((2, 3)), Box(5)):
        np.testing.assert_array_equal(policy_of(space).to_env(vector), vector)
    one = policy_of(Discrete(5)).to_env(vector)
    many = policy_of(MultiDiscrete((2, 3))).to_env(vector)
    assert one.dtype == many.dtype == jnp.int32
    np.testing.assert_array_equal(one, [1, 0])
    np.testing.assert_array_equal(many, [[1, 2], [0, 1]])
