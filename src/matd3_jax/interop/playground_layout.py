"""Which entries of a MuJoCo Playground task's observation belong to which actuator."""

from typing import Any

JOINTS, ACTUATORS = "joints", "actuators"
"""Blocks with an entry for each actuated joint in the order of positions, or for each actuator in theirs."""

Blocks = tuple[int | str, ...]
"""An observation's parts in their order: a number of entries that concern everybody, JOINTS or ACTUATORS."""

_LEGGED: Blocks = (9, JOINTS, JOINTS, ACTUATORS, 3)
_BIPED: Blocks = (12, JOINTS, JOINTS, ACTUATORS, 4)

LAYOUTS: dict[str, Blocks] = {
    "BallInCup": (JOINTS, 2, JOINTS, 2),  # the cup's positions, the ball's; and their velocities
    "CheetahRun": (2, JOINTS, 3, JOINTS),  # height, pitch, joints; velocities
    "HopperHop": (2, JOINTS, 3, JOINTS, 2),  # ... and touch
    "HopperStand": (2, JOINTS, 3, JOINTS, 2),
    "HumanoidRun": (JOINTS, 25, JOINTS),  # joints; head, extremities, upright, velocities of the root; velocities
    "HumanoidStand": (JOINTS, 25, JOINTS),
    "HumanoidWalk": (JOINTS, 25, JOINTS),
    "SwimmerSwimmer6": (JOINTS, 20),  # joints; nose to target, velocities of the bodies
    "WalkerRun": (18, JOINTS),  # orientations, height, velocities of the root; velocities
    "WalkerStand": (18, JOINTS),
    "WalkerWalk": (18, JOINTS),
    # Velocity, gyroscope, gravity; joints, their velocities, the last action; command.
    "Go1JoystickFlatTerrain": _LEGGED,
    "Go1JoystickRoughTerrain": _LEGGED,
    # Velocity, gyroscope, gravity, command; joints, their velocities, the last action; phase.
    "ApolloJoystickFlatTerrain": _BIPED,
    "BerkeleyHumanoidJoystickFlatTerrain": _BIPED,
    "BerkeleyHumanoidJoystickRoughTerrain": _BIPED,
    "G1JoystickFlatTerrain": _BIPED,
    "G1JoystickRoughTerrain": _BIPED,
    "T1JoystickFlatTerrain": _BIPED,
    "T1JoystickRoughTerrain": _BIPED,
}
"""Of the tasks where all that belongs to an actuator can be distinguished (playground 0.2.0)."""


def owners(id: str, mj_model: Any, size: int) -> tuple[int | None, ...] | None:
    """For each of the `size` entries of the observation of the task `id` the actuator that it belongs to, or None where
    it concerns everybody; None for all of it where that is unknown.

    A layout that does not have `size` entries, of another version or with other options, counts as unknown.
    """
    joints = _joints(mj_model)
    if id not in LAYOUTS or joints is None:
        return None
    found: list[int | None] = []
    for block in LAYOUTS[id]:
        if isinstance(block, int):
            found += [None] * block
        else:
            found += joints if block == JOINTS else range(mj_model.nu)
    return tuple(found) if len(found) == size else None


def _joints(mj_model: Any) -> list[int] | None:
    """The actuators in the order of their joints' positions; None where one moves something else."""
    import mujoco

    if (mj_model.actuator_trntype != mujoco.mjtTrn.mjTRN_JOINT).any():
        return None
    addresses = mj_model.jnt_qposadr[mj_model.actuator_trnid[:, 0]]
    return sorted(range(mj_model.nu), key=lambda actuator: int(addresses[actuator]))
