"""Gated recurrent units, stacked like the perceptrons, and what recurrent networks are trained on: sequences.

An agent's history up to step t are o_0, a_0, ..., o_{t-1}, a_{t-1}. Its state h_t sums it up, h_{t+1} = GRU(h_t; o_t,
a_t) from h_0 = 0 where an episode begins, and the perceptrons of `networks` read h_t beside what they read anyhow:
actors o_i, critics x and a (then the history is that of x and all actions, or of the agent's own). Actors keep their
states while they act, and the replay keeps them with every transition; sequences begin with those, and with some steps
that only bring them up to date (stored state with burn-in, Kapturowski et al. 2019). Critics begin with zeros there.
"""

import math
from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp

from matd3_jax.core.networks import product

PARAMS = "gru"
"""Where they are among the parameters of a network."""


class History(NamedTuple):
    """What GRUs read of sequences of transitions; axes [*stack, sequences, steps, ...], or none of the stack."""

    inputs: chex.Array
    """[..., sequences, steps, inputs] observation and action of each step."""
    more: chex.Array
    """[sequences, steps] 0 where the episode ended with the step, or 1."""
    start: chex.Array | None = None
    """[..., sequences, units] states before the first step; None: zeros."""


def init(key: chex.PRNGKey, stack: tuple[int, ...], inputs: int, units: int) -> chex.ArrayTree:
    """Draw fresh parameters with leading axes `stack`, three gates side by side: update, reset, candidate.

    Kernels are uniform within 1 / sqrt(units), PyTorch's way; biases zero. Orthogonal kernels would need a
    factorization, for which XLA's threads on a CPU can wait forever (see `thread_pool`).
    """
    input_key, own_key = jax.random.split(key)
    bound = 1 / math.sqrt(units)

    def uniform(key: chex.PRNGKey, rows: int) -> chex.Array:
        return jax.random.uniform(key, (*stack, rows, 3 * units), minval=-bound, maxval=bound)

    return {
        "kernel": uniform(input_key, inputs),
        "bias": jnp.zeros((*stack, 3 * units)),
        "recurrent_kernel": uniform(own_key, units),
        "candidate_bias": jnp.zeros((*stack, units)),
    }


def step(params: chex.ArrayTree, state: chex.Array, inputs: chex.Array) -> chex.Array:
    """The states [*stack, batch, units] after one step. inputs: [*stack, batch, inputs]."""
    return _step(params, state, _projected(params, inputs))


def states(params: chex.ArrayTree, history: History, burn_in: int) -> tuple[chex.Array, chex.Array]:
    """States before and after each step but the first `burn_in` ones, [*stack, sequences * steps, units] each.

    Gradients go back through all of these steps, and not into the first ones.
    """
    start = history.start
    if burn_in:
        first = History(history.inputs[..., :burn_in, :], history.more[:, :burn_in], start)
        start, _ = _unrolled(params, first)
        start = jax.lax.stop_gradient(start)
    _, found = _unrolled(params, History(history.inputs[..., burn_in:, :], history.more[:, burn_in:], start))
    before, after = (jnp.moveaxis(leaf, 0, -2) for leaf in found)
    stack = before.shape[:-3]
    return before.reshape(*stack, -1, before.shape[-1]), after.reshape(*stack, -1, after.shape[-1])


def beside(inputs: chex.Array, state: chex.Array) -> chex.Array:
    """What a perceptron reads, [..., batch, inputs + units]; inputs may lack axes of the state's stack."""
    return jnp.concatenate([jnp.broadcast_to(inputs, (*state.shape[:-1], inputs.shape[-1])), state], axis=-1)


def multiplications(inputs: int, units: int) -> int:
    """Of one step of one network, in matrix products."""
    return 3 * units * (inputs + units)


def slopes(inputs: int, units: int) -> int:
    """Multiplications of the gradients of one step: of the kernels, and of the state before."""
    return multiplications(inputs, units) + 3 * units * units


def _unrolled(params: chex.ArrayTree, history: History) -> tuple[chex.Array, tuple[chex.Array, chex.Array]]:
    """The states [*stack, sequences, units] after the last step, 0 where the episode ended with it; and those before
    and after each step, [steps, *stack, sequences, units]."""
    *lead, sequences, length, size = history.inputs.shape
    projected = _projected(params, history.inputs.reshape(*lead, sequences * length, size))
    stack = projected.shape[:-2]
    by_step = jnp.moveaxis(projected.reshape(*stack, sequences, length, -1), -2, 0)
    start = jnp.zeros((*stack, sequences, by_step.shape[-1] // 3)) if history.start is None else history.start

    def one(state: chex.Array, inputs: tuple[chex.Array, chex.Array]) -> tuple[chex.Array, tuple]:
        part, more = inputs
        after = _step(params, state, part)
        return after * more[:, None], (state, after)

    return jax.lax.scan(one, start, (by_step, history.more.T))


def _projected(params: chex.ArrayTree, inputs: chex.Array) -> chex.Array:
    """What all steps need of the inputs [..., batch, inputs], in one product: [*stack, batch, 3 * units]."""
    return product(inputs, params["kernel"]) + params["bias"][..., None, :]


def _step(params: chex.ArrayTree, state: chex.Array, projected: chex.Array) -> chex.Array:
    recurrent = state @ params["recurrent_kernel"]
    (z, r, n), (own_z, own_r, own_n) = (jnp.split(part, 3, axis=-1) for part in (projected, recurrent))
    update, reset = jax.nn.sigmoid(z + own_z), jax.nn.sigmoid(r + own_r)
    candidate = jnp.tanh(n + reset * (own_n + params["candidate_bias"][..., None, :]))
    return (1 - update) * candidate + update * state
