"""The Humanoid of gymnasium's version 5: seventeen motors."""

import dataclasses

import chex
import jax
import jax.numpy as jnp

from matd3_jax.envs.robots.engines.engine import Physical
from matd3_jax.envs.robots.partition.partition import Layout, Split, lay_out
from matd3_jax.envs.robots.robot import Robot, uniform


@dataclasses.dataclass(frozen=True, kw_only=True)
class Humanoid(Robot):
    """Humanoid-v5 (Tassa et al. 2012); 0.015 s an env step, controls in [-0.4, 0.4].

    gymnasium's model asks for MuJoCo's PGS solver, which MJX lacks: there Newton's method solves the same problem (see
    docs/environments.md for the difference).

    Full observation [348]: qpos[2:] (22), qvel (23), of 13 bodies inertia about the center of mass (130) and velocity
    (78), force of the actuators on the joints (17), external torque and force on 13 bodies (78; 0 after a reset).

    Reward: 1.25 times the speed of the center of mass along x (m/s) + 5 while healthy - 0.1 |a|^2 - 5e-7 |external
    forces|^2, the last at most 10. Terminated: torso outside (1, 2) m of height. Reset: uniform noise of 0.01 on
    positions and velocities. `split`: "9|8", "single", or joint names.
    """

    split: Split = "9|8"

    robot = "humanoid"
    file = "humanoid.xml"
    frame_skip = 5
    forward_weight = 1.25
    reads = ("cinert", "cvel", "qfrc_actuator", "cfrc_ext", "xipos")

    @property
    def layout(self) -> Layout:
        bodies = range(1, 14)
        return lay_out(
            24,
            23,
            hidden=2,
            cinert=bodies,
            cvel=bodies,
            qfrc_actuator=range(6, 23),
            cfrc_ext=bodies,
            velocities=self.velocities,
        )

    def noise(self, key: chex.PRNGKey) -> tuple[chex.Array, chex.Array]:
        qpos_key, qvel_key = jax.random.split(key)
        return uniform(qpos_key, 24, 0.01), uniform(qvel_key, 23, 0.01)

    def healthy(self, qpos: chex.Array, qvel: chex.Array) -> chex.Array:
        return (qpos[2] > 1.0) & (qpos[2] < 2.0)

    def rewards(self, speed: chex.Array, control: chex.Array, sensed: tuple, healthy: chex.Array) -> tuple:
        *_, forces = sensed
        contact = jnp.minimum(5e-7 * jnp.sum(forces**2), 10)
        return self.forward_weight * speed, 5.0 * healthy, -0.1 * jnp.sum(control**2), -contact

    def sense(self, physical: Physical) -> tuple[chex.Array, ...]:
        found = physical.fields
        bodies = ("cinert", "cvel") if self.velocities else ("cinert",)
        return *(found[name][1:] for name in bodies), found["qfrc_actuator"][6:], found["cfrc_ext"][1:]

    def start(self, qpos: chex.Array, qvel: chex.Array) -> tuple[tuple[chex.Array, ...], chex.Array]:
        physical = self._engine.place(qpos, qvel, self.reads)
        return self.sense(physical), self.progress(physical)

    def progress(self, physical: Physical) -> chex.Array:
        mass = jnp.asarray(self.mj_model.body_mass, jnp.float32)
        return jnp.dot(mass / mass.sum(), physical.fields["xipos"][:, 0], precision="highest")
