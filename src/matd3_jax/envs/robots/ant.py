"""The Ant of Ant-v2: four legs of two joints each, eight motors."""

import dataclasses

import chex
import jax
import jax.numpy as jnp

from matd3_jax.envs.robots.engines.engine import Physical
from matd3_jax.envs.robots.partition.partition import Layout, Split, lay_out
from matd3_jax.envs.robots.robot import Robot, uniform


@dataclasses.dataclass(frozen=True, kw_only=True)
class Ant(Robot):
    """Ant-v2 (Brockman et al. 2016; Schulman et al. 2016) of gymnasium's model file; 0.05 s an env step.

    Full observation [111]: qpos[2:] (13), qvel (14), the external torque and force on each of 14 bodies about the
    robot's center of mass, clipped to [-1, 1] (84; the first six, the world's, are always 0; all are 0 after a reset).

    Reward: speed of the torso along x (m/s) + 1 - 0.5 |a|^2 - 0.0005 |clipped forces|^2; the 1 also on the step that
    terminates. Terminated: torso below 0.2 m or above 1 m. Reset: uniform noise of 0.1 on positions, normal noise of
    0.1 on velocities.

    `split`: "halves" (the paper's two agents, left and right legs), "2x4", "2x4d", "4x2", "single", or joint names.
    """

    split: Split = "halves"

    robot = "ant"
    file = "ant.xml"
    frame_skip = 5
    reads = ("xpos", "cfrc_ext")

    @property
    def layout(self) -> Layout:
        return lay_out(15, 14, hidden=2, cfrc_ext=range(14), velocities=self.velocities)

    def noise(self, key: chex.PRNGKey) -> tuple[chex.Array, chex.Array]:
        qpos_key, qvel_key = jax.random.split(key)
        return uniform(qpos_key, 15, 0.1), 0.1 * jax.random.normal(qvel_key, (14,))

    def healthy(self, qpos: chex.Array, qvel: chex.Array) -> chex.Array:
        return (qpos[2] >= 0.2) & (qpos[2] <= 1.0)

    def rewards(self, speed: chex.Array, control: chex.Array, sensed: tuple, healthy: chex.Array) -> tuple:
        (forces,) = sensed
        return speed, jnp.ones(()), -0.5 * jnp.sum(control**2), -5e-4 * jnp.sum(forces**2)

    def sense(self, physical: Physical) -> tuple[chex.Array, ...]:
        return (jnp.clip(physical.fields["cfrc_ext"], -1, 1),)

    def start(self, qpos: chex.Array, qvel: chex.Array) -> tuple[tuple[chex.Array, ...], chex.Array]:
        return (jnp.zeros((14, 6), qpos.dtype),), qpos[0]

    def progress(self, physical: Physical) -> chex.Array:
        return physical.fields["xpos"][1, 0]  # the torso's, of the integrator's last stage: what gymnasium reads
