"""What the particle tasks share: options, actions, reset and step."""

import abc
import dataclasses
import math

import chex
import jax
import jax.numpy as jnp

from matd3_jax.envs.environment import Environment, TimeStep, check_choice, check_count
from matd3_jax.envs.particle.world import State, World, one_hot
from matd3_jax.envs.spaces import ActionSpace, Box, Discrete, MultiDiscrete, Simplex
from matd3_jax.errors import OptionError

NUM_MOVES = 5
"""Nothing, and a push along each direction of the plane."""

Parts = list[chex.Array | None]
"""One entry an agent, None for those that lack the part."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ParticleTask(Environment):
    """A particle task. An agent moves, speaks, or does both at once: then its action is a movement and a word.

    rules: "orig" (openai/multiagent-particle-envs 83ba4d1, on which MADDPG and MATD3 were run) or "mpe2" (1.1.1).
    actions: "soft" (vectors on the simplex), "discrete" (integers) or "continuous" (a box).
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
    def speaks(self) -> tuple[bool, ...]:
        """Who speaks. Unless a task says otherwise, those that cannot move."""
        return tuple(self.dim_c > 0 and not moves for moves in self.world.movable)

    @property
    def num_goals(self) -> int:
        """Number of goals to draw from; 0 if the task has no goal."""
        return 0

    @property
    def goal_shape(self) -> tuple[int, ...]:
        """Shape of `State.goal`: () for one that all share."""
        return ()

    @property
    def num_keys(self) -> int:
        """Number of cryptographic keys to draw from; 0 if the task has none."""
        return 0

    @property
    def landmark_kinds(self) -> tuple[str, ...]:
        """What each landmark is, for whoever looks on: "landmark", "obstacle", "goal", "food" or "forest"."""
        return tuple("obstacle" if collides else "landmark" for collides in self.world.landmark_collide)

    @property
    def landmark_range(self) -> float:
        """Landmarks start within plus or minus this."""
        return 1.0

    @abc.abstractmethod
    def reward(self, state: State) -> chex.Array:
        """[num_agents] reward for having arrived in `state`."""

    @property
    def action_spaces(self) -> tuple[ActionSpace, ...]:
        return tuple(map(self._action_space, self.world.movable, self.speaks))

    def _action_space(self, moves: bool, speaks: bool) -> ActionSpace:
        choices = (NUM_MOVES,) * moves + (self.dim_c,) * speaks
        if self.actions == "soft":
            return Simplex(choices)
        if self.actions == "discrete":
            return Discrete(choices[0]) if len(choices) == 1 else MultiDiscrete(choices)
        if moves and self.rules == "orig":
            return Box(2 + self.dim_c * speaks, -1.0, 1.0)
        return Box(sum(choices), 0.0, 1.0)

    @property
    def action_names(self) -> tuple[tuple[str, ...], ...]:
        turned = self.actions == "soft" and self.rules == "orig"  # see `_control`
        pushes = ("+x", "-x", "+y", "-y") if turned else ("-x", "+x", "-y", "+y")
        moves = ("force x", "force y") if self._as_force else ("stay", *(f"push {way}" for way in pushes))
        says = tuple(f"say {k}" for k in range(self.dim_c))
        return tuple(
            moves * moving + says * speaking for moving, speaking in zip(self.world.movable, self.speaks, strict=True)
        )

    def reset(self, key: chex.PRNGKey) -> tuple[State, tuple[chex.Array, ...]]:
        """Agents uniform on [-1, 1]^2, landmarks within `landmark_range` likewise, at rest and silent."""
        world = self.world
        n, num_landmarks = len(world.radius), len(world.landmark_radius)
        ends = [2 * n, 2 * (n + num_landmarks)]
        # One draw for everything: on accelerators each call of the generator is a kernel of its own.
        uniform = jax.random.uniform(key, (ends[1] + math.prod(self.goal_shape) + 1,))
        pos = 2 * uniform[: ends[0]].reshape(n, 2) - 1
        landmark = self.landmark_range * (2 * uniform[ends[0] : ends[1]].reshape(num_landmarks, 2) - 1)
        goal = uniform[ends[1] : -1].reshape(self.goal_shape)
        state = State(
            pos=pos,
            vel=jnp.zeros_like(pos),
            comm=jnp.zeros((n, self.dim_c), pos.dtype) if self.dim_c else None,
            landmark=landmark,
            goal=(goal * self.num_goals).astype(jnp.int32) if self.num_goals else None,
            key=(uniform[-1] * self.num_keys).astype(jnp.int32) if self.num_keys else None,
            step=jnp.zeros((), jnp.int32),
        )
        return state, self.observe(state)

    def step(self, key: chex.PRNGKey, state: State, action: tuple[chex.Array, ...]) -> TimeStep:
        """All agents act once; the world has no randomness, `key` is not used."""
        del key
        moves, words = self._parts(action)
        pos, vel = self.world.move(
            state.pos, state.vel, state.landmark, self._control(state, moves), velocity_first=self.rules == "orig"
        )
        state = state._replace(pos=pos, vel=vel, comm=self._messages(state, words), step=state.step + 1)
        return TimeStep(
            state=state,
            observation=self.observe(state),
            reward=self.reward(state),
            terminated=jnp.zeros((), bool),
            truncated=state.step >= self.episode_length,
        )

    def _parts(self, action: tuple[chex.Array, ...]) -> tuple[Parts, Parts]:
        """(movements, words): what an action space holds of each, movements first."""
        moves: Parts = []
        words: Parts = []
        size = 2 if self._as_force else NUM_MOVES
        for a, can_move, speaks in zip(action, self.world.movable, self.speaks, strict=True):
            if can_move and speaks:
                a, word = (a[0], a[1]) if self.actions == "discrete" else (a[:size], a[size:])
                if self._as_force:
                    word = (1 + word) / 2  # a box has one pair of bounds: the forces' [-1, 1] stands for [0, 1]
            else:
                word = a
            moves.append(a if can_move else None)
            words.append(word if speaks else None)
        return moves, words

    @property
    def _as_force(self) -> bool:
        """Movements are the control itself."""
        return self.actions == "continuous" and self.rules == "orig"

    def _control(self, state: State, moves: Parts) -> chex.Array:
        """[n, 2] control of every agent, zero for those that stand still."""
        dtype = state.pos.dtype
        given = [move for move in moves if move is not None]
        if not given:
            return jnp.zeros_like(state.pos)
        vectors = jnp.stack(given)
        if self._as_force:
            control = vectors.astype(dtype)
        else:
            if self.actions == "discrete":
                vectors = one_hot(vectors, NUM_MOVES, dtype)
            elif self.actions == "continuous":
                vectors = jnp.clip(vectors, 0, 1)  # as mpe2's wrapper does
            vectors = vectors.astype(dtype)
            control = vectors[:, 2::2] - vectors[:, 1::2]  # 1 -x, 2 +x, 3 -y, 4 +y
            if self.actions == "soft" and self.rules == "orig":
                control = -control  # the original's vectors have the signs of its integers turned round
        if len(given) == len(moves):
            return control
        rows = iter(control)
        return jnp.stack([jnp.zeros(2, dtype) if move is None else next(rows) for move in moves])

    def _messages(self, state: State, words: Parts) -> chex.Array | None:
        """[n, dim_c] what every agent says now, zero for the silent ones."""
        if not self.dim_c:
            return None
        dtype = state.pos.dtype
        silent = jnp.zeros(self.dim_c, dtype)
        if self.actions == "discrete":
            words = [None if word is None else one_hot(word, self.dim_c, dtype) for word in words]
        comm = jnp.stack([silent if word is None else word.astype(dtype) for word in words])
        return jnp.clip(comm, 0, 1) if self.actions == "continuous" and self.rules == "mpe2" else comm


def check_local_ratio(ratio: object, rules: str) -> None:
    """Raise OptionError unless `ratio`, the weight of an agent's own reward against the shared one, is None or fits."""
    if ratio is None:
        return
    if rules != "mpe2":
        raise OptionError(f"local_ratio={ratio!r}: only rules='mpe2' have it; leave it out")
    if not isinstance(ratio, int | float) or isinstance(ratio, bool) or not 0 <= ratio <= 1:
        raise OptionError(f"local_ratio={ratio!r}: must be a number between 0 and 1")
