"""simple_speaker_listener (Cooperative Communication): one knows the goal, the other can walk there."""

import dataclasses

import chex
import jax.numpy as jnp

from matd3_jax.envs.particle.task import ParticleTask
from matd3_jax.envs.particle.world import State, World, choose, one_hot

NUM_LANDMARKS = 3


@dataclasses.dataclass(frozen=True, kw_only=True)
class SimpleSpeakerListener(ParticleTask):
    """An immovable speaker, a silent listener, three landmarks, one of them the goal.

    Observation of the speaker [3]: color of the goal, 0.15 and 0.65 at the goal's index. Of the listener [11]: own
    velocity 2, landmarks relative to oneself 6, the speaker's message 3.

    Reward of both: minus the squared distance of listener and goal; twice that under "orig", which adds both rewards.
    """

    @property
    def agents(self) -> tuple[str, ...]:
        return ("speaker_0", "listener_0")

    @property
    def observation_sizes(self) -> tuple[int, ...]:
        return (3, 2 + 2 * NUM_LANDMARKS + self.dim_c)

    @property
    def dim_c(self) -> int:
        return 3

    @property
    def num_goals(self) -> int:
        return NUM_LANDMARKS

    @property
    def world(self) -> World:
        return dataclasses.replace(World.uniform(2, NUM_LANDMARKS, 0.075, 0.04), movable=(False, True))

    def observe(self, state: State) -> tuple[chex.Array, ...]:
        assert state.comm is not None and state.goal is not None
        color = 0.15 + 0.5 * one_hot(state.goal, NUM_LANDMARKS, state.pos.dtype)
        return color, jnp.concatenate([state.vel[1], (state.landmark - state.pos[1]).reshape(-1), state.comm[0]])

    def reward(self, state: State) -> chex.Array:
        assert state.goal is not None
        square = jnp.sum((choose(state.goal, state.landmark) - state.pos[1]) ** 2)
        return jnp.full(2, -2 * square if self.rules == "orig" else -square)
