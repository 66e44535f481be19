"""Which device trains which seeds: the mesh, shardings of what has an axis [seeds], seeds as arrays of their own."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as P

APART_SEEDS, APART_BYTES = 4, 4 * 2**20
"""Up to this many seeds of a device, whose networks and moments take more bytes each, are separate arrays (`apart`)."""


def idle_devices(devices: int, seeds: int, batch_size: int) -> int:
    """How many devices each seed can have where there are fewer seeds than devices: two, if there are two for it and
    they divide the minibatch, else one. More than two were not measured, and each has the seed's whole replay."""
    return 2 if devices >= 2 * seeds and batch_size % 2 == 0 else 1


class SeedSharding:
    """Distributes `num_seeds` seeds over devices.

    Args:
        batch_size: transitions of a minibatch, which devices that share a seed divide.
        devices: default all devices.
        devices_per_seed: how many of the devices share the work of one seed, each with an equal part of every
            minibatch (the networks are the same on all, and so is the replay). Default on CPU: `idle_devices`;
            elsewhere 1.
        seeds_together: how many of a device's seeds are updated together; default 1 on CPU (a seed's minibatch stays in
            cache) and all of them elsewhere.

    Raises:
        ValueError: `devices_per_seed` devices cannot share a minibatch.
    """

    def __init__(
        self,
        num_seeds: int,
        batch_size: int,
        devices: Sequence[jax.Device] | None = None,
        devices_per_seed: int | None = None,
        seeds_together: int | None = None,
    ):
        devices = list(jax.devices() if devices is None else devices)
        self.num_seeds, self.on_cpu = num_seeds, devices[0].platform == "cpu"
        if devices_per_seed is None:
            devices_per_seed = idle_devices(len(devices), num_seeds, batch_size) if self.on_cpu else 1
        if batch_size % devices_per_seed or devices_per_seed > len(devices):
            raise ValueError(f"{devices_per_seed} of {len(devices)} devices cannot share {batch_size} rows")
        self.devices_per_seed = devices_per_seed
        shares = min(len(devices) // devices_per_seed, num_seeds)
        grid = np.array(devices[: shares * devices_per_seed]).reshape(shares, devices_per_seed)
        self.mesh = Mesh(grid, ("seeds", "minibatch"))
        self.local_seeds = math.ceil(num_seeds / shares)
        """Seeds on each device."""
        self.padded_seeds = self.local_seeds * shares
        """Seeds actually run: `num_seeds` filled up to a multiple of the mesh with copies of the last one."""
        self.seeds_together = seeds_together or (1 if self.on_cpu else self.local_seeds)

    @property
    def minibatch_axis(self) -> str | None:
        """The mesh's axis over which a seed's minibatch is divided; None where a seed has one device."""
        return "minibatch" if self.devices_per_seed > 1 else None

    def pad(self, leaf: chex.Array) -> chex.Array:
        """Fill a leaf [num_seeds, ...] up to [padded_seeds, ...] with copies of the last seed's."""
        extra = self.padded_seeds - leaf.shape[0]
        return jnp.concatenate([leaf, jnp.repeat(leaf[-1:], extra, axis=0)]) if extra else leaf

    def device_seeds(self) -> list[tuple[jax.Device, list[int]]]:
        """List each device with the numbers of the seeds it runs (copies bear the last seed's number)."""
        numbers = [min(seed, self.num_seeds - 1) for seed in range(self.padded_seeds)]
        shares = [numbers[i : i + self.local_seeds] for i in range(0, self.padded_seeds, self.local_seeds)]
        return [(d, share) for row, share in zip(self.mesh.devices, shares, strict=True) for d in row]

    def named(self, spec: P) -> NamedSharding:
        """Make a sharding over the mesh."""
        return NamedSharding(self.mesh, spec)

    def sharded(self, f: Callable, in_specs: Any, out_specs: Any) -> Callable:
        """Make the function that calls `f` on every device with its own part of the arguments."""
        return jax.shard_map(f, mesh=self.mesh, in_specs=in_specs, out_specs=out_specs, check_vma=False)

    def apart(self, seed_bytes: int) -> bool:
        """Whether a program holds the networks of each seed as arrays of their own, and updates one seed after another
        without a loop.

        A loop over seeds copies each seed's networks out of the stack and back: at 400-300 units that took as long as
        the updates themselves. More seeds would take long to compile.

        Args:
            seed_bytes: of one seed's networks and moments.
        """
        few = 1 < self.local_seeds <= APART_SEEDS and self.seeds_together == 1
        return self.on_cpu and few and seed_bytes > APART_BYTES


def stack(trees: Sequence[Any]) -> Any:
    """Join trees of equal structure: leaves with a leading axis [trees]."""
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees)


def unstack(tree: Any, count: int) -> list[Any]:
    """Take a tree apart along its leading axis [count]: the inverse of `stack`."""
    return [jax.tree.map(lambda leaf, k=k: leaf[k], tree) for k in range(count)]
