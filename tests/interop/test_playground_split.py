"""Who gets which actuators, by their names; the names are those of Playground's robots."""

import pytest

from matd3_jax.errors import OptionError
from matd3_jax.interop.playground_split import as_split, share_out

CHEETAH = ("bthigh", "bshin", "bfoot", "fthigh", "fshin", "ffoot")
GO1 = tuple(f"{leg}_{part}" for leg in ("FR", "FL", "RR", "RL") for part in ("hip", "thigh", "calf"))
SPOT = tuple(f"{leg}_{part}" for leg in ("fl", "fr", "hl", "hr") for part in ("hx", "hy", "kn"))
G1 = ("left_hip_pitch_joint", "left_knee_joint", "right_hip_pitch_joint", "waist_yaw_joint", "right_elbow_joint")
OP3 = ("head_pan_act", "l_sho_pitch_act", "r_sho_pitch_act", "l_hip_yaw_act", "r_hip_yaw_act")
T1 = ("AAHead_yaw", "Left_Shoulder_Pitch", "Right_Shoulder_Pitch", "Waist", "Left_Hip_Pitch", "Right_Hip_Pitch")
BARKOUR = tuple(
    f"{part}_{leg}"
    for leg in ("front_left", "hind_left", "front_right", "hind_right")
    for part in ("abduction", "hip", "knee")
)
BERKELEY = ("LL_HR", "LL_HAA", "LR_HR", "LR_HAA")


@pytest.mark.parametrize(
    ("actuators", "split", "expected"),
    [
        (CHEETAH, "single", ((0, 1, 2, 3, 4, 5),)),
        (CHEETAH, "halves", ((0, 1, 2), (3, 4, 5))),
        (CHEETAH, "3x2", ((0, 1), (2, 3), (4, 5))),
        (CHEETAH, "1x6", ((0, 1, 2, 3, 4, 5),)),
        (CHEETAH, (("ffoot", "bthigh"), ("bshin", "bfoot", "fthigh", "fshin")), ((5, 0), (1, 2, 3, 4))),
        (GO1, "legs", ((0, 1, 2), (3, 4, 5), (6, 7, 8), (9, 10, 11))),
        (GO1, "halves", ((0, 1, 2, 6, 7, 8), (3, 4, 5, 9, 10, 11))),
        (SPOT, "legs", ((0, 1, 2), (3, 4, 5), (6, 7, 8), (9, 10, 11))),
        (SPOT, "halves", ((0, 1, 2, 6, 7, 8), (3, 4, 5, 9, 10, 11))),
        (BARKOUR, "legs", ((0, 1, 2), (3, 4, 5), (6, 7, 8), (9, 10, 11))),
        (BARKOUR, "halves", ((0, 1, 2, 3, 4, 5), (6, 7, 8, 9, 10, 11))),
        (G1, "halves", ((0, 1, 3), (2, 4))),
        (OP3, "halves", ((0, 1, 3), (2, 4))),
        (T1, "halves", ((0, 1, 3, 4), (2, 5))),
        (BERKELEY, "halves", ((0, 1), (2, 3))),
    ],
)
def test_shares(actuators, split, expected):
    assert share_out(actuators, split) == expected


@pytest.mark.parametrize(
    ("actuators", "split", "words"),
    [
        (CHEETAH, "4x2", "the robot has 6 actuators; possible: 1x6, 2x3, 3x2, 6x1"),
        (CHEETAH, "0x6", "possible"),
        (CHEETAH, "thirds", "must be single, halves, legs, NxM"),
        (CHEETAH, "legs", "the actuator 'bthigh' is named for no leg"),
        (("slide",), "halves", "one actuator, 'slide'; take split=single"),
        (CHEETAH, (("bthigh", "bshim"),), "no actuator 'bshim'; did you mean 'bshin'"),
        (CHEETAH, (CHEETAH, ("bshin",)), "'bshin' is named twice"),
        (CHEETAH, (CHEETAH[:5],), "no agent has 'ffoot'"),
        (CHEETAH, (CHEETAH, ()), "an agent has no actuators"),
    ],
)
def test_what_is_refused(actuators, split, words):
    with pytest.raises(OptionError, match=words):
        share_out(actuators, split)


def test_splits_can_be_hashed():
    assert as_split([["a", "b"], ["c"]]) == (("a", "b"), ("c",)) and as_split("2x3") == "2x3"
    for wrong in (3, ["a", "b"], None):
        with pytest.raises(OptionError, match="must be single"):
            as_split(wrong)
