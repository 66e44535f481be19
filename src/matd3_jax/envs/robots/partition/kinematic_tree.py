"""A robot's bodies and actuated joints, as far as sharing them out among agents needs to know them."""

import dataclasses
from collections.abc import Iterable
from typing import Any


@dataclasses.dataclass(frozen=True)
class Joint:
    """One actuated hinge or slide of a robot."""

    name: str
    qpos: int
    """Index of its generalized position."""
    qvel: int
    """Index of its degree of freedom."""
    actuator: int
    """Index of the control that moves it."""
    body: int
    """The body it moves."""


@dataclasses.dataclass(frozen=True)
class KinematicTree:
    """What `partition` needs to know of a robot's model."""

    joints: tuple[Joint, ...]
    """The actuated joints, in the order of their positions."""
    root_qpos: tuple[int, ...]
    """Generalized positions that no actuator moves: where the robot is."""
    root_qvel: tuple[int, ...]
    """Degrees of freedom that no actuator moves."""
    parents: tuple[int, ...]
    """Parent of each body; the world, body 0, is its own."""


def describe(mj_model: Any) -> KinematicTree:
    """The kinematic tree of a `mujoco.MjModel` in which an actuator is a motor on one hinge or slide."""
    actuated = {int(joint): actuator for actuator, joint in enumerate(mj_model.actuator_trnid[:, 0])}
    if len(actuated) < mj_model.nu:
        raise ValueError("two actuators move the same joint")
    joints = tuple(
        Joint(
            name=mj_model.joint(j).name,
            qpos=int(mj_model.jnt_qposadr[j]),
            qvel=int(mj_model.jnt_dofadr[j]),
            actuator=actuated[j],
            body=int(mj_model.jnt_bodyid[j]),
        )
        for j in sorted(actuated)
    )
    moved_qpos, moved_qvel = ({getattr(joint, name) for joint in joints} for name in ("qpos", "qvel"))
    return KinematicTree(
        joints=joints,
        root_qpos=tuple(i for i in range(mj_model.nq) if i not in moved_qpos),
        root_qvel=tuple(i for i in range(mj_model.nv) if i not in moved_qvel),
        parents=tuple(int(parent) for parent in mj_model.body_parentid),
    )


def own_bodies(joints: Iterable[Joint], tree: KinematicTree) -> tuple[int, ...]:
    """The bodies of an agent with these joints, ascending.

    A body goes with the actuated joints that attach it; one welded to its parent goes with that parent, but if that is
    the trunk, with the next joints below it (the ant's upper legs are welded to the torso). The trunk is nobody's.
    """
    attached: dict[int, set[Joint]] = {}
    for joint in tree.joints:
        attached.setdefault(joint.body, set()).add(joint)
    children: dict[int, list[int]] = {}
    for body, parent in enumerate(tree.parents):
        if body:
            children.setdefault(parent, []).append(body)

    def above(body: int) -> set[Joint]:
        return attached.get(body, set()) or (above(tree.parents[body]) if body else set())

    def below(body: int) -> set[Joint]:
        return attached.get(body) or set().union(*map(below, children.get(body, ())))

    trunk = {0, *children.get(0, ())}
    own = set(joints)
    return tuple(
        body
        for body in range(len(tree.parents))
        if body not in trunk and not own.isdisjoint(above(body) or below(body))
    )
