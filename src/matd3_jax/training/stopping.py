"""`on_divergence=stop_seed`: a seed that diverges keeps the networks that it had before, and learns no more."""

from collections.abc import Sequence

import chex
import jax
import jax.numpy as jnp

from matd3_jax.core.rollout import Episodes
from matd3_jax.core.update import UpdateMetrics
from matd3_jax.training.sharding import unstack
from matd3_jax.training.state import TrainState, all_finite, networks_finite


def stop_diverged(before: TrainState, after: TrainState, episodes: Episodes, metrics: UpdateMetrics) -> TrainState:
    """Put the networks and optimizers of seeds that have diverged back, and mark these seeds in `stopped`.

    Args:
        before, after: the state before and after a rollout and its updates; `groups` stacked, leaves [seeds, ...], or
            a list with those of each seed.
        episodes: of the rollout, leading axis [seeds].
        metrics: of its updates, [seeds, updates, learning agents].
    """
    finite = [jnp.isfinite(leaf) for leaf in (episodes.episode_return, metrics.critic_loss, metrics.q_value)]
    finite.append(~jnp.isinf(metrics.actor_loss))  # nan where an update left the actor alone
    sound = jnp.stack([_all(leaf) for leaf in finite]).all(axis=0)
    groups: list | tuple
    if isinstance(after.groups, list):
        networks = jnp.stack([all_finite(each) for each in after.groups])
        stopped = before.stopped | ~(sound & networks)  # type: ignore[operator]
        each = unstack(stopped, len(after.groups))
        groups = [_choose(*pair) for pair in zip(each, before.groups, after.groups, strict=True)]
    else:
        stopped = before.stopped | ~(sound & networks_finite(after))  # type: ignore[operator]
        groups = jax.vmap(_choose)(stopped, before.groups, after.groups)
    return after._replace(groups=groups, stopped=stopped)  # type: ignore[arg-type]


def _all(finite: chex.Array) -> chex.Array:
    return finite.reshape(finite.shape[0], -1).all(axis=1)


def _choose(stopped: chex.Array, before: chex.ArrayTree, after: chex.ArrayTree) -> chex.ArrayTree:
    return jax.tree.map(lambda old, new: jnp.where(stopped, old, new), before, after)


def of_agents(metrics: UpdateMetrics, agents: Sequence[int]) -> UpdateMetrics:
    """The numbers of some agents, the last axis."""
    return UpdateMetrics(*(leaf[..., jnp.array(agents)] for leaf in metrics))
