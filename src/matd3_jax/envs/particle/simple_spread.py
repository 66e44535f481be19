"""simple_spread (Cooperative Navigation): cover all landmarks without bumping into each other."""

import dataclasses

import chex
import jax.numpy as jnp

from matd3_jax.envs.environment import check_count
from matd3_jax.envs.particle.task import ParticleTask, check_local_ratio
from matd3_jax.envs.particle.world import State, World, distance_of, others, relative

AGENT_RADIUS = 0.15
SILENT_DIM_C = 2
"""Nobody speaks here, yet the original shows everybody messages of this many zeros."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class SimpleSpread(ParticleTask):
    """N agents, N landmarks.

    Observation [6N]: own velocity 2, own position 2, landmarks relative to oneself 2N, other agents likewise 2(N-1),
    their (empty) messages 2(N-1).

    Reward, with D the sum over landmarks of the distance of the nearest agent and n_i the others that i touches:
    "orig" gives everybody sum_i(-D - n_i - 1), where the 1 is each agent touching itself;
    "mpe2" gives agent i (1 - local_ratio) * -D - local_ratio * n_i.

    local_ratio: None stands for 0.5 under "mpe2"; must be None under "orig".
    """

    num_agents: int = 3
    local_ratio: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        check_count("num_agents", self.num_agents, 1)
        check_local_ratio(self.local_ratio, self.rules)

    @property
    def agents(self) -> tuple[str, ...]:
        return tuple(f"agent_{i}" for i in range(self.num_agents))

    @property
    def observation_sizes(self) -> tuple[int, ...]:
        return (6 * self.num_agents,) * self.num_agents

    @property
    def world(self) -> World:
        return World.uniform(self.num_agents, self.num_agents, AGENT_RADIUS, 0.05, collide=True)

    def observe(self, state: State) -> tuple[chex.Array, ...]:
        n = self.num_agents
        parts = [
            state.vel,
            state.pos,
            relative(state.pos, state.landmark).reshape(n, -1),
            others(relative(state.pos, state.pos)).reshape(n, -1),
            jnp.zeros((n, SILENT_DIM_C * (n - 1)), state.pos.dtype),
        ]
        return tuple(jnp.concatenate(parts, axis=1))

    def reward(self, state: State) -> chex.Array:
        n, dtype = self.num_agents, state.pos.dtype
        uncovered = jnp.sum(jnp.min(distance_of(relative(state.pos, state.landmark)), axis=0))
        touching = distance_of(relative(state.pos, state.pos)) < 2 * AGENT_RADIUS
        if self.rules == "orig":
            # The diagonal of `touching` is the agent's collision with itself.
            return jnp.full(n, -n * uncovered - jnp.sum(touching.astype(dtype)))
        ratio = 0.5 if self.local_ratio is None else self.local_ratio
        return -(1 - ratio) * uncovered - ratio * (jnp.sum(touching.astype(dtype), axis=1) - 1)
