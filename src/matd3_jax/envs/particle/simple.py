"""simple: one agent goes to one landmark. Not a multi-agent task: for trying things out."""

import dataclasses

import chex
import jax.numpy as jnp

from matd3_jax.envs.particle.task import ParticleTask
from matd3_jax.envs.particle.world import State, World


@dataclasses.dataclass(frozen=True, kw_only=True)
class Simple(ParticleTask):
    """One silent agent, one landmark.

    Observation [4]: own velocity 2, the landmark relative to oneself 2. Reward: minus the squared distance of the two.
    Same in both rules.
    """

    @property
    def agents(self) -> tuple[str, ...]:
        return ("agent_0",)

    @property
    def observation_sizes(self) -> tuple[int, ...]:
        return (4,)

    @property
    def world(self) -> World:
        return World.uniform(1, 1, 0.05, 0.05)

    @property
    def landmark_kinds(self) -> tuple[str, ...]:
        return ("goal",)

    def observe(self, state: State) -> tuple[chex.Array, ...]:
        return (jnp.concatenate([state.vel, state.landmark - state.pos], axis=1)[0],)

    def reward(self, state: State) -> chex.Array:
        return -jnp.sum((state.landmark - state.pos) ** 2, axis=1)
