"""MJX, imported without its printed remarks about optional packages that are not there."""

from matd3_jax.envs.robots.quiet import quiet

with quiet():
    from mujoco import mjx

__all__ = ["mjx"]
