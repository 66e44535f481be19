"""Agents of a kind with one actor and one set of critics together (`share_parameters=kind`), for one seed.

Gupta et al. 2017 (parameter sharing), with the index of the agent among those that share given to every network beside
what it reads (agent indication, Terry et al. 2020). The loss is the mean over the agents of their own losses
(`losses`), as if one minibatch had the transitions of all of them; everybody learns at the same time.
"""

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

import chex
import jax
import jax.numpy as jnp

from matd3_jax.errors import UserError

if TYPE_CHECKING:
    from matd3_jax.core.group import Group


def network_of(params: chex.ArrayTree, k: chex.Array | int, agents: int) -> chex.ArrayTree:
    """Take the network of agent k out of a perceptron that `agents` agents share: it reads no index.

    The one-hot of k behind the inputs picks one row of the first kernel, which is added to the bias here: the same
    numbers as with the one-hot, gradients too, for fewer products.

    Args:
        params: leaves with any leading axes; the first kernel [..., inputs + agents, width].

    Raises:
        UserError: the networks are no perceptrons of the family's own.
    """
    if not isinstance(params, dict) or "kernel_0" not in params:
        raise UserError("share_parameters=kind knows perceptrons alone (core.networks.StackedMLP)")
    kernel, bias = params["kernel_0"], params["bias_0"]
    inputs = kernel.shape[-2] - agents
    return {**params, "kernel_0": kernel[..., :inputs, :], "bias_0": bias + kernel[..., inputs + k, :]}


def apart(group: "Group", params: chex.ArrayTree) -> chex.ArrayTree:
    """The networks of all members, leaves [seeds, members, ...], of parameters [seeds, networks, ...]."""
    if not group.shared:
        return params
    each = [network_of(params, k, group.index_size) for k in range(len(group.members))]
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves, axis=1), *each)


def mean_gradient(
    loss: Callable[[chex.ArrayTree, Any], tuple[chex.Array, chex.ArrayTree]],
    params: chex.ArrayTree,
    agents: Any,
    one_by_one: bool,
    unroll: bool,
) -> tuple[chex.ArrayTree, chex.ArrayTree]:
    """(gradient of the mean over the agents of their losses, the metrics of each).

    Args:
        loss: (params, one of the agents) -> (loss, metrics).
        agents: what each agent learns from, leading axis [agents].
        one_by_one: add the gradients up agent by agent instead of computing all in one batch.
        unroll: without a loop.
    """
    number = jax.tree.leaves(agents)[0].shape[0]
    if not one_by_one:

        def mean(params: chex.ArrayTree) -> tuple[chex.Array, chex.ArrayTree]:
            losses, metrics = jax.vmap(partial(loss, params))(agents)
            return losses.mean(), metrics

        return jax.grad(mean, has_aux=True)(params)

    def add(total: chex.ArrayTree, one: Any) -> tuple[chex.ArrayTree, chex.ArrayTree]:
        gradient, metrics = jax.grad(loss, has_aux=True)(params, one)
        return jax.tree.map(jnp.add, total, gradient), metrics

    zeros = jax.tree.map(jnp.zeros_like, params)
    total, metrics = jax.lax.scan(add, zeros, agents, unroll=number if unroll else 1)
    return jax.tree.map(lambda leaf: leaf / number, total), metrics
