"""n-step returns: consecutive rows of one environment made into the row of one long step.

y = sum_k gamma^k r_{t+k} + gamma^m Q'(x_{t+m}), k < m <= n (Sutton and Barto, eq. 7.1; in actor-critics with a replay:
Barth-Maron et al. 2018), not corrected for actions that the present policies would not take. The sum ends with the
episode: m < n then, and Q' counts after a truncation (from the true last observation) but not after a termination. It
also ends with the newest row of its environment: a shorter return is as right as a longer one, and so no row has to
wait until its successors are there.
"""

import dataclasses

import chex
import jax
import jax.numpy as jnp

from matd3_jax import replay
from matd3_jax.spec import RowParts, Spec


def gather(
    spec: Spec, rows: chex.Array, seed: chex.Array, indices: chex.Array, written: replay.Written, num_envs: int
) -> chex.Array:
    """The n_step rows that begin at each of `indices`: [*indices.shape, n_step, row_size].

    Their goes_on is also 0 where the next row is not in the replay: rows after a 0 mean nothing.
    """
    numbers, there = replay.successors(written, indices, num_envs, spec.n_step)
    found = replay.gather(rows, seed, numbers)
    return found.at[..., :-1, -1].multiply(there[..., 1:])


def fold(steps: RowParts, gamma: chex.Array) -> RowParts:
    """One row of each n_step consecutive ones, parts [..., n_step, size] to [..., size]: x and actions of the first,
    the discounted sum of rewards, x' of the last that counts, and discount gamma^(m - 1) (1 - terminated), so that as
    with a single step y = reward + gamma discount Q'(x')."""
    assert steps.goes_on is not None
    n = steps.goes_on.shape[-1]
    reward, next_x, discount = steps.reward[..., -1, :], steps.next_x[..., -1, :], steps.discount[..., -1]
    for k in reversed(range(n - 1)):
        goes_on = steps.goes_on[..., k] > 0
        reward = steps.reward[..., k, :] + jnp.where(goes_on[..., None], gamma * reward, 0)
        next_x = jnp.where(goes_on[..., None], next_x, steps.next_x[..., k, :])
        discount = jnp.where(goes_on, gamma * discount, steps.discount[..., k])
    first = jax.tree.map(lambda part: part[..., 0, :], dataclasses.replace(steps, discount=None, goes_on=None))
    return dataclasses.replace(first, reward=reward, next_x=next_x, discount=discount)
