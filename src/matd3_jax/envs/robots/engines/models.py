"""MuJoCo models of gymnasium's robots, with the physics that Ant-v2 and its like had."""

import importlib.util
from pathlib import Path
from typing import Any

import mujoco

from matd3_jax.envs.robots.quiet import quiet, quiet_mujoco
from matd3_jax.errors import OptionError

CONTACT_POINTS = 8
"""Contacts that MJX keeps of each kind, the deepest first. Robots touch the floor in fewer points at a time, so nothing
is lost; MJX would otherwise solve for every point that could ever touch (the ant: 25, in three times the time). C
MuJoCo has no such bound."""


def corrected(file: str) -> mujoco.MjModel:
    """gymnasium's model with contact margins as they were before MuJoCo 3.5.0, and `CONTACT_POINTS` for MJX."""
    with quiet(), quiet_mujoco():
        return _corrected(mujoco.MjSpec.from_file(str(assets() / file)), file)


def _corrected(spec: mujoco.MjSpec, file: str) -> mujoco.MjModel:
    # MJX reads its settings from the wrong place where a model has other numbers before them; nothing needs these.
    for other in list(spec.numerics):
        spec.delete(other)
    points: Any = spec.add_numeric()
    points.name, points.data = "max_contact_points", [CONTACT_POINTS]
    model = spec.compile()
    # Since 3.5.0 a contact's margin is the sum of the two geoms', before it was the larger one. All published returns
    # rest on the latter; all geoms of a model have the same.
    assert len(set(model.geom_margin)) == 1, file
    model.geom_margin /= 2
    return model


def assets() -> Path:
    """gymnasium's folder of model files. Raises OptionError without gymnasium."""
    spec = importlib.util.find_spec("gymnasium")
    if spec is None or spec.origin is None:
        raise OptionError("robots need gymnasium's model files: pip install gymnasium")
    return Path(spec.origin).parent / "envs" / "mujoco" / "assets"
