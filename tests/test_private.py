"""What we use of other libraries without their promise is where we look for it, and what is not there is named."""

import importlib

import brax.fluid
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from matd3_jax import private
from matd3_jax.envs.robots.engines.quietly import mjx


def test_the_coordination_service_is_there():
    state = private.coordination_service()()
    assert state.client is None and callable(state.initialize) and callable(state.shutdown)


def test_mjx_has_its_inner_parts():
    model = mujoco.MjModel.from_xml_string("<mujoco><worldbody><geom size='1 1 1' type='plane'/></worldbody></mujoco>")
    assert private.mjx_implementation(mjx.make_data(model, impl="jax")).contact is not None
    pair = (mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_SPHERE)
    assert private.mjx_collisions()[pair].ncon == 1
    assert private.mjx_collider(contacts=3)(lambda plane, sphere: None).ncon == 3
    slide = np.array([mujoco.mjtJoint.mjJNT_SLIDE])
    assert private.mjx_integrate_positions()(slide, jnp.array([1.0]), jnp.array([4.0]), 0.5) == 3.0


def test_brax_calls_numpy_by_its_name():
    assert private.brax_fluid() is brax.fluid and brax.fluid.jp is jnp


@pytest.mark.parametrize(
    ("module", "name", "look_up"),
    [
        ("jax._src.distributed", "State", private.coordination_service),
        ("mujoco.mjx._src.collision_driver", "_COLLISION_FUNC", private.mjx_collisions),
        ("mujoco.mjx._src.collision_primitive", "collider", lambda: private.mjx_collider(1)),
        ("mujoco.mjx._src.forward", "_integrate_pos", private.mjx_integrate_positions),
        ("brax.fluid", "jp", private.brax_fluid),
    ],
)
def test_what_moved_is_named(module, name, look_up, monkeypatch):
    monkeypatch.delattr(importlib.import_module(module), name)
    with pytest.raises(private.Moved, match=rf"^[a-z-]+ [0-9.]+ has no {module}\.{name} any more"):
        look_up()
