"""Actions from actors' outputs: one kind of policy for each kind of action space."""

import dataclasses
import math
from collections.abc import Callable
from typing import Protocol

import chex
import jax
import jax.numpy as jnp

from matd3_jax.core.algorithm import Algorithm
from matd3_jax.envs.spaces import ActionSpace, Box, Discrete, MultiDiscrete, Simplex


class Policy(Protocol):
    """How an actor's output becomes an action vector. Static and hashable.

    Outputs and action vectors are [..., size]. Noise is drawn beforehand, at once for many steps.
    """

    @property
    def size(self) -> int:
        """Entries of an output, and of an action vector."""

    def mode(self, output: chex.Array) -> chex.Array:
        """The deterministic action vector."""

    def sample(self, output: chex.Array, draw: chex.Array | None, scale: chex.Array | float = 0.0) -> chex.Array:
        """The action vector under the noise `draw` (from `noise` or `own_noise`); None: the deterministic one. `scale`:
        standard deviation of exploration noise in half ranges, for those that have some."""

    def smooth(self, action: chex.Array, draw: chex.Array, sigma: chex.Array, clip: chex.Array) -> chex.Array:
        """Target policy smoothing (the paper's equation for y_i): clip(sigma * draw, -clip, clip) added to actions."""

    def shift(self, action: chex.Array, change: chex.Array) -> chex.Array:
        """Actions with `change` added to them, of a Box in half ranges and no further than its bounds."""

    def distance(self, output: chex.Array, wanted: chex.Array) -> chex.Array:
        """How far the policies of two outputs are apart, [...]: of a Box the mean squared difference of the actions in
        half ranges, of choices KL(wanted || output), summed over the choices."""

    def noise(self, key: chex.PRNGKey, shape: tuple[int, ...]) -> chex.Array:
        """What `sample` takes while exploring, [*shape, size]."""

    def own_noise(self, key: chex.PRNGKey, shape: tuple[int, ...]) -> chex.Array | None:
        """What `sample` takes without exploration, [*shape, size]; None for a deterministic policy."""

    def random(self, key: chex.PRNGKey, shape: tuple[int, ...]) -> chex.Array:
        """Uniform action vectors [*shape, size]."""

    def to_env(self, action: chex.Array) -> chex.Array:
        """What `Environment.step` takes for an action vector."""


def of(space: ActionSpace, algorithm: Algorithm) -> Policy:
    """The policy that an algorithm has in an action space."""
    if isinstance(space, Box):
        return DeterministicPolicy(space, algorithm.actor_output)
    return CategoricalPolicy(space)


@dataclasses.dataclass(frozen=True)
class DeterministicPolicy:
    """Outputs squashed to the range of a Box; Gaussian noise is exploration alone."""

    space: Box
    squash: str = "sigmoid"
    """`Algorithm.actor_output`."""

    @property
    def size(self) -> int:
        return self.space.size

    @property
    def half(self) -> float:
        """Half the range of an action."""
        return (self.space.high - self.space.low) / 2

    def mode(self, output: chex.Array) -> chex.Array:
        if self.squash == "tanh":
            return self.space.low + self.half + self.half * jnp.tanh(output)
        return self.space.low + 2 * self.half * jax.nn.sigmoid(output)

    def sample(self, output: chex.Array, draw: chex.Array | None, scale: chex.Array | float = 0.0) -> chex.Array:
        action = self.mode(output)
        return action if draw is None else self._inside(action + scale * self.half * draw)

    def smooth(self, action: chex.Array, draw: chex.Array, sigma: chex.Array, clip: chex.Array) -> chex.Array:
        return self.shift(action, jnp.clip(sigma * draw, -clip, clip))

    def shift(self, action: chex.Array, change: chex.Array) -> chex.Array:
        return self._inside(action + change * self.half)

    def distance(self, output: chex.Array, wanted: chex.Array) -> chex.Array:
        return jnp.square((self.mode(output) - self.mode(wanted)) / self.half).mean(axis=-1)

    def noise(self, key: chex.PRNGKey, shape: tuple[int, ...]) -> chex.Array:
        return flat_draw(jax.random.normal, key, (*shape, self.size))

    def own_noise(self, key: chex.PRNGKey, shape: tuple[int, ...]) -> None:
        return None

    def random(self, key: chex.PRNGKey, shape: tuple[int, ...]) -> chex.Array:
        return jax.random.uniform(key, (*shape, self.size), minval=self.space.low, maxval=self.space.high)

    def to_env(self, action: chex.Array) -> chex.Array:
        return action

    def _inside(self, action: chex.Array) -> chex.Array:
        return jnp.clip(action, self.space.low, self.space.high)


@dataclasses.dataclass(frozen=True)
class CategoricalPolicy:
    """softmax(logits + Gumbel noise) at temperature 1 for each choice: soft as it is for a `Simplex`; one-hot with the
    soft sample's gradient (straight-through) for hard choices. The noise is the policy's own, and its exploration."""

    space: Simplex | Discrete | MultiDiscrete

    @property
    def size(self) -> int:
        return self.space.size

    def mode(self, output: chex.Array) -> chex.Array:
        parts = [_choose(part, isinstance(self.space, Simplex)) for part in self._parts(output)]
        return jnp.concatenate(parts, axis=-1)

    def sample(self, output: chex.Array, draw: chex.Array | None, scale: chex.Array | float = 0.0) -> chex.Array:
        return self.mode(output if draw is None else output + draw)

    def smooth(self, action: chex.Array, draw: chex.Array, sigma: chex.Array, clip: chex.Array) -> chex.Array:
        return self.shift(action, jnp.clip(sigma * draw, -clip, clip))

    def shift(self, action: chex.Array, change: chex.Array) -> chex.Array:
        """Added to the vectors without projecting back, as in the authors' program."""
        return action + change

    def distance(self, output: chex.Array, wanted: chex.Array) -> chex.Array:
        found = []
        for part, other in zip(self._parts(output), self._parts(wanted), strict=True):
            log, other_log = jax.nn.log_softmax(part), jax.nn.log_softmax(other)
            found.append(jnp.sum(jnp.exp(other_log) * (other_log - log), axis=-1))
        return sum(found[1:], found[0])

    def noise(self, key: chex.PRNGKey, shape: tuple[int, ...]) -> chex.Array:
        return flat_draw(jax.random.gumbel, key, (*shape, self.size))

    def own_noise(self, key: chex.PRNGKey, shape: tuple[int, ...]) -> chex.Array:
        return self.noise(key, shape)

    def random(self, key: chex.PRNGKey, shape: tuple[int, ...]) -> chex.Array:
        return self.sample(jnp.zeros((*shape, self.size)), self.noise(key, shape))

    def to_env(self, action: chex.Array) -> chex.Array:
        """The vector of soft choices, or the number(s) of hard ones."""
        if isinstance(self.space, Simplex):
            return action
        chosen = [jnp.argmax(part, -1).astype(jnp.int32) for part in self._parts(action)]
        return chosen[0] if isinstance(self.space, Discrete) else jnp.stack(chosen, -1)

    def _parts(self, vector: chex.Array) -> list[chex.Array]:
        """The choices of a vector, each [..., size of the choice]."""
        sizes = self.space.sizes
        ends = [sum(sizes[: i + 1]) for i in range(len(sizes))]
        return [vector[..., end - size : end] for end, size in zip(ends, sizes, strict=True)]


def flat_draw(draw: Callable, key: chex.PRNGKey, shape: tuple[int, ...]) -> chex.Array:
    """`draw(key, shape)`, computed along one long axis: three times as fast on a CPU as with a short last axis."""
    return draw(key, (math.prod(shape),)).reshape(shape)


def _choose(logits: chex.Array, soft: bool) -> chex.Array:
    sample = jax.nn.softmax(logits)
    if soft:
        return sample
    hard = jax.nn.one_hot(jnp.argmax(sample, -1), sample.shape[-1], dtype=sample.dtype)
    return hard + (sample - jax.lax.stop_gradient(sample))  # the bracket is exactly 0: the choice stays one-hot
