"""One agent's deterministic policy, taken out of its stack: as a function in JAX, and as plain arrays."""

import dataclasses
from collections.abc import Callable

import chex
import jax
import jax.numpy as jnp
import numpy as np

from matd3_jax.core import networks, running_statistics
from matd3_jax.core.acting import PolicyParams
from matd3_jax.core.agents import JointLayout
from matd3_jax.core.networks import StackedMLP
from matd3_jax.core.policies import CategoricalPolicy, DeterministicPolicy
from matd3_jax.core.running_statistics import CLIP, LEAST_VARIANCE, Statistics
from matd3_jax.envs.spaces import ActionSpace, Box, Simplex
from matd3_jax.errors import UserError


@dataclasses.dataclass(frozen=True)
class Perceptron:
    """A deterministic policy as plain arrays: what the formats without JAX are made from.

    u = the network of clip((observation - mean) / deviation, -bound, bound), ReLU between its layers. A Box action is
    low + half + half * tanh(slope * u), half its half range; choices are the softmax of their parts of u: themselves
    (Simplex), or the likeliest of each (Discrete, MultiDiscrete).
    """

    space: ActionSpace
    slope: float
    """Of the tanh: 1, or 1/2 for a sigmoid. Of a Box alone."""
    kernels: tuple[np.ndarray, ...]
    """[inputs, outputs] of each layer, float32."""
    biases: tuple[np.ndarray, ...]
    """[outputs]."""
    mean: np.ndarray | None = None
    """[observation size]; None: observations are not normalized."""
    deviation: np.ndarray | None = None
    bound: float = CLIP


def function(layout: JointLayout, policy: PolicyParams, agent: int) -> Callable[[chex.Array], dict[str, chex.Array]]:
    """The deterministic policy of one agent as a function of observations [batch, size], for any network.

    It gives "action" as `Environment.step` takes it with a leading axis [batch], and for choices "probabilities"
    [batch, entries of all choices].

    Args:
        policy: of one seed.
    """
    g, k = layout.place(agent)
    group = layout.groups[g]
    params = jax.tree.map(jnp.asarray, group.of_member(policy.actors[g], k))

    def one(observation: chex.Array) -> dict[str, chex.Array]:
        seen = observation[None]
        if policy.statistics is not None:
            statistics = jax.tree.map(jnp.asarray, policy.statistics)
            seen = running_statistics.normalize_part(layout, statistics, seen, agent)
        output = networks.apply(group.actor, params, seen)[0]
        found = {"action": group.policy.to_env(group.policy.mode(output))}
        if not isinstance(group.action_space, Box):
            soft = CategoricalPolicy(Simplex(group.action_space.sizes))
            found["probabilities"] = soft.mode(output)
        return found

    def act(observation: chex.Array) -> dict[str, chex.Array]:
        with jax.default_matmul_precision("highest"):
            return jax.vmap(one)(observation)  # one row at a time: networks choose their products by the batch's size

    return act


def perceptron(layout: JointLayout, policy: PolicyParams, agent: int, format: str) -> Perceptron:
    """The deterministic policy of one agent as plain arrays.

    Raises UserError where its network or its head is another than the family's own.
    """
    g, k = layout.place(agent)
    group, name = layout.groups[g], layout.agents[agent]
    network, head = group.actor, group.policy
    if type(network) is not StackedMLP or network.layer_norm:
        raise UserError(
            f"format={format} holds perceptrons with ReLU alone; the actor of {name} is a {type(network).__name__}"
            f"{' with layer normalization' * getattr(network, 'layer_norm', False)}: format=saved_fn holds any network"
        )
    if type(head) not in (DeterministicPolicy, CategoricalPolicy):
        raise UserError(
            f"format={format} knows squashed actions and choices; the policy of {name} is a {type(head).__name__}: "
            "format=saved_fn holds any policy"
        )
    own = group.of_member(policy.actors[g], k)  # that its index is a bias of, where it shares its actor
    params = {key: np.asarray(leaf, np.float32) for key, leaf in own.items()}
    layers = range(len(network.features))
    mean, deviation = normalization(layout, policy, agent) or (None, None)
    return Perceptron(
        space=group.action_space,
        slope=1.0 if group.algorithm.actor_output == "tanh" else 0.5,
        kernels=tuple(params[f"kernel_{layer}"] for layer in layers),
        biases=tuple(params[f"bias_{layer}"] for layer in layers),
        mean=mean,
        deviation=deviation,
    )


def normalization(layout: JointLayout, policy: PolicyParams, agent: int) -> tuple[np.ndarray, np.ndarray] | None:
    """Mean and deviation [observation size] by which an agent's observations are normalized; None: they are not."""
    if policy.statistics is None:
        return None
    own = Statistics(*(np.asarray(layout.observation_part(leaf, agent), np.float32) for leaf in policy.statistics))
    return own.mean, np.sqrt(own.variance + np.float32(LEAST_VARIANCE))
