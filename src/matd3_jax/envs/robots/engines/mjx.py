"""Robots stepped by MJX: the physics as part of the compiled program, on any device."""

import dataclasses
import functools

import chex
import jax
import mujoco

from matd3_jax.envs.robots.engines import runge_kutta
from matd3_jax.envs.robots.engines.contact_frame import as_in_c
from matd3_jax.envs.robots.engines.engine import Physical
from matd3_jax.envs.robots.engines.models import corrected
from matd3_jax.envs.robots.engines.quietly import mjx
from matd3_jax.private import mjx_implementation
from matd3_jax.thread_pool import make_room_for_lapack

NEWTON = {"mjx": (8, 8), "mjx_fast": (1, 4)}
"""Iterations of the Newton solver and of its line search. In float32, 8 and 8 give what MuJoCo's default of 100 and 50
gives."""


@dataclasses.dataclass(frozen=True, eq=False)
class MjxEngine:
    """One robot's model, in MuJoCo and in MJX; see `engine.Engine`."""

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
        fields: tuple[str, ...],
    ) -> Physical:
        data = self.data.replace(qpos=qpos, qvel=qvel, qacc_warmstart=qacc_warmstart, ctrl=control)
        rk4 = self.mj_model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4
        step = runge_kutta.step if rk4 else mjx.step
        # TF32 products, which GPUs take for float32 by default, wreck the physics.
        with as_in_c(), jax.default_matmul_precision("highest"):
            data = jax.lax.scan(lambda d, _: (step(self.model, d), None), data, length=frame_skip)[0]
            if "cfrc_ext" in fields:  # MJX leaves it at 0 otherwise
                data = mjx.rne_postconstraint(self.model, data)
        return _physical(data, fields)

    def place(self, qpos: chex.Array, qvel: chex.Array, fields: tuple[str, ...]) -> Physical:
        data = self.data.replace(qpos=qpos, qvel=qvel)
        with jax.default_matmul_precision("highest"):
            data = mjx.com_vel(self.model, mjx.com_pos(self.model, mjx.kinematics(self.model, data)))
        return _physical(data, fields)


def _physical(data: mjx.Data, fields: tuple[str, ...]) -> Physical:
    own = {field.name for field in dataclasses.fields(data)}
    found = {name: getattr(data if name in own else mjx_implementation(data), name) for name in fields}
    return Physical(data.qpos, data.qvel, data.qacc_warmstart, found)


@functools.cache
def load(file: str, physics: str) -> MjxEngine:
    """MJX with one of gymnasium's model files ("ant.xml").

    physics "mjx": the model's own integrator; within float32's rounding of C MuJoCo. "mjx_fast": semi-implicit Euler
    without implicit damping and one Newton iteration, brax's settings for MJX. Both: contact margins as MuJoCo had them
    before 3.5.0 and C's contact frames.
    """
    make_room_for_lapack(f"physics={physics}")
    model = corrected(file)
    model.opt.solver = mujoco.mjtSolver.mjSOL_NEWTON
    model.opt.iterations, model.opt.ls_iterations = NEWTON[physics]
    if physics == "mjx_fast":
        model.opt.integrator = mujoco.mjtIntegrator.mjINT_EULER
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_EULERDAMP
    # The first use may be inside a traced function; the model is to be made of arrays all the same.
    with jax.ensure_compile_time_eval():
        return MjxEngine(model, mjx.put_model(model, impl="jax"), mjx.make_data(model, impl="jax"))
