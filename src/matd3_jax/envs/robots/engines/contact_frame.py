"""C MuJoCo's contact frame between plane and capsule, in MJX's place (google-deepmind/mujoco issue 2774)."""

import contextlib
from collections.abc import Callable, Iterator, MutableMapping

import jax.numpy as jnp
import mujoco

from matd3_jax.private import Moved, mjx_collider, mjx_collisions

PLANE_CAPSULE = (mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_CAPSULE)


@mjx_collider(contacts=2)
def plane_capsule(plane, capsule):
    """Contacts of a capsule's two ends with a plane: distance [2], position [2, 3], frame [2, 3, 3] (rows: normal, two
    tangents).

    The first tangent is the capsule's axis projected on the plane, however upright the capsule stands. MJX takes the
    world's y axis where that is more than 60 degrees, which turns the pyramid that stands for the friction cone.
    """
    normal, axis = plane.mat[:, 2], capsule.mat[:, 2]
    along = axis - normal * jnp.dot(normal, axis)
    square = jnp.dot(along, along)
    upright = square < 1e-30  # exactly upright: C's normalization of a vector of length 0 gives the x axis
    unit = along / jnp.sqrt(jnp.where(upright, 1, square))
    tangent = jnp.where(upright, jnp.array([1.0, 0, 0], unit.dtype), unit)
    frame = jnp.stack([normal, tangent, jnp.cross(normal, tangent)])
    ends = capsule.pos + jnp.stack([axis, -axis]) * capsule.size[1]
    distance = (ends - plane.pos) @ normal - capsule.size[0]
    position = ends - normal * (capsule.size[0] + distance[:, None] / 2)
    return distance, position, jnp.stack([frame, frame])


def table() -> MutableMapping[tuple, Callable]:
    """MJX's private table of collision functions. Raises Moved if this version has none of a plane and a capsule."""
    found = mjx_collisions()
    if PLANE_CAPSULE not in found:
        raise Moved(f"mujoco-mjx {mujoco.__version__} has no collision function of plane and capsule in its table")
    return found


@contextlib.contextmanager
def as_in_c() -> Iterator[None]:
    """Within: what is traced of MJX's collisions has C's frame. MJX itself is left as it was for everybody else."""
    functions = table()
    stock = functions[PLANE_CAPSULE]
    functions[PLANE_CAPSULE] = plane_capsule
    try:
        yield
    finally:
        functions[PLANE_CAPSULE] = stock
