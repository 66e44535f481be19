"""What the particle tasks share: options, actions, reset and step."""

import abc
import dataclasses

import chex
import jax
import jax.numpy as jnp

from ..base import ActionSpace, Box, Discrete, Environment, Simplex, TimeStep, check_choice, check_count
from .world import State, World, one_hot

NUM_MOVES = 5
"""Nothing, and a push along each direction of the plane."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ParticleTask(Environment):
    """A particle task. An agent either moves and is silent, or speaks and stands still.

    rules: "orig" (openai/multiagent-particle-envs 83ba4d1, on which MADDPG and MATD3 were run) or "mpe2" (1.1.1).
    actions: "soft" (a vector on the simplex), "discrete" (an integer) or "continuous" (a box).
    episode_length: env steps until truncation. The tasks never terminate.

    Raises OptionError for impossible values.
    """

    rules: str = "orig"
    actions: str = "soft"
    episode_length: int = 25  # type: ignore[misc]  # a field in place of the property

    def __post_init__(self) -> None:
        check_choice("rules", self.rules, ("orig", "mpe2"))
        check_choice("actions", self.actions, ("soft", "discrete", "continuous"))
        check_count("episode_length", self.episode_length, 1)

    @property
    @abc.abstractmethod
    def world(self) -> World:
        """Sizes and limits of agents and landmarks."""

    @property
    def dim_c(self) -> int:
        """Entries of a message; 0 where nobody speaks."""
        return 0

    @property
    def num_goals(self) -> int:
        """Number of goals to draw from; 0 if the task has no goal."""
        return 0

    @property
    def num_keys(self) -> int:
        """Number of cryptographic keys to draw from; 0 if the task has none."""
        return 0

    @property
    def landmark_range(self) -> float:
        """Landmarks start within plus or minus this."""
        return 1.0

    @abc.abstractmethod
    def reward(self, state: State) -> chex.Array:
        """[num_agents] reward for having arrived in `state`."""

    @property
    def action_spaces(self) -> tuple[ActionSpace, ...]:
        return tuple(self._action_space(moves) for moves in self.world.movable)

    def _action_space(self, moves: bool) -> ActionSpace:
        choices = NUM_MOVES if moves else self.dim_c
        if self.actions == "soft":
            return Simplex((choices,))
        if self.actions == "discrete":
            return Discrete(choices)
        return Box(2, -1.0, 1.0) if moves and self.rules == "orig" else Box(choices, 0.0, 1.0)

    def reset(self, key: chex.PRNGKey) -> tuple[State, tuple[chex.Array, ...]]:
        """Agents and landmarks uniform on [-1, 1]^2 (obstacles of simple_tag: [-0.9, 0.9]^2), at rest and silent."""
        world = self.world
        n, num_landmarks = len(world.radius), len(world.landmark_radius)
        ends = [2 * n, 2 * (n + num_landmarks)]
        # One draw for everything: on accelerators each call of the generator is a kernel of its own.
        uniform = jax.random.uniform(key, (ends[1] + 2,))
        pos = 2 * uniform[: ends[0]].reshape(n, 2) - 1
        landmark = self.landmark_range * (2 * uniform[ends[0] : ends[1]].reshape(num_landmarks, 2) - 1)
        state = State(
            pos=pos,
            vel=jnp.zeros_like(pos),
            comm=jnp.zeros((n, self.dim_c), pos.dtype) if self.dim_c else None,
            landmark=landmark,
            goal=(uniform[-2] * self.num_goals).astype(jnp.int32) if self.num_goals else None,
            key=(uniform[-1] * self.num_keys).astype(jnp.int32) if self.num_keys else None,
            step=jnp.zeros((), jnp.int32),
        )
        return state, self.observe(state)

    def step(self, key: chex.PRNGKey, state: State, action: tuple[chex.Array, ...]) -> TimeStep:
        """All agents act once; the world has no randomness, `key` is not used."""
        del key
        pos, vel = self.world.move(
            state.pos, state.vel, state.landmark, self._control(state, action), velocity_first=self.rules == "orig"
        )
        state = state._replace(pos=pos, vel=vel, comm=self._messages(state, action), step=state.step + 1)
        return TimeStep(
            state=state,
            observation=self.observe(state),
            reward=self.reward(state),
            terminated=jnp.zeros((), bool),
            truncated=state.step >= self.episode_length,
        )

    def _control(self, state: State, action: tuple[chex.Array, ...]) -> chex.Array:
        """[n, 2] control of every agent, zero for those that stand still."""
        movable, dtype = self.world.movable, state.pos.dtype
        if not any(movable):
            return jnp.zeros_like(state.pos)
        moves = jnp.stack([a for a, moves in zip(action, movable, strict=True) if moves])
        if self.actions == "continuous" and self.rules == "orig":
            control = moves.astype(dtype)
        else:
            if self.actions == "discrete":
                moves = one_hot(moves, NUM_MOVES, dtype)
            elif self.actions == "continuous":
                moves = jnp.clip(moves, 0, 1)  # as mpe2's wrapper does
            moves = moves.astype(dtype)
            control = moves[:, 2::2] - moves[:, 1::2]  # 1 -x, 2 +x, 3 -y, 4 +y
            if self.actions == "soft" and self.rules == "orig":
                control = -control  # the original's vectors have the signs of its integers turned round
        if all(movable):
            return control
        rows = iter(control)
        return jnp.stack([next(rows) if moves else jnp.zeros(2, dtype) for moves in movable])

    def _messages(self, state: State, action: tuple[chex.Array, ...]) -> chex.Array | None:
        """[n, dim_c] what every agent says now, zero for the silent ones."""
        if not self.dim_c:
            return None
        dtype = state.pos.dtype
        silent = jnp.zeros(self.dim_c, dtype)
        said = [silent if moves else a for a, moves in zip(action, self.world.movable, strict=True)]
        if self.actions == "discrete":
            said = [a if a is silent else one_hot(a, self.dim_c, dtype) for a in said]
        comm = jnp.stack([a.astype(dtype) for a in said])
        return jnp.clip(comm, 0, 1) if self.actions == "continuous" and self.rules == "mpe2" else comm
