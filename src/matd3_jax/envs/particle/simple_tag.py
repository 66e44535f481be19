"""simple_tag (Predator-Prey): slow predators hunt fast prey among obstacles."""

import dataclasses

import chex
import jax.numpy as jnp

from matd3_jax.envs.environment import check_count
from matd3_jax.envs.particle.task import ParticleTask
from matd3_jax.envs.particle.world import State, World, distance_of, others, outside, relative

PREDATOR_RADIUS, PREY_RADIUS, OBSTACLE_RADIUS = 0.075, 0.05, 0.2
CAPTURE = 10.0


@dataclasses.dataclass(frozen=True, kw_only=True)
class SimpleTag(ParticleTask):
    """Predators (adversaries, first) and prey among obstacles; everything collides.

    Observation: own velocity 2, own position 2, obstacles relative to oneself 2 each, other agents likewise, then the
    velocities of the other agents that are prey.

    Reward: every predator gets 10 for each touching pair of a prey and a predator. A prey loses 10 for each predator
    touching it, and up to 10 for each coordinate of its position beyond 0.9. Same in both rules.

    num_good prey, num_adversaries predators, num_obstacles landmarks.
    """

    num_good: int = 1
    num_adversaries: int = 3
    num_obstacles: int = 2

    def __post_init__(self) -> None:
        super().__post_init__()
        check_count("num_good", self.num_good, 1)
        check_count("num_adversaries", self.num_adversaries, 1)
        check_count("num_obstacles", self.num_obstacles, 0)

    @property
    def agents(self) -> tuple[str, ...]:
        return (
            *(f"adversary_{i}" for i in range(self.num_adversaries)),
            *(f"agent_{i}" for i in range(self.num_good)),
        )

    @property
    def teams(self) -> tuple[str, ...]:
        return ("adversaries",) * self.num_adversaries + ("agents",) * self.num_good

    @property
    def observation_sizes(self) -> tuple[int, ...]:
        prey = 4 + 2 * self.num_obstacles + 2 * (len(self.agents) - 1) + 2 * (self.num_good - 1)
        return (prey + 2,) * self.num_adversaries + (prey,) * self.num_good

    @property
    def landmark_range(self) -> float:
        return 0.9

    @property
    def world(self) -> World:
        num_predators, num_prey = self.num_adversaries, self.num_good
        return World(
            radius=(PREDATOR_RADIUS,) * num_predators + (PREY_RADIUS,) * num_prey,
            landmark_radius=(OBSTACLE_RADIUS,) * self.num_obstacles,
            movable=(True,) * len(self.agents),
            collide=(True,) * len(self.agents),
            landmark_collide=(True,) * self.num_obstacles,
            gain=(3.0,) * num_predators + (4.0,) * num_prey,
            max_speed=(1.0,) * num_predators + (1.3,) * num_prey,
        )

    def observe(self, state: State) -> tuple[chex.Array, ...]:
        n, num_predators, num_prey = len(self.agents), self.num_adversaries, self.num_good
        common = jnp.concatenate(
            [
                state.vel,
                state.pos,
                relative(state.pos, state.landmark).reshape(n, -1),
                others(relative(state.pos, state.pos)).reshape(n, -1),
            ],
            axis=1,
        )
        prey_vel = state.vel[num_predators:]
        seen = jnp.broadcast_to(prey_vel.reshape(1, -1), (num_predators, 2 * num_prey))
        predators = jnp.concatenate([common[:num_predators], seen], axis=1)
        other_prey = others(jnp.broadcast_to(prey_vel, (num_prey, num_prey, 2))).reshape(num_prey, -1)
        prey = jnp.concatenate([common[num_predators:], other_prey], axis=1)
        return *predators, *prey

    def reward(self, state: State) -> chex.Array:
        predators, prey = state.pos[: self.num_adversaries], state.pos[self.num_adversaries :]
        touching = distance_of(relative(prey, predators)) < PREDATOR_RADIUS + PREY_RADIUS
        captures = CAPTURE * jnp.sum(touching.astype(prey.dtype), axis=1)
        shared = jnp.full(self.num_adversaries, jnp.sum(captures))
        return jnp.concatenate([shared, -captures - outside(prey)])
