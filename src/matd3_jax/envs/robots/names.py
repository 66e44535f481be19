"""What the entries of a robot's observations and actions are, in words with units, from its model."""

from typing import Any

import mujoco

from matd3_jax.envs.robots.partition.layout import Layout

AXES = ("x", "y", "z")
INERTIA = (*(f"inertia {pair} (kg m^2)" for pair in ("xx", "yy", "zz", "xy", "xz", "yz")),
           *(f"mass times offset {axis} (kg m)" for axis in AXES), "mass (kg)")  # fmt: skip


def full_observation(layout: Layout, model: mujoco.MjModel) -> tuple[str, ...]:
    """For each entry of the full observation what it is."""
    names = [""] * layout.size
    of_bodies: dict[str, tuple[str, ...]] = {
        "cinert": INERTIA,
        "cvel": (*(f"angular velocity {a} (rad/s)" for a in AXES), *(f"velocity {a} (m/s)" for a in AXES)),
        "cfrc_ext": (*(f"external torque {a} (N m)" for a in AXES), *(f"external force {a} (N)" for a in AXES)),
    }
    degrees = [text for joint in range(model.njnt) for text in _velocities(model, joint)]
    forces = [_replaced(text) for text in degrees]
    places = [text for joint in range(model.njnt) for text in _positions(model, joint)]
    words: dict[str, list[tuple[str, ...]]] = {
        "qpos": [(text,) for text in places],
        "qvel": [(text,) for text in degrees],
        "qfrc_actuator": [(text,) for text in forces],
    }
    for kind, parts in of_bodies.items():
        bodies = [model.body(body).name or str(body) for body in range(model.nbody)]
        words[kind] = [tuple(f"body {body}: {part}" for part in parts) for body in bodies]
    for kind, each in words.items():
        for index, texts in enumerate(each):
            for entry, text in zip(layout.entry(kind, index), texts, strict=False):
                names[entry] = text
    return tuple(names)


def actuators(model: mujoco.MjModel) -> tuple[str, ...]:
    """For each control what it does: the joint that it moves, and the torque or force of a control of 1."""
    found = []
    for k in range(model.nu):
        joint = int(model.actuator_trnid[k, 0])
        unit = "N" if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE else "N m"
        gear = model.actuator_gear[k, 0] * model.actuator_gainprm[k, 0]
        found.append(f"actuator {_name(model, joint)} ({gear:g} {unit} at 1)")
    return tuple(found)


def _name(model: mujoco.MjModel, joint: int) -> str:
    return model.joint(joint).name or f"joint {joint}"


def _positions(model: mujoco.MjModel, joint: int) -> list[str]:
    name, kind = _name(model, joint), model.jnt_type[joint]
    if kind == mujoco.mjtJoint.mjJNT_FREE:
        turn = [f"{name}: orientation, quaternion {part}" for part in ("w", *AXES)]
        return [f"{name}: position {axis} (m)" for axis in AXES] + turn
    return [f"{name}: position ({'m' if kind == mujoco.mjtJoint.mjJNT_SLIDE else 'rad'})"]


def _velocities(model: mujoco.MjModel, joint: int) -> list[str]:
    name, kind = _name(model, joint), model.jnt_type[joint]
    if kind == mujoco.mjtJoint.mjJNT_FREE:
        turning = [f"{name}: angular velocity {axis}, its own axes (rad/s)" for axis in AXES]
        return [f"{name}: velocity {axis} (m/s)" for axis in AXES] + turning
    return [f"{name}: velocity ({'m/s' if kind == mujoco.mjtJoint.mjJNT_SLIDE else 'rad/s'})"]


def _replaced(velocity: str) -> str:
    """What the actuators do to a degree of freedom, from the words for its velocity."""
    name = velocity.split(":")[0]
    return f"{name}: actuator {'torque (N m)' if 'rad/s' in velocity else 'force (N)'}"


def share(items: Any, own: tuple[tuple[int, ...], ...]) -> tuple[tuple[str, ...], ...]:
    """The items that each agent has, by their indices."""
    return tuple(tuple(items[i] for i in indices) for indices in own)
