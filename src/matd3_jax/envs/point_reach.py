"""point_reach: damped point masses that run to a common target; a small task for bounded continuous actions."""

import dataclasses
from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp

from matd3_jax.envs.environment import Environment, TimeStep, check_count
from matd3_jax.envs.spaces import Box

TIME_STEP = 0.1
DAMPING = 0.25
GAIN = 5.0
ACTION_COST = 0.01


class PointState(NamedTuple):
    """Axes: n agents, d dimensions of space."""

    pos: chex.Array
    """[n, d]."""
    vel: chex.Array
    """[n, d]."""
    target: chex.Array
    """[d]."""
    step: chex.Array
    """int32 scalar: env steps since the reset."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class PointReach(Environment):
    """`num_agents` unit masses on a line (dim 1) or plane (dim 2); all share one reward.

    Agents and target start uniform on [-1, 1]^dim, at rest. The action is a force u in [-1, 1]^dim (clipped to it):
    v' = 0.75 v + 0.1 * 5 u, p' = p + 0.1 v'. Nobody collides.

    Observation [2 + n] * dim of each agent: own velocity, target relative to oneself, other agents likewise.
    Reward: minus the agents' mean distance to the target, minus 0.01 times their mean |u|^2.

    Raises OptionError for impossible values.
    """

    num_agents: int = 2
    dim: int = 2
    episode_length: int = 25  # type: ignore[misc]  # a field in place of the property

    def __post_init__(self) -> None:
        check_count("num_agents", self.num_agents, 1)
        check_count("dim", self.dim, 1)
        check_count("episode_length", self.episode_length, 1)

    @property
    def agents(self) -> tuple[str, ...]:
        return tuple(f"agent_{i}" for i in range(self.num_agents))

    @property
    def observation_sizes(self) -> tuple[int, ...]:
        return ((1 + self.num_agents) * self.dim,) * self.num_agents

    @property
    def action_spaces(self) -> tuple[Box, ...]:
        return (Box(self.dim, -1.0, 1.0),) * self.num_agents

    @property
    def return_weights(self) -> tuple[float, ...]:
        return (1 / self.num_agents,) * self.num_agents

    @property
    def observation_names(self) -> tuple[tuple[str, ...], ...]:
        axes, agents = ("x", "y", "z")[: self.dim] if self.dim < 4 else tuple(map(str, range(self.dim))), self.agents
        parts = [
            ["own velocity", "target from here", *(f"{other} from here" for other in agents if other != one)]
            for one in agents
        ]
        return tuple(tuple(f"{part} {axis}" for part in own for axis in axes) for own in parts)

    @property
    def action_names(self) -> tuple[tuple[str, ...], ...]:
        axes = ("x", "y", "z")[: self.dim] if self.dim < 4 else tuple(map(str, range(self.dim)))
        return (tuple(f"force {axis}" for axis in axes),) * self.num_agents

    def reset(self, key: chex.PRNGKey) -> tuple[PointState, tuple[chex.Array, ...]]:
        positions = jax.random.uniform(key, (self.num_agents + 1, self.dim), minval=-1.0, maxval=1.0)
        pos, target = positions[:-1], positions[-1]
        state = PointState(pos=pos, vel=jnp.zeros_like(pos), target=target, step=jnp.zeros((), jnp.int32))
        return state, self.observe(state)

    def step(self, key: chex.PRNGKey, state: PointState, action: tuple[chex.Array, ...]) -> TimeStep:
        """All agents act once; nothing here is random, `key` is not used."""
        del key
        force = jnp.clip(jnp.stack(action).astype(state.pos.dtype), -1, 1)
        vel = (1 - DAMPING) * state.vel + TIME_STEP * GAIN * force
        pos = state.pos + TIME_STEP * vel
        state = PointState(pos=pos, vel=vel, target=state.target, step=state.step + 1)
        square = jnp.sum((pos - state.target) ** 2, axis=1)
        on_target = square == 0  # the square root has no slope there
        distance = jnp.where(on_target, 0, jnp.sqrt(jnp.where(on_target, 1, square)))
        reward = -jnp.mean(distance) - ACTION_COST * jnp.mean(jnp.sum(force**2, axis=1))
        return TimeStep(
            state=state,
            observation=self.observe(state),
            reward=jnp.full(self.num_agents, reward),
            terminated=jnp.zeros((), bool),
            truncated=state.step >= self.episode_length,
        )

    def observe(self, state: PointState) -> tuple[chex.Array, ...]:
        pos, n = state.pos, self.num_agents
        return tuple(
            jnp.concatenate([state.vel[i], state.target - pos[i], *(pos[j] - pos[i] for j in range(n) if j != i)])
            for i in range(n)
        )
