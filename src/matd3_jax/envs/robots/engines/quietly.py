"""MJX, imported without its printed remarks about optional packages that are not there."""

from matd3_jax.envs.robots.quiet import quiet

with quiet():
    from mujoco import mjx
    from mujoco.mjx._src import collision_driver, collision_primitive, forward

__all__ = ["collision_driver", "collision_primitive", "forward", "mjx"]
