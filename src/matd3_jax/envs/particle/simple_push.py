"""simple_push (Keep-away): one knows which landmark is the goal, the other must keep it away from there."""

import dataclasses

import chex
import jax.numpy as jnp

from matd3_jax.envs.particle.task import ParticleTask
from matd3_jax.envs.particle.world import State, World, choose, distance_of, one_hot

ADVERSARY, GOOD = 0, 1
NUM_LANDMARKS = 2
LANDMARK_COLORS = (0.1, 0.9, 0.1, 0.1, 0.1, 0.9)
"""Red, green, blue of each landmark."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class SimplePush(ParticleTask):
    """An adversary, a good agent, two landmarks, one of them the goal.

    Observation of the adversary [8]: own velocity 2, landmarks relative to oneself 4, the good agent likewise 2. Of
    the good agent [19]: own velocity 2, goal relative to oneself 2, own color 3 (it shows the goal), landmarks
    relative to oneself 4, colors of the landmarks 6, the adversary relative to oneself 2.

    Reward: the good agent gets minus its distance to the goal; the adversary gets that distance minus its own. Same
    in both rules.
    """

    @property
    def agents(self) -> tuple[str, ...]:
        return ("adversary_0", "agent_0")

    @property
    def teams(self) -> tuple[str, ...]:
        return ("adversaries", "agents")

    @property
    def observation_sizes(self) -> tuple[int, ...]:
        return (8, 19)

    @property
    def num_goals(self) -> int:
        return NUM_LANDMARKS

    @property
    def world(self) -> World:
        return World.uniform(2, NUM_LANDMARKS, 0.05, 0.05, collide=True)

    def observe(self, state: State) -> tuple[chex.Array, ...]:
        assert state.goal is not None
        dtype = state.pos.dtype
        goal = choose(state.goal, state.landmark) - state.pos[GOOD]
        color = 0.25 + 0.5 * one_hot(state.goal + 1, 3, dtype)
        landmark_colors = jnp.asarray(LANDMARK_COLORS, dtype)
        adversary, good = ((state.landmark - state.pos[i]).reshape(-1) for i in (ADVERSARY, GOOD))
        to_good = state.pos[GOOD] - state.pos[ADVERSARY]
        return (
            jnp.concatenate([state.vel[ADVERSARY], adversary, to_good]),
            jnp.concatenate([state.vel[GOOD], goal, color, good, landmark_colors, -to_good]),
        )

    def reward(self, state: State) -> chex.Array:
        assert state.goal is not None
        distance = distance_of(state.pos - choose(state.goal, state.landmark))
        return jnp.stack([distance[GOOD] - distance[ADVERSARY], -distance[GOOD]])
