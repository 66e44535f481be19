"""What training carries from iteration to iteration, and what it begins with."""

from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp

from matd3_jax.core import acting, q_bias, rollout, running_statistics, update
from matd3_jax.core.agents import JointLayout
from matd3_jax.core.q_bias import Reservoir
from matd3_jax.core.rollout import EnvState, Episodes
from matd3_jax.core.running_statistics import Statistics
from matd3_jax.core.update import GroupState, UpdateMetrics
from matd3_jax.envs.environment import Environment


class TrainState(NamedTuple):
    """Everything that training carries; leading axis [seeds] but for `rollouts`."""

    groups: tuple[GroupState, ...]
    env: EnvState
    replay: chex.Array
    """[seeds, capacity, row_size]"""
    key: chex.PRNGKey
    rollouts: chex.Array
    """int32 scalar: rollouts done, warm-up included. Steps, updates and the replay's cursor follow from it."""
    statistics: Statistics | None = None
    """Of the observations in all rollouts; None where they are not normalized."""
    reservoir: Reservoir | None = None
    """What the critics are judged on (see `q_bias`); None where they are not. `since` has no axis [seeds]."""
    earlier: chex.Array | None = None
    """[seeds] how many rollouts the statistics were made of when the run began; None where it began without any."""
    stopped: chex.Array | None = None
    """[seeds] whether a seed has diverged and learns no more; None where such seeds continue (see `stopping`)."""


class Metrics(NamedTuple):
    """Of one interval: leading axes [seeds, iterations]."""

    episodes: Episodes
    """Sums over the episodes that ended in the iteration."""
    update: UpdateMetrics
    """Means over the updates of the iteration (actor_loss over those that moved the actor)."""


def prefix(
    seeds: Any, everywhere: Any, normalize: bool, reservoir: bool, earlier: bool = False, stops: bool = False
) -> TrainState:
    """Make a prefix tree of the state: `seeds` for leaves with the axis [seeds], `everywhere` for those without."""
    statistics = seeds if normalize else None
    kept = Reservoir(seeds, everywhere) if reservoir else None
    rollouts, stopped = (seeds if there else None for there in (earlier, stops))
    return TrainState(seeds, seeds, seeds, seeds, everywhere, statistics, kept, rollouts, stopped)


def initial(
    env: Environment,
    layout: JointLayout,
    num_envs: int,
    normalize: bool,
    q_bias_pairs: int,
    earlier: bool,
    stops: bool,
    keys: chex.PRNGKey,
) -> TrainState:
    """Begin the runs of `keys` [seeds], with an empty replay.

    Args:
        normalize: with running statistics of the observations.
        q_bias_pairs: states and actions that the reservoir has room for; 0: there is none.
        earlier: with a place for how many rollouts given statistics were made of.
        stops: with a place for which seeds have stopped.
    """

    def one(key):
        network_key, env_key, key = jax.random.split(key, 3)
        networks = update.init(layout, network_key)
        return networks, rollout.start(env, env_key, num_envs, acting.ranged(layout), layout.state_size), key

    groups, envs, keys = jax.vmap(one)(keys)
    state = TrainState(groups, envs, jnp.zeros((keys.shape[0], 0, 0)), keys, jnp.int32(0))
    if q_bias_pairs:
        pairs = jax.vmap(lambda s: q_bias.allocate(s, q_bias_pairs, layout))(envs.state)
        state = state._replace(reservoir=Reservoir(pairs, jnp.int32(0)))
    if earlier:
        state = state._replace(earlier=jnp.zeros(keys.shape[0]))
    if stops:
        state = state._replace(stopped=jnp.zeros(keys.shape[0], bool))
    if not normalize:
        return state
    fresh = running_statistics.initial(layout.observation_size)
    spread = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (keys.shape[0], *leaf.shape)), fresh)
    return state._replace(statistics=spread)


def networks_finite(state: TrainState) -> chex.Array:
    """[seeds] whether networks, targets and optimizers of a seed have finite numbers only."""
    return _finite(state.groups)


def all_finite(tree: chex.ArrayTree) -> chex.Array:
    """Whether all numbers of a tree are finite, a scalar."""
    return jnp.stack([jnp.isfinite(leaf).all() for leaf in jax.tree.leaves(tree)]).all()


_finite = jax.jit(jax.vmap(all_finite))
