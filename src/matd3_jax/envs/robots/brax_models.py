"""brax's robots as brax and MuJoCo load them, and what differs between them."""

import contextlib
import dataclasses
import functools
import importlib.resources
import types
from collections.abc import Iterator
from typing import Any, NamedTuple
from unittest import mock

import jax
import jax.numpy as jnp

from matd3_jax.envs.robots.partition.partition import KinematicTree, Layout, describe, lay_out
from matd3_jax.envs.robots.quiet import quiet, quiet_mujoco
from matd3_jax.errors import OptionError
from matd3_jax.private import brax_fluid
from matd3_jax.thread_pool import make_room_for_lapack

BACKENDS = ("spring", "positional", "generalized")


class Facts(NamedTuple):
    """What differs between brax's robots."""

    brax_name: str
    hidden: int
    """Leading positions that the observation leaves out."""
    forward: str
    """brax's metrics that are parts of the reward: for moving forwards, ..."""
    survive: str | None
    """... for not falling (None: no such part), ..."""
    ctrl: str
    """... and, negative, for the motors' effort."""
    backends: tuple[str, ...] = BACKENDS

    @property
    def measures(self) -> dict[str, str]:
        """Our name of a quantity -> brax's in its metrics."""
        parts = {"reward_forward": self.forward, "reward_survive": self.survive, "reward_ctrl": self.ctrl}
        return {"forward_velocity": "x_velocity"} | {ours: brax for ours, brax in parts.items() if brax is not None}


FACTS = {
    "ant": Facts("ant", 2, "reward_forward", "reward_survive", "reward_ctrl"),
    "half_cheetah": Facts("halfcheetah", 1, "reward_run", None, "reward_ctrl"),
    "hopper": Facts("hopper", 1, "reward_forward", "reward_healthy", "reward_ctrl"),
    "walker2d": Facts("walker2d", 1, "reward_forward", "reward_healthy", "reward_ctrl"),
    "humanoid": Facts("humanoid", 2, "reward_linvel", "reward_alive", "reward_quadctrl"),
    "swimmer": Facts("swimmer", 2, "reward_fwd", None, "reward_ctrl", ("generalized",)),
}
_SAME_JOINTS = {"rot2": "motor1_rot", "rot3": "motor2_rot"}  # brax's swimmer has older names than gymnasium's


def import_brax() -> Any:
    """The module brax.envs."""
    try:
        with quiet():
            import brax.envs
    except ImportError as error:
        raise OptionError(f"brax's robots need brax: pip install brax ({error})") from error
    return brax.envs


@contextlib.contextmanager
def calling() -> Iterator[None]:
    """Circumstances in which brax's own functions are called."""
    # brax 0.14.2 passes clip a keyword that JAX has dropped since; only the swimmer's water needs it.
    numpy = types.SimpleNamespace(**vars(jnp) | {"clip": lambda x, a_min: jnp.clip(x, min=a_min)})
    # TF32, a GPU's default for matrix products, is too coarse for physics.
    with quiet(), mock.patch.object(brax_fluid(), "jp", numpy), jax.default_matmul_precision("highest"):
        yield


@functools.cache
def load(robot: str, backend: str) -> Any:
    """brax's environment. Its arrays are made outside whatever is being traced: they outlive it."""
    if backend == "generalized":
        make_room_for_lapack(f"env.backend={backend}")
    with quiet(), quiet_mujoco(), jax.ensure_compile_time_eval():
        return import_brax().get_environment(FACTS[robot].brax_name, backend=backend)


@functools.cache
def mj_model(robot: str) -> Any:
    """brax's model file as MuJoCo reads it: bodies welded to others stay apart, which brax fuses."""
    import mujoco

    assets = importlib.resources.files("brax.envs") / "assets"
    with quiet_mujoco():
        return mujoco.MjModel.from_xml_path(str(assets / f"{robot}.xml"))


@functools.cache
def tree(robot: str) -> KinematicTree:
    """The robot's bodies and joints, which have gymnasium's names."""
    found = describe(mj_model(robot))
    joints = tuple(dataclasses.replace(j, name=_SAME_JOINTS.get(j.name, j.name)) for j in found.joints)
    return dataclasses.replace(found, joints=joints)


@functools.cache
def layout(robot: str, velocities: bool = True) -> Layout:
    """Where everything stands in brax's observation, with or without its velocities."""
    model, hidden = mj_model(robot), FACTS[robot].hidden
    if robot != "humanoid":
        return lay_out(model.nq, model.nv, hidden, velocities=velocities)
    # brax shows its links: the bodies that have joints. The feet belong to the shins.
    links = [body for body in range(1, model.nbody) if model.body_jntnum[body]]
    return lay_out(
        model.nq, model.nv, hidden, cinert=links, cvel=links, qfrc_actuator=range(model.nv), velocities=velocities
    )


@functools.cache
def without_velocities(robot: str) -> tuple[int, ...]:
    """Of brax's observation the entries that `layout` has without velocities, in their order."""
    whole = layout(robot)
    velocities = {i for k in range(len(whole.qvel)) for i in whole.entry("qvel", k)}
    velocities |= {i for k in range(len(whole.cvel)) for i in whole.entry("cvel", k)}
    return tuple(i for i in range(whole.size) if i not in velocities)
