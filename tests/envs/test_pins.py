"""MuJoCo and MJX are pinned to 3.17.0 exactly, and why: what the robots would be with a later MuJoCo."""

import copy
import tomllib
from importlib import metadata
from pathlib import Path

import mujoco
import numpy as np
import pytest
from packaging.requirements import Requirement

from matd3_jax.envs import make

ROOT = Path(__file__).parents[2]
DATA = ROOT / "tests" / "data" / "ant"

WHY = (
    "MuJoCo 4.0.0 moves the Ant differently (its RK4, where joints are free): no longer Ant-v2, no published return "
    "compares. mujoco-mjx ends at 3.17.0 and takes any later mujoco, so only exact pins of both keep 4.0.0 out; see "
    "docs/environments.md, Robots"
)


@pytest.mark.parametrize("package", ["mujoco", "mujoco-mjx"])
def test_both_packages_are_pinned_exactly(package):
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    lines = [*project["dependencies"], *sum(project["optional-dependencies"].values(), [])]
    pins = [str(found.specifier) for found in map(Requirement, lines) if found.name == package]
    assert pins == ["==3.17.0"], WHY
    assert metadata.version(package) == "3.17.0", WHY


def errors(margin, action, qpos, qvel):
    """[env steps, 2] largest errors of positions and of velocities in this MuJoCo, of single steps from each recorded
    state. margin: factor of the file's contact margins."""
    model = copy.copy(make("ant", physics="c").mj_model)
    model.geom_margin *= 2 * margin  # halved in ours
    found = []
    for t, control in enumerate(action):
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:], data.ctrl[:] = qpos[t], qvel[t], control
        mujoco.mj_step(model, data, 5)
        found.append((np.abs(data.qpos - qpos[t + 1]).max(), np.abs(data.qvel - qvel[t + 1]).max()))
    return np.array(found)


def test_this_mujoco_moves_the_ant_as_2_3_7_did():
    for file in sorted(DATA.glob("trajectory_*.npz")):
        recording = np.load(file)
        found = errors(0.5, *(recording[key] for key in ("action", "qpos", "qvel")))
        # Measured in float64, the worst step of all: 1.3e-9, 6e-7; medians 2e-16, 2e-15.
        assert (found.max(axis=0) < (1e-8, 5e-6)).all(), f"{file.name}, {found.max(axis=0)}: {WHY}"
        assert (np.median(found, axis=0) < 1e-13).all(), f"{file.name}, {np.median(found, axis=0)}: {WHY}"


@pytest.mark.parametrize("margin", [0.5, 1.0])
def test_this_mujoco_does_not_move_it_as_4_0_0_does(margin):
    """Neither with margins as they were before 3.5.0 nor with 4.0.0's own, the file's."""
    recording = np.load(DATA / "mujoco_4.npz")
    found = errors(margin, *(recording[key] for key in ("action", "qpos", "qvel")))
    # Measured with 4.0.0's margins: positions at least 4e-7 apart, median 5e-6, at most 3e-5; with 2.3.7's up to 2e-2.
    # 2.3.7 itself: the test above.
    assert found[:, 0].min() > 1e-7 and np.median(found[:, 0]) > 1e-6, f"this is MuJoCo 4.0.0's Ant. {WHY}"
