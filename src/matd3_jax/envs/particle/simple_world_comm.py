"""simple_world_comm: predators hunt prey that looks for food and hides in forests; their leader sees and tells all."""

import dataclasses

import chex
import jax.numpy as jnp

from matd3_jax.envs.environment import check_count
from matd3_jax.envs.particle.task import ParticleTask
from matd3_jax.envs.particle.world import State, World, distance_of, others, outside, relative

LEADER = 0
PREDATOR_RADIUS, PREY_RADIUS = 0.075, 0.045
OBSTACLE_RADIUS, FOOD_RADIUS, FOREST_RADIUS = 0.2, 0.03, 0.3
CAPTURE, MEAL = 5.0, 2.0
FOOD_SLOPE, CHASE_SLOPE = 0.05, 0.1
"""Reward per unit of distance to the nearest food, and to the nearest prey."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class SimpleWorldComm(ParticleTask):
    """Predators (adversaries, first; the very first is the leader, who also speaks) and prey, all of which collide with
    each other and with obstacles. Food and forests touch nothing. An agent is in each forest that its disc overlaps.

    The leader sees everybody. The others see those in a forest with them and, while in none, those in none; places and
    velocities of all others are zeros to them.

    Observation: own velocity 2, own position 2, landmarks relative to oneself 2 each (obstacles, food, forests), other
    agents likewise; then for predators the velocities of all prey 2 each, 1 or -1 for each forest (in it or not), the
    leader's message 4 (the leader hears itself); for prey 1 or -1 for each forest, the velocities of the other prey.

    Reward: every predator gets 5 for each touching pair of a prey and a predator, minus 0.1 times its distance to the
    nearest prey. A prey loses 5 for each predator touching it and up to 20 for each coordinate of its position beyond
    0.9, and gets 2 for each food it touches, minus 0.05 times its distance to the nearest food ("orig": plus; the
    original rewards prey for being far from food).

    num_good prey, num_adversaries predators, num_obstacles, num_food and num_forests landmarks of each kind.
    """

    num_good: int = 2
    num_adversaries: int = 4
    num_obstacles: int = 1
    num_food: int = 2
    num_forests: int = 2

    def __post_init__(self) -> None:
        super().__post_init__()
        for key in ("num_good", "num_adversaries", "num_food"):
            check_count(key, getattr(self, key), 1)
        for key in ("num_obstacles", "num_forests"):
            check_count(key, getattr(self, key), 0)

    @property
    def agents(self) -> tuple[str, ...]:
        return (
            "leadadversary_0",
            *(f"adversary_{i}" for i in range(self.num_adversaries - 1)),
            *(f"agent_{i}" for i in range(self.num_good)),
        )

    @property
    def teams(self) -> tuple[str, ...]:
        return ("adversaries",) * self.num_adversaries + ("agents",) * self.num_good

    @property
    def observation_sizes(self) -> tuple[int, ...]:
        landmarks = self.num_obstacles + self.num_food + self.num_forests
        common = 4 + 2 * landmarks + 2 * (len(self.agents) - 1) + self.num_forests
        predator, prey = common + 2 * self.num_good + self.dim_c, common + 2 * (self.num_good - 1)
        return (predator,) * self.num_adversaries + (prey,) * self.num_good

    @property
    def dim_c(self) -> int:
        return 4

    @property
    def speaks(self) -> tuple[bool, ...]:
        return tuple(i == LEADER for i in range(len(self.agents)))

    @property
    def landmark_range(self) -> float:
        return 0.9

    @property
    def landmark_kinds(self) -> tuple[str, ...]:
        return ("obstacle",) * self.num_obstacles + ("food",) * self.num_food + ("forest",) * self.num_forests

    @property
    def world(self) -> World:
        num_predators, num_prey = self.num_adversaries, self.num_good
        radius = {"obstacle": OBSTACLE_RADIUS, "food": FOOD_RADIUS, "forest": FOREST_RADIUS}
        return World(
            radius=(PREDATOR_RADIUS,) * num_predators + (PREY_RADIUS,) * num_prey,
            landmark_radius=tuple(radius[kind] for kind in self.landmark_kinds),
            movable=(True,) * len(self.agents),
            collide=(True,) * len(self.agents),
            landmark_collide=tuple(kind == "obstacle" for kind in self.landmark_kinds),
            gain=(3.0,) * num_predators + (4.0,) * num_prey,
            max_speed=(1.0,) * num_predators + (1.3,) * num_prey,
        )

    def observe(self, state: State) -> tuple[chex.Array, ...]:
        assert state.comm is not None
        n, num_predators, num_prey = len(self.agents), self.num_adversaries, self.num_good
        inside = self._inside(state)
        sees = _sees(inside)[..., None]
        common = jnp.concatenate(
            [
                state.vel,
                state.pos,
                relative(state.pos, state.landmark).reshape(n, -1),
                others(jnp.where(sees, relative(state.pos, state.pos), 0)).reshape(n, -1),
            ],
            axis=1,
        )
        prey_vel = jnp.where(sees[:, num_predators:], state.vel[num_predators:], 0)
        in_forest = jnp.where(inside, 1, -1).astype(state.pos.dtype)
        predators = jnp.concatenate(
            [
                common[:num_predators],
                prey_vel[:num_predators].reshape(num_predators, -1),
                in_forest[:num_predators],
                jnp.broadcast_to(state.comm[LEADER], (num_predators, self.dim_c)),
            ],
            axis=1,
        )
        other_prey = others(prey_vel[num_predators:]).reshape(num_prey, -1)
        prey = jnp.concatenate([common[num_predators:], in_forest[num_predators:], other_prey], axis=1)
        return *predators, *prey

    def reward(self, state: State) -> chex.Array:
        predators, prey = state.pos[: self.num_adversaries], state.pos[self.num_adversaries :]
        food = state.landmark[self.num_obstacles : self.num_obstacles + self.num_food]
        to_predator, to_food = (distance_of(relative(prey, target)) for target in (predators, food))
        touching = (to_predator < PREDATOR_RADIUS + PREY_RADIUS).astype(prey.dtype)
        meals = MEAL * jnp.sum((to_food < PREY_RADIUS + FOOD_RADIUS).astype(prey.dtype), axis=1)
        away = FOOD_SLOPE * jnp.min(to_food, axis=1)
        eating = meals + (away if self.rules == "orig" else -away)
        hunting = CAPTURE * jnp.sum(touching) - CHASE_SLOPE * jnp.min(to_predator, axis=0)
        return jnp.concatenate([hunting, eating - CAPTURE * jnp.sum(touching, axis=1) - 2 * outside(prey)])

    def _inside(self, state: State) -> chex.Array:
        """[n, num_forests] who is in which forest."""
        forests = state.landmark[self.num_obstacles + self.num_food :]
        reach = jnp.asarray(self.world.radius, state.pos.dtype)[:, None] + FOREST_RADIUS
        return distance_of(relative(state.pos, forests)) < reach


def _sees(inside: chex.Array) -> chex.Array:
    """[n, n] whom each agent sees, from `inside` [n, num_forests]."""
    together = jnp.any(inside[:, None] & inside[None], axis=-1)
    outdoors = ~jnp.any(inside, axis=-1)
    leads = jnp.arange(len(inside))[:, None] == LEADER
    return together | (outdoors[:, None] & outdoors[None]) | leads
