"""simple_adversary (Physical Deception): cover the goal without showing the adversary which landmark it is."""

import dataclasses

import chex
import jax.numpy as jnp

from matd3_jax.envs.environment import check_count
from matd3_jax.envs.particle.task import ParticleTask
from matd3_jax.envs.particle.world import State, World, choose, distance_of, others, relative


@dataclasses.dataclass(frozen=True, kw_only=True)
class SimpleAdversary(ParticleTask):
    """One adversary, N good agents (`num_good`), N landmarks, one of them the goal; nobody collides.

    Observation of the adversary [4N]: landmarks relative to oneself 2N, other agents likewise 2N. Of a good agent
    [4N + 2]: the goal relative to oneself 2, then the same.

    Reward of every good agent: the adversary's distance to the goal minus the nearest good agent's. The adversary
    gets minus its distance to the goal, squared under "orig".
    """

    num_good: int = 2

    def __post_init__(self) -> None:
        super().__post_init__()
        check_count("num_good", self.num_good, 1)

    @property
    def agents(self) -> tuple[str, ...]:
        return ("adversary_0", *(f"agent_{i}" for i in range(self.num_good)))

    @property
    def teams(self) -> tuple[str, ...]:
        return ("adversaries", *("agents",) * self.num_good)

    @property
    def observation_sizes(self) -> tuple[int, ...]:
        return (4 * self.num_good, *(4 * self.num_good + 2,) * self.num_good)

    @property
    def num_goals(self) -> int:
        return self.num_good

    @property
    def world(self) -> World:
        return World.uniform(1 + self.num_good, self.num_good, 0.15, 0.08)

    def observe(self, state: State) -> tuple[chex.Array, ...]:
        assert state.goal is not None
        n = 1 + self.num_good
        common = jnp.concatenate(
            [
                relative(state.pos, state.landmark).reshape(n, -1),
                others(relative(state.pos, state.pos)).reshape(n, -1),
            ],
            axis=1,
        )
        goal = choose(state.goal, state.landmark) - state.pos[1:]
        return common[0], *jnp.concatenate([goal, common[1:]], axis=1)

    def reward(self, state: State) -> chex.Array:
        assert state.goal is not None
        delta = state.pos - choose(state.goal, state.landmark)
        distance = distance_of(delta)
        adversary = jnp.sum(delta[0] ** 2) if self.rules == "orig" else distance[0]
        good = distance[0] - jnp.min(distance[1:])
        return jnp.concatenate([-adversary[None], jnp.full(self.num_good, good)])
