"""Stacked perceptrons against single ones in NumPy, their start, and actions from actor outputs."""

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

pytestmark = pytest.mark.usefixtures("quick_jit")


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


# ---- actions ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("space", CHOICES, ids=str)
def test_choices(space):
    """Soft or hard samples of softmax(logits + noise), part by part, as the reference has them; without noise the
    likeliest; the hard sample has the soft one's gradient."""
    rng = np.random.default_rng(0)
    output, draw, weight = rng.normal(size=(3, 6, space.size))
    with jax.enable_x64(True):
        for noise in (draw, None):

            def act(o, noise=noise):
                action = networks.act(space, o, noise)
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
    for f in (networks.act, jax.jit(networks.act, static_argnums=0)):
        got = np.asarray(f(Discrete(5), output, None))
        assert set(np.unique(got)) == {0, 1} and (got.sum(axis=1) == 1).all()


@pytest.mark.parametrize("squash", ["sigmoid", "tanh"])
def test_box_actions(squash):
    """low + (high - low) sigmoid(output), or centre + half range tanh(output); noise in half ranges, never out of the
    bounds; the deterministic action and the gradient as in the reference."""
    rng = np.random.default_rng(0)
    output, draw, weight = rng.normal(size=(3, 50, 2)) * 3
    with jax.enable_x64(True):
        calm = networks.act(BOX, output, None, squash=squash)
        noisy = networks.act(BOX, output, draw, 0.1, squash)
        slope = jax.grad(lambda o: (networks.act(BOX, o, None, squash=squash) * weight).sum())(output)
    calm, noisy, slope = map(np.asarray, (calm, noisy, slope))
    want, kept = reference.act(BOX, output, None, squash)
    np.testing.assert_allclose(calm, want, rtol=TOLERANCE, atol=TOLERANCE)
    np.testing.assert_allclose(slope, reference.act_slope(BOX, kept, weight), rtol=TOLERANCE, atol=TOLERANCE)
    np.testing.assert_allclose(noisy, np.clip(want + 0.1 * 2 * draw, -1, 3), rtol=TOLERANCE, atol=TOLERANCE)
    assert (noisy == -1).any() and (noisy == 3).any()
    for space, extreme in ((Simplex((3,)), 80.0), (BOX, 80.0)):
        got = np.asarray(networks.act(space, jnp.array([[extreme, -extreme, 0.0][: space.size]]), None))
        assert np.isfinite(got).all()


@pytest.mark.parametrize("space", [BOX, *CHOICES], ids=str)
def test_smoothing(space):
    """clip(sigma draw) added: in half ranges and inside the bounds for a Box, as it is for choices."""
    rng = np.random.default_rng(0)
    action, draw = rng.uniform(0, 1, (2, 40, space.size))
    action, draw = 4 * action - 1, 6 * draw - 3
    with jax.enable_x64(True):
        got = np.asarray(networks.smooth(space, action, draw, 0.2, 0.5))
    want = action + (2 if isinstance(space, Box) else 1) * np.clip(0.2 * draw, -0.5, 0.5)
    want = np.clip(want, -1, 3) if isinstance(space, Box) else want
    np.testing.assert_allclose(got, want, rtol=TOLERANCE, atol=TOLERANCE)
    assert np.isclose(np.abs(got - action).max(), 1.0 if isinstance(space, Box) else 0.5)


@pytest.mark.parametrize("space", [BOX, *CHOICES], ids=str)
def test_random_actions_and_noise(space):
    """Warm-up actions lie in the space and are uniform (means to 5 standard errors); noise is Gumbel or normal (mean
    0.577 or 0); a deterministic policy has no noise of its own."""
    n, key = 4000, jax.random.key(0)
    action = np.asarray(jax.jit(networks.random_action, static_argnums=(1, 2))(key, space, (n, 1)))[:, 0]
    draw = np.asarray(jax.jit(networks.noise, static_argnums=(1, 2))(key, space, (n,)))
    own = networks.policy_noise(key, space, (n,))
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


def test_to_env():
    """Environments get vectors for a Box and a Simplex and int32 numbers for hard choices, of the right type."""
    vector = jnp.array([[0.0, 1.0, 0.0, 0.0, 1.0], [0.9, 0.1, 0.2, 0.3, 0.25]])
    for space in (Simplex((2, 3)), Box(5)):
        np.testing.assert_array_equal(networks.to_env(space, vector), vector)
    one = networks.to_env(Discrete(5), vector)
    many = networks.to_env(MultiDiscrete((2, 3)), vector)
    assert one.dtype == many.dtype == jnp.int32
    np.testing.assert_array_equal(one, [1, 0])
    np.testing.assert_array_equal(many, [[1, 2], [0, 1]])
