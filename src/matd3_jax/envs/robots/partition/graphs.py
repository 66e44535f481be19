"""Joint graphs of the robots: which joints adjoin, and the partitions of them that the literature uses.

Facts about MaMuJoCo (Peng et al., FACMAC, 2021) are those of gymnasium-robotics 1.4.2. Joints have the names, and
bodies the numbers, of gymnasium's model files.
"""

import dataclasses
from collections.abc import Mapping


@dataclasses.dataclass(frozen=True)
class Graph:
    """The actuated joints of one robot."""

    splits: Mapping[str, tuple[tuple[str, ...], ...]]
    """Name of a partition -> joints of each agent, in the order of its actions. The first is the default."""
    edges: tuple[tuple[str, ...], ...]
    """Hyperedges: the joints of one are all one step from each other."""
    bodies: Mapping[str, tuple[int, ...]] = dataclasses.field(default_factory=dict)
    """Joint -> bodies whose inertia, velocity and forces MaMuJoCo shows with it."""
    root_velocity: Mapping[str, int] = dataclasses.field(default_factory=dict)
    """Joint -> degree of freedom of the root that MaMuJoCo shows with it, before its own, and not to everybody."""
    labels: Mapping[str, str] = dataclasses.field(default_factory=dict)
    """Joint -> MaMuJoCo's name of it, where that is another one: MaMuJoCo sorts entries by name."""


_ANT_LEGS = tuple((f"hip_{leg}", f"ankle_{leg}") for leg in (1, 2, 3, 4))
_LEFT, _RIGHT = _ANT_LEGS[0] + _ANT_LEGS[1], _ANT_LEGS[2] + _ANT_LEGS[3]

_ABDOMEN = ("abdomen_x", "abdomen_y", "abdomen_z")
_HIPS = {side: tuple(f"{side}_hip_{axis}" for axis in "xyz") for side in ("right", "left")}
_SHOULDERS = {side: (f"{side}_shoulder1", f"{side}_shoulder2") for side in ("right", "left")}

GRAPHS: Mapping[str, Graph] = {
    "ant": Graph(
        # The robot walks towards +x: legs 1 and 2, at y > 0, are its left half.
        splits={
            "halves": (_LEFT, _RIGHT),
            "2x4": (_LEFT, _RIGHT),
            "2x4d": (_ANT_LEGS[0] + _ANT_LEGS[3], _ANT_LEGS[1] + _ANT_LEGS[2]),
            "4x2": _ANT_LEGS,
        },
        edges=(*_ANT_LEGS, ("hip_1", "hip_2", "hip_3", "hip_4")),
        bodies={f"hip_{leg}": (1, 3 * leg - 1) for leg in (1, 2, 3, 4)}
        | {f"ankle_{leg}": (3 * leg - 1, 3 * leg, 3 * leg + 1) for leg in (1, 2, 3, 4)},
    ),
    "half_cheetah": Graph(
        splits={
            "2x3": (("bthigh", "bshin", "bfoot"), ("fthigh", "fshin", "ffoot")),
            "6x1": (("bthigh",), ("bshin",), ("bfoot",), ("fthigh",), ("fshin",), ("ffoot",)),
        },
        edges=(("bfoot", "bshin"), ("bshin", "bthigh"), ("bthigh", "fthigh"), ("fthigh", "fshin"), ("fshin", "ffoot")),
    ),
    "hopper": Graph(
        splits={"3x1": (("thigh_joint",), ("leg_joint",), ("foot_joint",))},
        edges=(("foot_joint", "leg_joint"), ("leg_joint", "thigh_joint")),
    ),
    "walker2d": Graph(
        splits={
            "2x3": (
                ("foot_joint", "leg_joint", "thigh_joint"),
                ("foot_left_joint", "leg_left_joint", "thigh_left_joint"),
            ),
        },
        edges=(
            ("foot_joint", "leg_joint"),
            ("leg_joint", "thigh_joint"),
            ("foot_left_joint", "leg_left_joint"),
            ("leg_left_joint", "thigh_left_joint"),
            ("thigh_joint", "thigh_left_joint"),
        ),
    ),
    "humanoid": Graph(
        splits={
            "9|8": (
                (*_ABDOMEN, *_SHOULDERS["right"], "right_elbow", *_SHOULDERS["left"], "left_elbow"),
                (*_HIPS["right"], "right_knee", *_HIPS["left"], "left_knee"),
            ),
        },
        edges=tuple(
            edge
            for side in ("right", "left")
            for edge in (
                (*_SHOULDERS[side], f"{side}_elbow"),
                (*_HIPS[side], f"{side}_knee"),
                (*_SHOULDERS[side], *_ABDOMEN),
                (*_HIPS[side], *_ABDOMEN),
            )
        ),
        bodies={
            "abdomen_z": (1, 2, 3),
            "abdomen_y": (1, 2, 3),
            "abdomen_x": (3, 4, 7),
            "right_elbow": (11,),
            "left_elbow": (13,),
            "right_knee": (5, 6),
            "left_knee": (8, 9),
        }
        | {joint: (4, 5) for joint in _HIPS["right"]}
        | {joint: (7, 8) for joint in _HIPS["left"]}
        | {joint: (1, 10, 11) for joint in _SHOULDERS["right"]}
        | {joint: (1, 12, 13) for joint in _SHOULDERS["left"]},
        # It takes the order of the actuators (y, z, x) for that of the positions (z, y, x).
        labels={"abdomen_z": "abdomen_y", "abdomen_y": "abdomen_z"},
    ),
    "swimmer": Graph(
        splits={"2x1": (("motor1_rot",), ("motor2_rot",))},
        edges=(("motor1_rot", "motor2_rot"),),
        root_velocity={"motor1_rot": 0, "motor2_rot": 1},
    ),
}
