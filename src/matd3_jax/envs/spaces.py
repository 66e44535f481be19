"""What an agent can do: action spaces."""

import dataclasses
import math

import chex
import jax
import jax.numpy as jnp


@dataclasses.dataclass(frozen=True)
class Box:
    """A vector of `size` real numbers, each between `low` and `high`."""

    size: int
    low: float = -float("inf")
    high: float = float("inf")

    @property
    def shape(self) -> tuple[int, ...]:
        return (self.size,)

    def sample(self, key: chex.PRNGKey) -> chex.Array:
        """Uniform draw, [size]. Raises ValueError when a bound is infinite."""
        if not (math.isfinite(self.low) and math.isfinite(self.high)):
            raise ValueError(f"cannot sample from an unbounded {self}")
        return jax.random.uniform(key, self.shape, minval=self.low, maxval=self.high)


@dataclasses.dataclass(frozen=True)
class Simplex:
    """Soft choices: for each entry of `sizes` a vector of that many non-negative numbers summing to 1, concatenated.

    A one-hot vector is the hard choice. The environments take the vector as it is; nothing is rounded.
    """

    sizes: tuple[int, ...]

    @property
    def size(self) -> int:
        return sum(self.sizes)

    @property
    def shape(self) -> tuple[int, ...]:
        return (self.size,)

    def sample(self, key: chex.PRNGKey) -> chex.Array:
        """Softmax of Gumbel noise in each part, [size]: what a soft categorical policy with equal logits plays."""
        noise = jax.random.gumbel(key, self.shape)
        ends = [sum(self.sizes[: i + 1]) for i in range(len(self.sizes))]
        return jnp.concatenate([jax.nn.softmax(part) for part in jnp.split(noise, ends[:-1])])


@dataclasses.dataclass(frozen=True)
class Discrete:
    """One hard choice among `n`: an int32 scalar in [0, n)."""

    n: int

    @property
    def size(self) -> int:
        """Entries of the one-hot vector that stands for the choice in joint vectors."""
        return self.n

    @property
    def sizes(self) -> tuple[int, ...]:
        return (self.n,)

    @property
    def shape(self) -> tuple[int, ...]:
        return ()

    def sample(self, key: chex.PRNGKey) -> chex.Array:
        """Uniform draw, int32 scalar."""
        return jax.random.randint(key, (), 0, self.n, jnp.int32)


@dataclasses.dataclass(frozen=True)
class MultiDiscrete:
    """Several hard choices at once: an int32 vector, entry k in [0, sizes[k])."""

    sizes: tuple[int, ...]

    @property
    def size(self) -> int:
        """Entries of the concatenated one-hot vectors that stand for the choices in joint vectors."""
        return sum(self.sizes)

    @property
    def shape(self) -> tuple[int, ...]:
        return (len(self.sizes),)

    def sample(self, key: chex.PRNGKey) -> chex.Array:
        """Independent uniform draws, int32 [len(sizes)]."""
        return jax.random.randint(key, self.shape, 0, jnp.array(self.sizes, jnp.int32), jnp.int32)


ActionSpace = Box | Simplex | Discrete | MultiDiscrete
