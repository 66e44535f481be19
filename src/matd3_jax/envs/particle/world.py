"""Physics of the particle world: points on an unbounded plane that push, drag and bump into each other.

Rules as in openai/multiagent-particle-envs 83ba4d1 ("orig") and in mpe2 1.1.1 ("mpe2"); docs/environments.md has them
in full. Axes: n agents, L landmarks, m = n + L entities, agents first.
"""

import dataclasses
from typing import NamedTuple

import chex
import jax.numpy as jnp
import numpy as np

TIME_STEP = 0.1
DAMPING = 0.25
CONTACT_FORCE = 100.0
CONTACT_MARGIN = 0.001


class State(NamedTuple):
    """One particle world. `None` marks what a task does not have."""

    pos: chex.Array
    """[n, 2] positions of the agents."""
    vel: chex.Array
    """[n, 2] velocities of the agents."""
    comm: chex.Array | None
    """[n, dim_c] the agents' latest messages; None if all are silent."""
    landmark: chex.Array
    """[L, 2] positions of the landmarks, which never move."""
    goal: chex.Array | None
    """int32 scalar: index of the goal landmark, or of the goal code. [2] in simple_reference: see there."""
    key: chex.Array | None
    """int32 scalar: index of the cryptographic key."""
    step: chex.Array
    """int32 scalar: env steps since the reset."""


@dataclasses.dataclass(frozen=True)
class World:
    """The static side of a world: one entry per agent, landmarks in their own fields."""

    radius: tuple[float, ...]
    landmark_radius: tuple[float, ...]
    movable: tuple[bool, ...]
    collide: tuple[bool, ...]
    landmark_collide: tuple[bool, ...]
    gain: tuple[float, ...]
    """Force per unit of control."""
    max_speed: tuple[float, ...]
    """Infinity where there is no limit."""

    @classmethod
    def uniform(
        cls,
        num_agents: int,
        num_landmarks: int,
        radius: float,
        landmark_radius: float,
        movable: bool = True,
        collide: bool = False,
    ) -> "World":
        """Agents all alike with gain 5 and no speed limit; landmarks that touch nothing."""
        n = num_agents
        return cls(
            radius=(radius,) * n,
            landmark_radius=(landmark_radius,) * num_landmarks,
            movable=(movable,) * n,
            collide=(collide,) * n,
            landmark_collide=(False,) * num_landmarks,
            gain=(5.0,) * n,
            max_speed=(float("inf"),) * n,
        )

    def move(
        self, pos: chex.Array, vel: chex.Array, landmark: chex.Array, control: chex.Array, velocity_first: bool
    ) -> tuple[chex.Array, chex.Array]:
        """One time step: new (pos [n, 2], vel [n, 2]).

        `control` [n, 2], before the gain. `velocity_first`: positions advance with the new velocity ("orig") instead
        of the old one ("mpe2"). Forces always come from the positions before the step.
        """
        if not any(self.movable):
            return pos, vel
        force = control * _constant(self.gain, pos)[:, None]
        contact = self.contact_force(pos, landmark)
        if contact is not None:
            force = force + contact
        new_vel = self._limit((1 - DAMPING) * vel + TIME_STEP * force)
        new_pos = pos + TIME_STEP * (new_vel if velocity_first else vel)
        if not all(self.movable):
            moves = jnp.array(self.movable)[:, None]
            new_pos, new_vel = jnp.where(moves, new_pos, pos), jnp.where(moves, new_vel, vel)
        return new_pos, new_vel

    def contact_force(self, pos: chex.Array, landmark: chex.Array) -> chex.Array | None:
        """[n, 2] sum of the contact forces on each agent, or None where nothing can touch.

        Entities at exactly the same place push each other nowhere (the original divides by zero there).
        """
        # Landmarks behind the last solid one are left out.
        solid = max((i + 1 for i, collides in enumerate(self.landmark_collide) if collides), default=0)
        touch = np.outer(self.collide, self.collide + self.landmark_collide[:solid])
        if not touch.any():
            return None
        other = jnp.concatenate([pos, landmark[:solid]]) if solid else pos
        radius = self.radius + self.landmark_radius[:solid]
        reach = _constant(np.add.outer(self.radius, radius), pos)
        delta = pos[:, None] - other[None]
        # Squares that are zero, the agent and itself among them, become 1: no contact, finite slope, and delta is 0.
        # Flat, so that XLA on CPU has an inner loop long enough to vectorize.
        square = jnp.sum(delta**2, axis=-1).reshape(-1)
        distance = jnp.sqrt(jnp.where(square > 0, square, 1))
        depth = (reach.reshape(-1) - distance) / CONTACT_MARGIN
        push = (CONTACT_FORCE * CONTACT_MARGIN * softplus(depth) / distance).reshape(touch.shape)
        if not touch.all():
            push = jnp.where(touch, push, 0)
        return jnp.sum(push[..., None] * delta, axis=1)

    def _limit(self, vel: chex.Array) -> chex.Array:
        """Shorten velocities [n, 2] to the agents' speed limits."""
        if np.isinf(self.max_speed).all():
            return vel
        limit = _constant(self.max_speed, vel)
        speed = distance_of(vel)
        too_fast = speed > limit
        scale = jnp.where(too_fast, limit, 1) / jnp.where(too_fast, speed, 1)
        return vel * scale[:, None]


def softplus(x: chex.Array) -> chex.Array:
    """log(1 + exp(x)) to 2e-13, for any x.

    With e = exp(-|x|) it is (x + |x|) / 2 + log(1 + e), and log(1 + e) = 2 artanh(e / (2 + e)), whose series is short
    as its argument is at most 1/3. XLA on CPU does not vectorize log1p here: this makes contacts four times as fast.
    """
    size = jnp.abs(x)
    e = jnp.exp(-size)
    s = e / (2 + e)
    series = jnp.full_like(x, 1 / 23)
    for k in range(21, 0, -2):
        series = series * s**2 + 1 / k
    return (x + size) / 2 + 2 * s * series


def distance_of(delta: chex.Array) -> chex.Array:
    """Length of vectors [..., 2]: [...]. The slope at the zero vector is 0, not NaN."""
    square = jnp.sum(delta**2, axis=-1)
    positive = square > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, square, 1)), 0)


def relative(pos: chex.Array, target: chex.Array) -> chex.Array:
    """[n, k, 2] `target` [k, 2] as seen from `pos` [n, 2]."""
    return target[None] - pos[:, None]


def others(pairs: chex.Array) -> chex.Array:
    """[n, n - 1, ...] from [n, n, ...]: each row without its diagonal element, order kept.

    Reshapes and slices only: behind the first element, the diagonal is every (n + 1)-th.
    """
    n, rest = pairs.shape[0], pairs.shape[2:]
    flat = pairs.reshape(n * n, *rest)
    return flat[1:].reshape(n - 1, n + 1, *rest)[:, :-1].reshape(n, n - 1, *rest)


def choose(index: chex.Array, rows: chex.Array) -> chex.Array:
    """`rows[index]` [..., d] of rows [k, d] and index [...]: products with one-hot vectors, cheaper than a gather."""
    return jnp.sum(one_hot(index, rows.shape[0], rows.dtype)[..., None] * rows, axis=-2)


def one_hot(index: chex.Array, size: int, dtype: chex.ArrayDType) -> chex.Array:
    """[..., size] with a 1 at `index` [...], zeros elsewhere."""
    return (index[..., None] == jnp.arange(size)).astype(dtype)


def outside(pos: chex.Array) -> chex.Array:
    """What prey pays at `pos` [..., 2]: for each coordinate nothing within 0.9, up to 10 far outside. [...]."""
    z = jnp.abs(pos)
    beyond = jnp.minimum(jnp.exp(jnp.minimum(2 * z - 2, 3)), 10)  # exp(3) > 10; farther out it might overflow
    return jnp.sum(jnp.where(z < 0.9, 0, jnp.where(z < 1, 10 * (z - 0.9), beyond)), axis=-1)


def _constant(values: object, like: chex.Array) -> chex.Array:
    return jnp.asarray(np.asarray(values), like.dtype)
