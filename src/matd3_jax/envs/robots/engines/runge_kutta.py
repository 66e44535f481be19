"""MuJoCo's fourth-order Runge-Kutta integrator with its four stages as one loop."""

import chex
import jax
import jax.numpy as jnp

from matd3_jax.envs.robots.engines.quietly import mjx
from matd3_jax.private import mjx_integrate_positions


def step(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """`mjx.step` for the integrator RK4 and models without activations.

    The same numbers up to rounding (stage 1 normalizes the quaternion once more). MJX writes the dynamics out four
    times, once for every stage; one loop body compiles in less than two thirds of the time. As in MuJoCo, all but
    `qpos` and `qvel` is left as the last stage computed it.
    """
    dt = model.opt.timestep
    start, move = data, mjx_integrate_positions()

    def integrate(qvel: chex.Array) -> chex.Array:
        return move(model.jnt_type, start.qpos, qvel, dt)

    def stage(carry, factors):
        data, qvel_sum, qacc_sum = carry
        shift, weight = factors
        # The state of this stage: from the start, along the slope that the stage before found.
        data = data.replace(qpos=integrate(shift * data.qvel), qvel=start.qvel + shift * dt * data.qacc)
        data = mjx.forward(model, data)
        return (data, qvel_sum + weight * data.qvel, qacc_sum + weight * data.qacc), None

    shifts, weights = jnp.array([0, 0.5, 0.5, 1]), jnp.array([1, 2, 2, 1]) / 6
    sums = jnp.zeros_like(data.qvel), jnp.zeros_like(data.qacc)
    (data, qvel_sum, qacc_sum), _ = jax.lax.scan(stage, (data, *sums), (shifts, weights))
    return data.replace(
        qpos=integrate(qvel_sum), qvel=start.qvel + dt * qacc_sum, qacc_warmstart=data.qacc, time=start.time + dt
    )
