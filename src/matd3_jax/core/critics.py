"""Critics: what an agent believes that joint actions are worth."""

import dataclasses
from typing import Any, Protocol

import chex
import jax
import jax.numpy as jnp

from matd3_jax.core.algorithm import Algorithm
from matd3_jax.core.networks import StackedMLP, apply


class Critic(Protocol):
    """The critics of one agent, twins as a rule. Static and hashable.

    `inputs` [batch, inputs] are what they read: observations, then actions (x and a, or o_i and a_i). A target is
    whatever `loss` takes: values, or distributions.
    """

    def init(self, key: chex.PRNGKey, inputs: int) -> chex.ArrayTree:
        """Fresh parameters, leaves [critics, ...], of critics that read `inputs` numbers."""

    def values(self, params: chex.ArrayTree, inputs: chex.Array) -> chex.Array:
        """Q_ij of every critic j, [critics, batch]."""

    def target(
        self, params: chex.ArrayTree, reward: chex.Array, discount: chex.Array, next_inputs: chex.Array
    ) -> chex.Array:
        """r + discount * min_j Q'_ij(next inputs), leading axis [batch]; reward, discount: [batch]."""

    def loss(self, params: chex.ArrayTree, inputs: chex.Array, target: chex.Array) -> tuple[chex.Array, chex.Array]:
        """(loss [critics], values Q_i1 of the first critic [batch])."""

    def value(
        self, params: chex.ArrayTree, inputs: chex.Array, change: chex.Array, column: chex.Array | int
    ) -> chex.Array:
        """Q_i1 [batch] of the inputs with `change` [batch, k] added to the columns from `column` on: what the actor
        climbs. A gradient with respect to `change` costs k columns instead of all."""


def of(algorithm: Algorithm) -> Critic:
    """The critics of an algorithm's agents."""
    return ScalarCritic(algorithm.num_critics, algorithm.hidden)


@dataclasses.dataclass(frozen=True)
class ScalarCritic:
    """Critics that give one number each; a mean squared error."""

    num_critics: int
    hidden: tuple[int, ...]

    def network(self, critics: int) -> StackedMLP:
        """So many critics as one network: inputs [batch, inputs] to outputs [critics, batch, 1]."""
        return StackedMLP((critics,), (*self.hidden, 1))

    def init(self, key: chex.PRNGKey, inputs: int) -> chex.ArrayTree:
        return self.network(self.num_critics).init(key, jnp.zeros((1, inputs)))["params"]

    def values(self, params: chex.ArrayTree, inputs: chex.Array) -> chex.Array:
        return apply(self.network(self.num_critics), params, inputs)[..., 0]

    def target(
        self, params: chex.ArrayTree, reward: chex.Array, discount: chex.Array, next_inputs: chex.Array
    ) -> chex.Array:
        return reward + discount * self.values(params, next_inputs).min(axis=0)

    def loss(self, params: chex.ArrayTree, inputs: chex.Array, target: chex.Array) -> tuple[chex.Array, chex.Array]:
        q = self.values(params, inputs)
        return jnp.mean(jnp.square(q - target), axis=-1), q[0]

    def value(
        self, params: chex.ArrayTree, inputs: chex.Array, change: chex.Array, column: chex.Array | int
    ) -> chex.Array:
        first: Any = jax.tree.map(lambda p: p[:1], params)
        return apply(self.network(1), first, inputs, change, column)[0, :, 0]
