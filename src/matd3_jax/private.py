"""What we use of other libraries without their promise to keep it: looked up here, and nowhere else.

Each function raises `Moved` where the installed version has no such thing; tests/test_private.py calls all of them.
"""

import importlib
from collections.abc import Callable, MutableMapping
from importlib import metadata
from typing import Any


class Moved(RuntimeError):
    """An installed library no longer has something that it never promised to keep."""


def coordination_service() -> Any:
    """Look up JAX's coordination service: the class of its state, which has `initialize`, `shutdown` and `client`.

    JAX has no public key-value store between processes; `jax.distributed` also makes its backends join the processes.
    """
    client = _find("jaxlib", "jaxlib._jax", "DistributedRuntimeClient")
    for name in (
        *("key_value_set", "key_value_set_bytes", "blocking_key_value_get_bytes"),
        *("key_value_delete", "key_value_dir_get"),
    ):
        _attribute("jaxlib", client, "jaxlib._jax.DistributedRuntimeClient", name)
    return _find("jax", "jax._src.distributed", "State")


def mjx_collisions() -> MutableMapping[tuple, Callable]:
    """Look up MJX's table of collision functions by pairs of geometry types."""
    name = "_COLLISION_FUNC"
    found = _find("mujoco-mjx", "mujoco.mjx._src.collision_driver", name)
    if not isinstance(found, dict):
        raise _moved("mujoco-mjx", f"mujoco.mjx._src.collision_driver.{name} (a dictionary)")
    return found


def mjx_collider(contacts: int) -> Callable[[Callable], Callable]:
    """Decorate a collision function of two geometries that has `contacts` contacts, as MJX calls it."""
    return _find("mujoco-mjx", "mujoco.mjx._src.collision_primitive", "collider")(ncon=contacts)


def mjx_integrate_positions() -> Callable:
    """Look up how MJX moves positions along velocities: (joint types, qpos, qvel, dt) -> qpos."""
    return _find("mujoco-mjx", "mujoco.mjx._src.forward", "_integrate_pos")


def mjx_implementation(data: Any) -> Any:
    """Take what belongs to the implementation of an `mjx.Data`, whose fields come with a warning when it is asked."""
    return _attribute("mujoco-mjx", data, "mujoco.mjx.Data", "_impl")


def brax_fluid() -> Any:
    """Import brax's module of forces in water, whose name `jp` for jax.numpy is to be replaced."""
    _find("brax", "brax.fluid", "jp")
    return importlib.import_module("brax.fluid")


def _find(distribution: str, module: str, name: str) -> Any:
    from matd3_jax.envs.robots.quiet import quiet  # MJX and brax speak when they are imported

    try:
        with quiet():
            found = importlib.import_module(module)
    except ImportError as error:
        raise _moved(distribution, f"{module}.{name}") from error
    return _attribute(distribution, found, module, name)


def _attribute(distribution: str, owner: Any, where: str, name: str) -> Any:
    try:
        return getattr(owner, name)
    except AttributeError as error:
        raise _moved(distribution, f"{where}.{name}") from error


def _moved(distribution: str, name: str) -> Moved:
    version = metadata.version(distribution)
    return Moved(f"{distribution} {version} has no {name} any more; install a version that pyproject.toml allows")
