"""Robots that move in a plane, of gymnasium's version 5: half-cheetah, hopper, walker2d and swimmer.

What reads the same for all: observations are positions without those along the ground, then velocities; the reward is
the speed along x (m/s), plus 1 while healthy where there is such a thing, minus a cost of |a|^2.
"""

import dataclasses
from typing import ClassVar

import chex
import jax
import jax.numpy as jnp

from matd3_jax.envs.robots.partition.partition import Layout, Split, lay_out
from matd3_jax.envs.robots.robot import Robot, RobotState, uniform


class Planar(Robot):
    """Speed along x, minus a cost of the controls; observes positions and velocities."""

    hidden: ClassVar[int] = 1
    """Positions that are not observed: along the ground."""
    ctrl_cost: ClassVar[float]
    health_reward: ClassVar[float] = 0.0
    reset_noise: ClassVar[float]
    """Bound of the uniform noise on positions and velocities."""

    @property
    def layout(self) -> Layout:
        return lay_out(self.mj_model.nq, self.mj_model.nv, hidden=self.hidden, velocities=self.velocities)

    def noise(self, key: chex.PRNGKey) -> tuple[chex.Array, chex.Array]:
        qpos_key, qvel_key = jax.random.split(key)
        return (
            uniform(qpos_key, self.mj_model.nq, self.reset_noise),
            uniform(qvel_key, self.mj_model.nv, self.reset_noise),
        )

    def healthy(self, qpos: chex.Array, qvel: chex.Array) -> chex.Array:
        return jnp.ones((), bool)

    def rewards(self, speed: chex.Array, control: chex.Array, sensed: tuple, healthy: chex.Array) -> tuple:
        return speed, self.health_reward * healthy, -self.ctrl_cost * jnp.sum(control**2), jnp.zeros(())


class ClippedVelocities(Planar):
    """Observes velocities clipped to [-10, 10]."""

    def raw_observation(self, state: RobotState) -> chex.Array:
        return super().raw_observation(state._replace(qvel=jnp.clip(state.qvel, -10, 10)))


@dataclasses.dataclass(frozen=True, kw_only=True)
class HalfCheetah(Planar):
    """HalfCheetah-v5 (Wawrzyński 2009): two legs of three joints in a plane; 0.05 s an env step.

    Full observation [17]: qpos[1:] (8), qvel (9). Reward: speed of the root along x - 0.1 |a|^2. Never terminates.
    Reset: uniform noise of 0.1 on positions, normal noise of 0.1 on velocities. `split`: "2x3", "6x1", "single", names.
    """

    split: Split = "2x3"

    robot = "half_cheetah"
    file = "half_cheetah.xml"
    frame_skip = 5
    ctrl_cost = 0.1
    reset_noise = 0.1

    def noise(self, key: chex.PRNGKey) -> tuple[chex.Array, chex.Array]:
        qpos_key, qvel_key = jax.random.split(key)
        return uniform(qpos_key, 9, self.reset_noise), self.reset_noise * jax.random.normal(qvel_key, (9,))


@dataclasses.dataclass(frozen=True, kw_only=True)
class Hopper(ClippedVelocities):
    """Hopper-v5 (Erez et al. 2011): one leg of three joints in a plane; 0.008 s an env step.

    Full observation [11]: qpos[1:] (5), qvel clipped to [-10, 10] (6). Reward: speed along x + 1 while healthy - 0.001
    |a|^2. Terminated: height at most 0.7 m, |angle| of the torso at least 0.2 rad, or any other position or velocity
    beyond 100. Reset: uniform noise of 0.005. `split`: "3x1", "single", names.
    """

    split: Split = "3x1"

    robot = "hopper"
    file = "hopper.xml"
    frame_skip = 4
    ctrl_cost = 1e-3
    health_reward = 1.0
    reset_noise = 5e-3

    def healthy(self, qpos: chex.Array, qvel: chex.Array) -> chex.Array:
        bounded = (jnp.abs(qpos[2:]) < 100).all() & (jnp.abs(qvel) < 100).all()
        return bounded & (qpos[1] > 0.7) & (jnp.abs(qpos[2]) < 0.2)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Walker2d(ClippedVelocities):
    """Walker2d-v5 (Erez et al. 2011): two legs of three joints in a plane; 0.008 s an env step.

    Full observation [17]: qpos[1:] (8), qvel clipped to [-10, 10] (9). Reward: speed along x + 1 while healthy - 0.001
    |a|^2. Terminated: height outside (0.8, 2) m, or |angle| of the torso at least 1 rad. Reset: uniform noise of 0.005.
    `split`: "2x3", "single", names.
    """

    split: Split = "2x3"

    robot = "walker2d"
    file = "walker2d_v5.xml"
    frame_skip = 4
    ctrl_cost = 1e-3
    health_reward = 1.0
    reset_noise = 5e-3

    def healthy(self, qpos: chex.Array, qvel: chex.Array) -> chex.Array:
        return (qpos[1] > 0.8) & (qpos[1] < 2.0) & (jnp.abs(qpos[2]) < 1.0)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Swimmer(Planar):
    """Swimmer-v5 (Coulom 2002): a chain of three links in a viscous fluid; 0.04 s an env step.

    Full observation [8]: qpos[2:] (3), qvel (5). Reward: speed of the first link along x - 0.0001 |a|^2. Never
    terminates. Reset: uniform noise of 0.1. `split`: "2x1", "single", names.
    """

    split: Split = "2x1"

    robot = "swimmer"
    file = "swimmer.xml"
    frame_skip = 4
    hidden = 2
    ctrl_cost = 1e-4
    reset_noise = 0.1
