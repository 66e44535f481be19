"""Seeds over devices: who trains which, copies that fill the mesh up, and what divides a minibatch."""

import jax
import numpy as np
import pytest

from matd3_jax.training.sharding import SeedSharding, idle_devices, stack, unstack


def test_every_seed_has_a_device_and_copies_fill_the_mesh():
    one, two = jax.devices()[:2]
    sharding = SeedSharding(3, batch_size=8, devices=[one, two])
    assert (sharding.local_seeds, sharding.padded_seeds, sharding.minibatch_axis) == (2, 4, None)
    assert sharding.device_seeds() == [(one, [0, 1]), (two, [2, 2])]
    padded = np.asarray(sharding.pad(np.arange(6.0).reshape(3, 2)))
    np.testing.assert_array_equal(padded, [[0, 1], [2, 3], [4, 5], [4, 5]])
    doubled = jax.jit(sharding.sharded(lambda x: 2 * x, jax.P("seeds"), jax.P("seeds")))(padded)
    np.testing.assert_array_equal(doubled, 2 * padded)
    assert len(doubled.sharding.device_set) == 2


def test_idle_devices_share_a_seed_where_they_divide_its_minibatch():
    assert [idle_devices(*case) for case in ((4, 2, 8), (4, 3, 8), (4, 2, 7), (8, 1, 8))] == [2, 1, 1, 2]
    one, two = jax.devices()[:2]
    sharding = SeedSharding(1, batch_size=8, devices=[one, two])
    assert sharding.device_seeds() == [(one, [0]), (two, [0])] and sharding.minibatch_axis == "minibatch"
    for size, per_seed in ((7, 2), (9, 3)):  # an odd minibatch; more devices than there are
        with pytest.raises(ValueError, match=f"{per_seed} of 2 devices cannot share {size} rows"):
            SeedSharding(1, batch_size=size, devices=[one, two], devices_per_seed=per_seed)


def test_few_large_seeds_of_a_device_are_apart():
    one = jax.devices()[:1]
    for seeds, size, together, apart in (
        (2, 10**8, None, True),
        (1, 10**8, None, False),  # nothing to take apart
        (9, 10**8, None, False),  # long to compile
        (2, 10**3, None, False),  # small: the loop over seeds costs nothing
        (2, 10**8, 2, False),  # updated together
    ):
        assert SeedSharding(seeds, 8, one, seeds_together=together).apart(size) == apart, (seeds, size, together)


def test_unstack_undoes_stack():
    trees = [{"a": np.full((2, 3), k), "b": np.array(k)} for k in range(3)]
    for tree, again in zip(trees, unstack(stack(trees), 3), strict=True):
        jax.tree.map(np.testing.assert_array_equal, tree, again)
