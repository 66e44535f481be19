"""simple_reference: each agent knows only where the other one should go, and both walk and speak."""

import dataclasses

import chex
import jax.numpy as jnp

from matd3_jax.envs.particle.task import ParticleTask, check_local_ratio
from matd3_jax.envs.particle.world import State, World, choose, distance_of, one_hot, relative

NUM_LANDMARKS = 3


@dataclasses.dataclass(frozen=True, kw_only=True)
class SimpleReference(ParticleTask):
    """Two agents that move and speak, three landmarks; `State.goal[i]` is the landmark to which the agent that is not i
    should go. Both goals may be the same landmark.

    Observation [21]: own velocity 2, landmarks relative to oneself 6, color of the other's goal 3 (0.25, and 0.75 at
    the goal's index), the other's message 10.

    Reward, with d_i the distance of the agent that is not i to goal[i]: "orig" gives both -(d_0^2 + d_1^2); "mpe2"
    gives agent i -(1 - local_ratio) * (d_0 + d_1) / 2 - local_ratio * d_i.

    local_ratio: None stands for 0.5 under "mpe2"; must be None under "orig".
    """

    local_ratio: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        check_local_ratio(self.local_ratio, self.rules)

    @property
    def agents(self) -> tuple[str, ...]:
        return ("agent_0", "agent_1")

    @property
    def observation_sizes(self) -> tuple[int, ...]:
        return (2 + 2 * NUM_LANDMARKS + 3 + self.dim_c,) * 2

    @property
    def dim_c(self) -> int:
        return 10

    @property
    def speaks(self) -> tuple[bool, ...]:
        return (True, True)

    @property
    def num_goals(self) -> int:
        return NUM_LANDMARKS

    @property
    def goal_shape(self) -> tuple[int, ...]:
        return (2,)

    @property
    def world(self) -> World:
        return World.uniform(2, NUM_LANDMARKS, 0.05, 0.05)

    def observe(self, state: State) -> tuple[chex.Array, ...]:
        assert state.comm is not None and state.goal is not None
        parts = [
            state.vel,
            relative(state.pos, state.landmark).reshape(2, -1),
            0.25 + 0.5 * one_hot(state.goal, NUM_LANDMARKS, state.pos.dtype),
            state.comm[::-1],
        ]
        return tuple(jnp.concatenate(parts, axis=1))

    def reward(self, state: State) -> chex.Array:
        assert state.goal is not None
        delta = state.pos[::-1] - choose(state.goal, state.landmark)
        if self.rules == "orig":
            return jnp.full(2, -jnp.sum(delta**2))
        distance = distance_of(delta)
        ratio = 0.5 if self.local_ratio is None else self.local_ratio
        return -(1 - ratio) * jnp.mean(distance) - ratio * distance
