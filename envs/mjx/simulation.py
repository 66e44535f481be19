"""MuJoCo models of gymnasium's robots, corrected and stepped by MJX."""

import dataclasses
import functools
import importlib.util
from pathlib import Path
from typing import Any

import chex
import jax
import mujoco

from ..base import OptionError, check_choice
from ..quiet import quiet, quiet_compiler
from . import runge_kutta
from .contact_frame import as_in_c
from .quietly import mjx

KINDS = ("exact", "fast")

CONTACT_POINTS = 8
"""Contacts kept of each kind, the deepest first. Robots touch the floor in fewer points at a time, so nothing is lost;
MJX would otherwise solve for every point that could ever touch (the ant: 25, in three times the time)."""

NEWTON = {"exact": (8, 8), "fast": (1, 4)}
"""Iterations of the Newton solver and of its line search. In float32, 8 and 8 give what MuJoCo's default of 100 and 50
gives."""


@dataclasses.dataclass(frozen=True, eq=False)
class Physics:
    """One robot's model, in MuJoCo and in MJX."""

    mj_model: mujoco.MjModel
    model: mjx.Model
    data: mjx.Data
    """All zeros, but for what is constant."""

    def advance(
        self,
        qpos: chex.Array,
        qvel: chex.Array,
        qacc_warmstart: chex.Array,
        control: chex.Array,
        frame_skip: int,
        contact_forces: bool,
    ) -> mjx.Data:
        """MJX's data after `frame_skip` simulation steps under constant `control` [nu].

        Args:
            qpos, qvel, qacc_warmstart: [nq], [nv], [nv].
            contact_forces: also compute `cfrc_ext`, of the last step (MJX leaves it at 0 otherwise).
        """
        data = self.data.replace(qpos=qpos, qvel=qvel, qacc_warmstart=qacc_warmstart, ctrl=control)
        rk4 = self.mj_model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4
        step = runge_kutta.step if rk4 else mjx.step
        # TF32 products, which GPUs take for float32 unless told otherwise, wreck the physics.
        with as_in_c(), jax.default_matmul_precision("highest"):
            data = jax.lax.scan(lambda d, _: (step(self.model, d), None), data, length=frame_skip)[0]
            return mjx.rne_postconstraint(self.model, data) if contact_forces else data

    def place(self, qpos: chex.Array, qvel: chex.Array) -> mjx.Data:
        """MJX's data with everything that follows from positions [nq] and velocities [nv] alone, without forces."""
        data = self.data.replace(qpos=qpos, qvel=qvel)
        with jax.default_matmul_precision("highest"):
            data = mjx.com_pos(self.model, mjx.kinematics(self.model, data))
            return mjx.com_vel(self.model, data)


@functools.cache
def load(file: str, kind: str) -> Physics:
    """The physics of one of gymnasium's model files ("ant.xml").

    kind "exact": the model's own integrator; within float32's rounding of C MuJoCo. "fast": semi-implicit Euler without
    implicit damping and one Newton iteration, brax's settings for MJX. Both: contact margins as MuJoCo had them before
    3.5.0 and C's contact frames. Raises OptionError for another kind.
    """
    check_choice("physics", kind, KINDS)
    model = corrected(file)
    model.opt.solver = mujoco.mjtSolver.mjSOL_NEWTON
    model.opt.iterations, model.opt.ls_iterations = NEWTON[kind]
    if kind == "fast":
        model.opt.integrator = mujoco.mjtIntegrator.mjINT_EULER
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_EULERDAMP
    # The first use may be inside a traced function; the model is to be made of arrays all the same.
    with jax.ensure_compile_time_eval():
        return Physics(model, mjx.put_model(model, impl="jax"), mjx.make_data(model, impl="jax"))


def corrected(file: str) -> mujoco.MjModel:
    """gymnasium's model with contact margins as they were before MuJoCo 3.5.0, and `CONTACT_POINTS` for MJX."""
    with quiet(), quiet_compiler():
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
