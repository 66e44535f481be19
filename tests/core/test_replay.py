"""The ring of rows against one in NumPy, and the draws from it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from matd3_jax.core import replay

SEEDS, CAPACITY, N, WIDTH = 3, 12, 4, 5


def test_ring_with_wrap_around():
    """After each of 8 writes (more than two rounds) every row of every seed is where a Python ring has it, and `filled`
    counts the rows ever written."""
    write = jax.jit(replay.write)
    rows, ring = replay.allocate(SEEDS, CAPACITY, WIDTH), np.zeros((SEEDS, CAPACITY, WIDTH), np.float32)
    assert rows.shape == ring.shape and rows.dtype == np.float32 and not rows.any()
    rng = np.random.default_rng(0)
    position = written = 0
    for count in range(8):
        assert replay.filled(CAPACITY, N, jnp.int32(count)) == written
        new = rng.normal(size=(SEEDS, N, WIDTH)).astype(np.float32)
        rows = write(rows, new, jnp.int32(count))
        for k in range(N):
            ring[:, position] = new[:, k]
            position = (position + 1) % CAPACITY
        written = min(CAPACITY, written + N)
        np.testing.assert_array_equal(rows, ring)
    assert written == CAPACITY


def test_position_far_on():
    """The position is right after a billion rollouts, near the end of int32 (count * n overflows there)."""
    count = 2**31 - 1
    rows = replay.write(replay.allocate(1, CAPACITY, 1), jnp.ones((1, N, 1)), jnp.int32(count))
    start = count * N % CAPACITY
    np.testing.assert_array_equal(np.flatnonzero(rows[0, :, 0]), start + np.arange(N))
    assert replay.filled(CAPACITY, N, jnp.int32(count)) == CAPACITY


def test_capacity_must_be_a_multiple():
    """A write that would wrap is refused, with both numbers: dynamic_update_slice would shift it silently."""
    with pytest.raises(ValueError, match="12.*multiple.*5"):
        replay.write(replay.allocate(1, 12, 1), jnp.zeros((1, 5, 1)), jnp.int32(0))


def test_gather_takes_the_rows_of_the_seed():
    """Right rows of the right seed, for a traced seed and indices of any shape."""
    rows = jnp.arange(SEEDS * CAPACITY * WIDTH, dtype=jnp.float32).reshape(SEEDS, CAPACITY, WIDTH)
    indices = np.random.default_rng(1).integers(0, CAPACITY, (2, 7))
    gather = jax.jit(replay.gather)
    for seed in range(SEEDS):
        got = gather(rows, jnp.int32(seed), indices)
        np.testing.assert_array_equal(got, np.asarray(rows)[seed][indices])


def test_indices_are_uniform_and_independent():
    """Chi-square of single indices and of pairs (two minibatches of one draw), the key fixed; none beyond `size`.

    The statistic of k - 1 degrees of freedom has mean k - 1 and standard deviation sqrt(2 (k - 1)); five of those above
    the mean is met by chance less than once in 100,000 keys.
    """
    size, shape = 7, (2, 50_000)
    draw = jax.jit(replay.sample_indices, static_argnums=2)
    indices = np.asarray(draw(jax.random.key(3), jnp.int32(size), shape))
    assert indices.shape == shape and indices.dtype == np.int32
    assert indices.min() == 0 and indices.max() == size - 1

    def chi_square(numbers, k):
        expected = numbers.size / k
        return ((np.bincount(numbers.ravel(), minlength=k) - expected) ** 2 / expected).sum()

    for numbers, k in ((indices, size), (indices[0] * size + indices[1], size**2)):
        assert abs(chi_square(numbers, k) - (k - 1)) < 5 * np.sqrt(2 * (k - 1))
    other = draw(jax.random.key(4), jnp.int32(size), shape)
    assert 0.8 < (np.asarray(other) != indices).mean() / (1 - 1 / size) < 1.2


def test_indices_follow_the_filled_part():
    """`size` is a traced number: one program for a replay that fills up; a single row is always row 0."""
    draw = jax.jit(replay.sample_indices, static_argnums=2)
    for size in (1, 3, CAPACITY):
        indices = np.asarray(draw(jax.random.key(size), jnp.int32(size), (400,)))
        assert set(indices) == set(range(size))
