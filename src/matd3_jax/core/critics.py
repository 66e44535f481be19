"""Critics: what an agent believes that joint actions are worth."""

import dataclasses
from typing import Any, Protocol

import chex
import jax
import jax.numpy as jnp
import optax

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

    def target_value(self, params: chex.ArrayTree, inputs: chex.Array) -> chex.Array:
        """min_j Q'_ij [batch], or what else `target` has in its place."""

    @property
    def num_outputs(self) -> int:
        """Width of each critic's last layer, for those who count operations and bytes."""

    def loss(self, params: chex.ArrayTree, inputs: chex.Array, target: chex.Array) -> tuple[chex.Array, chex.Array]:
        """(loss [critics], values Q_i1 of the first critic [batch])."""

    def value(
        self, params: chex.ArrayTree, inputs: chex.Array, change: chex.Array, column: chex.Array | int
    ) -> chex.Array:
        """What the actor climbs, Q_i1 [batch] or the mean over the critics, of the inputs with `change` [batch, k]
        added to the columns from `column` on. A gradient with respect to `change` costs k columns instead of all."""


def of(algorithm: Algorithm) -> Critic:
    """The critics of an algorithm's agents."""
    network = (algorithm.num_critics, algorithm.hidden, algorithm.critic_norm == "layer", algorithm.critics_climbed)
    if algorithm.critic_head == "scalar":
        return ScalarCritic(*network)
    if algorithm.critic_head == "quantile":
        return QuantileCritic(*network, algorithm.critic_quantiles, algorithm.dropped_quantiles)
    assert algorithm.critic_range is not None
    return CategoricalCritic(*network, algorithm.critic_atoms, algorithm.critic_range)


def of_target(algorithm: Algorithm) -> Critic:
    """The critics that make a target: all of them, or those that are drawn for it."""
    return of(dataclasses.replace(algorithm, num_critics=algorithm.critics_in_target))


@dataclasses.dataclass(frozen=True)
class _Perceptrons:
    """Twins as one stacked network; a head says what its outputs mean."""

    num_critics: int
    hidden: tuple[int, ...]
    layer_norm: bool
    climbed: int
    """Number of critics, from the first on, whose mean value the actor climbs."""

    @property
    def num_outputs(self) -> int:
        return 1

    def read(self, outputs: chex.Array) -> chex.Array:
        """Values [...] of outputs [..., num_outputs]."""
        return outputs[..., 0]

    def network(self, critics: int) -> StackedMLP:
        """So many critics as one network: inputs [batch, inputs] to outputs [critics, batch, num_outputs]."""
        return StackedMLP((critics,), (*self.hidden, self.num_outputs), self.layer_norm)

    def init(self, key: chex.PRNGKey, inputs: int) -> chex.ArrayTree:
        return self.network(self.num_critics).init(key, jnp.zeros((1, inputs)))["params"]

    def outputs(self, params: chex.ArrayTree, inputs: chex.Array) -> chex.Array:
        """[critics, batch, num_outputs]."""
        return apply(self.network(self.num_critics), params, inputs)

    def values(self, params: chex.ArrayTree, inputs: chex.Array) -> chex.Array:
        return self.read(self.outputs(params, inputs))

    def target_value(self, params: chex.ArrayTree, inputs: chex.Array) -> chex.Array:
        return self.values(params, inputs).min(axis=0)

    def value(
        self, params: chex.ArrayTree, inputs: chex.Array, change: chex.Array, column: chex.Array | int
    ) -> chex.Array:
        some: Any = jax.tree.map(lambda p: p[: self.climbed], params)
        outputs = apply(self.network(self.climbed), some, inputs, change, column)
        return self.read(outputs[0]) if self.climbed == 1 else self.read(outputs).mean(axis=0)


@dataclasses.dataclass(frozen=True)
class ScalarCritic(_Perceptrons):
    """Critics that give one number each; a mean squared error."""

    def target(
        self, params: chex.ArrayTree, reward: chex.Array, discount: chex.Array, next_inputs: chex.Array
    ) -> chex.Array:
        return reward + discount * self.target_value(params, next_inputs)

    def loss(self, params: chex.ArrayTree, inputs: chex.Array, target: chex.Array) -> tuple[chex.Array, chex.Array]:
        q = self.values(params, inputs)
        return jnp.mean(jnp.square(q - target), axis=-1), q[0]


@dataclasses.dataclass(frozen=True)
class CategoricalCritic(_Perceptrons):
    """Critics that give a distribution of returns over fixed atoms (C51, Bellemare et al. 2017); a cross-entropy.

    The value is the distribution's mean. The target is the distribution of the critic with the smaller mean, moved to
    r + discount * z and shared out between the neighboring atoms.
    """

    atoms: int
    support: tuple[float, float]
    """Returns at the first and last atom; what lies outside counts as the nearer of them."""

    @property
    def num_outputs(self) -> int:
        return self.atoms

    @property
    def returns(self) -> chex.Array:
        """z [atoms], evenly spaced."""
        return jnp.linspace(*self.support, self.atoms)

    def mean(self, probabilities: chex.Array) -> chex.Array:
        """Expected returns [...] of distributions [..., atoms]."""
        return (probabilities * self.returns).sum(axis=-1)

    def read(self, outputs: chex.Array) -> chex.Array:
        return self.mean(jax.nn.softmax(outputs))

    def target(
        self, params: chex.ArrayTree, reward: chex.Array, discount: chex.Array, next_inputs: chex.Array
    ) -> chex.Array:
        probabilities = jax.nn.softmax(self.outputs(params, next_inputs))
        smallest = jax.nn.one_hot(self.mean(probabilities).argmin(axis=0), self.num_critics, axis=0)
        return self.project((smallest[..., None] * probabilities).sum(axis=0), reward, discount)

    def project(self, probabilities: chex.Array, reward: chex.Array, discount: chex.Array) -> chex.Array:
        """The distributions [batch, atoms] of reward + discount * return, on the atoms themselves."""
        low, high = self.support
        moved = jnp.clip(reward[:, None] + discount[:, None] * self.returns, low, high)
        position = (moved - low) * ((self.atoms - 1) / (high - low))
        # An atom takes its share of all mass within one spacing of it: [batch, atom, mass], summed as it is made.
        distance = jnp.abs(position[:, None, :] - jnp.arange(self.atoms)[:, None])
        return (jnp.maximum(1 - distance, 0) * probabilities[:, None, :]).sum(axis=-1)

    def loss(self, params: chex.ArrayTree, inputs: chex.Array, target: chex.Array) -> tuple[chex.Array, chex.Array]:
        logs = jax.nn.log_softmax(self.outputs(params, inputs))
        return -(target * logs).sum(axis=-1).mean(axis=-1), self.mean(jnp.exp(logs[0]))


@dataclasses.dataclass(frozen=True)
class QuantileCritic(_Perceptrons):
    """Critics that give quantiles of the return; the target leaves the largest of all critics' out (TQC, Kuznetsov et
    al. 2020).

    The value is the quantiles' mean. The loss is the quantile regression's, Huber's with threshold 1.
    """

    quantiles: int
    dropped: int
    """Of each target critic's quantiles; those of all critics are sorted together before."""

    @property
    def num_outputs(self) -> int:
        return self.quantiles

    def read(self, outputs: chex.Array) -> chex.Array:
        return outputs.mean(axis=-1)

    def kept(self, params: chex.ArrayTree, inputs: chex.Array) -> chex.Array:
        """The smaller quantiles of all critics together, [batch, critics * (quantiles - dropped)], in rising order."""
        outputs = jnp.moveaxis(self.outputs(params, inputs), 0, 1)
        every = jnp.sort(outputs.reshape(outputs.shape[0], -1), axis=-1)
        return every[:, : self.num_critics * (self.quantiles - self.dropped)]

    def target(
        self, params: chex.ArrayTree, reward: chex.Array, discount: chex.Array, next_inputs: chex.Array
    ) -> chex.Array:
        return reward[:, None] + discount[:, None] * self.kept(params, next_inputs)

    def target_value(self, params: chex.ArrayTree, inputs: chex.Array) -> chex.Array:
        return self.kept(params, inputs).mean(axis=-1)

    def loss(self, params: chex.ArrayTree, inputs: chex.Array, target: chex.Array) -> tuple[chex.Array, chex.Array]:
        outputs = self.outputs(params, inputs)
        # [critics, batch, quantiles, the target's], summed as it is made.
        error = target[:, None, :] - outputs[..., None]
        level = (jnp.arange(self.quantiles) + 0.5) / self.quantiles
        weight = jnp.abs(level[:, None] - (error < 0))
        return (weight * optax.huber_loss(error)).mean(axis=(-3, -2, -1)), self.read(outputs[0])
