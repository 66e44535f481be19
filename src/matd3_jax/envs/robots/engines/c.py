"""Robots stepped by C MuJoCo on the host, as a callback of the compiled program.

The state stays the program's own: each call sets positions, velocities and the solver's start, steps, and reads. What
the C program keeps besides cannot change the next step, so equal inputs give equal outputs, in any order of calls and
on any thread: a run is the same to the bit however its seeds are spread, and after a resume.
"""

import dataclasses
import functools
import itertools
import os
import queue
from collections.abc import Callable, Sequence

import chex
import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from matd3_jax.envs.environment import LIMIT
from matd3_jax.envs.robots.engines.engine import Physical
from matd3_jax.envs.robots.engines.models import corrected
from matd3_jax.envs.robots.quiet import quiet_mujoco

STATE = int(mujoco.mjtState.mjSTATE_QPOS | mujoco.mjtState.mjSTATE_QVEL | mujoco.mjtState.mjSTATE_WARMSTART)
CONTROL = int(mujoco.mjtState.mjSTATE_CTRL)


@dataclasses.dataclass(frozen=True, eq=False)
class CEngine:
    """One robot's model in C MuJoCo; see `engine.Engine`.

    Simulators are made beforehand, two for each core: a call takes one, so that calls of several devices and programs
    can run at the same time.
    """

    mj_model: mujoco.MjModel
    simulators: "queue.SimpleQueue[mujoco.MjData]"

    def advance(
        self,
        qpos: chex.Array,
        qvel: chex.Array,
        qacc_warmstart: chex.Array,
        control: chex.Array,
        frame_skip: int,
        fields: tuple[str, ...],
    ) -> Physical:
        def step(model: mujoco.MjModel, data: mujoco.MjData) -> None:
            mujoco.mj_step(model, data, frame_skip)
            if "cfrc_ext" in fields:
                mujoco.mj_rnePostConstraint(model, data)

        return self._call(step, (qpos, qvel, qacc_warmstart, control), STATE | CONTROL, fields)

    def place(self, qpos: chex.Array, qvel: chex.Array, fields: tuple[str, ...]) -> Physical:
        def set_state(model: mujoco.MjModel, data: mujoco.MjData) -> None:
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mj_comVel(model, data)

        found = self._call(set_state, (qpos, qvel, jnp.zeros_like(qvel)), STATE, fields)
        forces = {name: jnp.zeros_like(found.fields[name]) for name in ("qfrc_actuator", "cfrc_ext") if name in fields}
        return found._replace(fields=found.fields | forces)

    def _call(self, run: Callable, inputs: Sequence[chex.Array], signature: int, fields: tuple[str, ...]) -> Physical:
        """`run`(model, data) for each robot of a batch, as one callback.

        Args:
            inputs: what is set before, in the order of MuJoCo's bits in `signature`.
        """
        model, state_size = self.mj_model, self.mj_model.nq + 2 * self.mj_model.nv
        shapes = {name: getattr(self._sample, name).shape for name in fields}
        ends = [int(end) for end in np.cumsum([state_size, *(np.prod(shape) for shape in shapes.values())])]
        columns = [slice(start, end) for start, end in itertools.pairwise(ends)]

        def callback(joined: np.ndarray) -> np.ndarray:
            rows = np.asarray(joined, np.float64).reshape(-1, joined.shape[-1])  # NumPy only: jax#24255
            found = np.full((len(rows), ends[-1]), np.nan)
            # MuJoCo must not step what is not finite. Accelerations may be large: impacts have them.
            moderate = (np.abs(rows[:, : model.nq + model.nv]) < LIMIT).all(axis=1)
            sound = moderate & np.isfinite(rows).all(axis=1)
            data = self.simulators.get()
            try:
                outputs = [(c, getattr(data, name).reshape(-1)) for c, name in zip(columns, fields, strict=True)]
                with quiet_mujoco():  # of robots that blow up, which `Robot.step` ends
                    for row in np.flatnonzero(sound):
                        mujoco.mj_setState(model, data, rows[row], signature)
                        run(model, data)
                        mujoco.mj_getState(model, data, found[row, :state_size], STATE)
                        for column, output in outputs:
                            found[row, column] = output
            finally:
                self.simulators.put(data)
            with np.errstate(over="ignore"):
                return found.astype(np.float32).reshape(*joined.shape[:-1], ends[-1])

        # One array in and one out: every array by itself costs as much as the call.
        shape = jax.ShapeDtypeStruct((ends[-1],), jnp.float32)
        joined = jnp.concatenate([jnp.asarray(x, jnp.float32) for x in inputs])
        state, *rest = jnp.split(jax.pure_callback(callback, shape, joined, vmap_method="broadcast_all"), ends[:-1])
        qpos, qvel, warmstart = jnp.split(state, np.cumsum([model.nq, model.nv]))
        parts = {name: part.reshape(shapes[name]) for name, part in zip(fields, rest, strict=True)}
        return Physical(qpos, qvel, warmstart, parts)

    @functools.cached_property
    def _sample(self) -> mujoco.MjData:
        return mujoco.MjData(self.mj_model)


@functools.cache
def load(file: str) -> CEngine:
    """C MuJoCo with one of gymnasium's model files ("ant.xml"): its own integrator, solver and iterations; contact
    margins as MuJoCo had them before 3.5.0."""
    model = corrected(file)
    # A state that blows up shall show, not turn into the model's initial one.
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    simulators: queue.SimpleQueue[mujoco.MjData] = queue.SimpleQueue()
    # Made here, not in the callback, where making MuJoCo's data ended the process (mujoco 3.17.0, jax 0.10.2).
    for _ in range(2 * (os.cpu_count() or 1)):
        simulators.put(mujoco.MjData(model))
    return CEngine(model, simulators)
