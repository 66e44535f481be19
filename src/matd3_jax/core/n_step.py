"""n-step returns: rows that follow each other in one environment, drawn as the row of one long step.

y = sum_{k < m} gamma^k r_{t+k} + gamma^m Q'(x_{t+m}), m <= n (Sutton and Barto 2018, eq. 7.1; in actor-critics with a
replay: Barth-Maron et al. 2018), not corrected for actions that the present policies would not take. The sum ends with
the episode: m < n then, and Q' counts after a truncation (from the true last observation) but not after a termination.
It also ends with the newest row of its environment: a shorter return is as right as a longer one, and so no row has to
wait until its successors are there.
"""

import chex
import jax.numpy as jnp

from matd3_jax.core import replay
from matd3_jax.core.agents import JointLayout


def draw(
    layout: JointLayout,
    rows: chex.Array,
    seed: chex.Array | int,
    indices: chex.Array,
    written: replay.Written,
    num_envs: int,
    gamma: chex.Array,
) -> chex.Array:
    """Rows [*indices.shape, row_size] of the returns that begin at the rows `indices` of a seed.

    x and actions are those of the first row, x' and discount those of the last that counts; an agent's reward is the
    discounted sum of its rewards, `more` is m - 1.

    Args:
        rows: the replay [seeds, capacity, row_size].
        gamma: of each agent, [num_agents].
    """
    numbers, there = replay.successors(written, indices, num_envs, layout.n_step)
    start = layout.observation_size + layout.action_size
    end = start + layout.num_agents
    # Of the rows after the first only these few numbers, and x' of the last: whole rows took as long as the update.
    found = replay.gather(rows, seed, numbers, slice(start, end + 1))
    reward, more = found[..., :-1], found[..., -1] > 0
    follow = jnp.cumprod(more[..., :-1] & there[..., 1:], axis=-1, dtype=jnp.int32)
    counts = jnp.concatenate([jnp.ones_like(follow[..., :1]), follow], axis=-1)
    powers = gamma ** jnp.arange(layout.n_step)[:, None]
    total = jnp.where(counts[..., None] > 0, powers * reward, 0).sum(axis=-2)
    steps = follow.sum(axis=-1)
    last = jnp.take_along_axis(numbers, steps[..., None], axis=-1)[..., 0]
    first = replay.gather(rows, seed, indices, slice(0, start))
    ending = replay.gather(rows, seed, last, slice(end + 1, layout.row_size))
    return jnp.concatenate([first, total, steps[..., None], ending], axis=-1, dtype=rows.dtype)
