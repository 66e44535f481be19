"""What policies do: actions from observations, their noise, and the states of recurrent actors. For one seed."""

from collections.abc import Sequence
from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np

from matd3_jax.core import frozen, gru, running_statistics
from matd3_jax.core.agents import JointLayout
from matd3_jax.core.algorithm import HyperParams
from matd3_jax.core.frozen import Scale
from matd3_jax.core.group import Group
from matd3_jax.core.running_statistics import Statistics


class PolicyParams(NamedTuple):
    """All that acting takes, of one seed."""

    actors: tuple[chex.ArrayTree, ...]
    """Parameters, one stack [networks, ...] per group."""
    hyper: tuple[HyperParams, ...]
    """One per group."""
    statistics: Statistics | None
    """What observations are normalized by; None: they are not."""
    scales: tuple[Scale | None, ...] = ()
    """One per group: what frozen groups normalize by, None for others; () where no group is frozen."""


def ranged(layout: JointLayout) -> bool:
    """Whether an agent's exploration noise is drawn from a range."""
    return any(algorithm.noise_range and not algorithm.frozen for algorithm in layout.algorithms)


def decide(
    layout: JointLayout,
    policy: PolicyParams,
    observation: Sequence[chex.Array],
    key: chex.PRNGKey | None,
    recurrent: chex.Array | None = None,
) -> tuple[tuple[chex.Array, ...], chex.Array | None]:
    """What each agent does, as `Environment.step` takes it with a leading axis [envs], for one observation
    [envs, size] per agent; and the states of the actors [envs, state_size] after it, where there are any.

    Args:
        key: of the noise; None: deterministic actions.
        recurrent: the states before.
    """
    draws = None if key is None else noise(layout, key, observation[0].shape[:1])
    action = act(layout, policy, observation, draws, recurrent=recurrent)
    return env_actions(layout, action), next_state(layout, policy, observation, action, recurrent)


def fresh_state(layout: JointLayout, envs: int) -> chex.Array | None:
    """States of the actors [envs, state_size] at the start of episodes; None where there are none."""
    return jnp.zeros((envs, layout.state_size)) if layout.recurrent else None


def act(
    layout: JointLayout,
    policy: PolicyParams,
    observation: Sequence[chex.Array],
    draws: Sequence[chex.Array | None] | None,
    noise_quantile: chex.Array | float = 0.5,
    random: bool = False,
    recurrent: chex.Array | None = None,
) -> chex.Array:
    """Joint actions [envs, action_size] for one observation [envs, size] per agent.

    Args:
        draws: noise [members, envs, action size] per group (see `Policy.noise`); None, for one group or all:
            deterministic actions. Frozen groups have none.
        noise_quantile: [envs, num_agents] where in its range the exploration noise of an agent that has one is;
            outside of collecting the middle.
        random: the draws are whole actions.
        recurrent: states of the actors [envs, state_size], where there are any.
    """
    parts, raw, observation = [], observation, _normalized(layout, policy, observation)
    for g, group in enumerate(layout.groups):
        if group.frozen:
            seen = jnp.stack([raw[i] for i in group.members])
            scale = policy.scales[g]
            assert scale is not None
            parts.append(group.policy.mode(frozen.outputs(group, policy.actors[g], scale, seen)))
            continue
        if random:
            assert draws is not None and draws[g] is not None
            parts.append(draws[g])
            continue
        stacked = jnp.stack([observation[i] for i in group.members])
        if group.recurrent:
            stacked = jnp.concatenate([stacked, _states(layout, group, recurrent)], axis=-1)
        output = group.outputs(policy.actors[g], stacked)
        draw = None if draws is None else draws[g]
        sigma = policy.hyper[g].exploration_noise
        if group.algorithm.noise_range:
            quantile = jnp.broadcast_to(noise_quantile, (stacked.shape[1], layout.num_agents))
            own = quantile[:, np.array(group.members)].T[..., None]
            sigma = sigma + own * (policy.hyper[g].exploration_noise_high - sigma)
        parts.append(group.policy.sample(output, draw, sigma))
    return layout.join_actions(parts)


def next_state(
    layout: JointLayout,
    policy: PolicyParams,
    observation: Sequence[chex.Array],
    action: chex.Array,
    recurrent: chex.Array | None,
) -> chex.Array | None:
    """The states of the actors [envs, state_size] after these observations, one [envs, size] per agent, and joint
    actions [envs, action_size]; None where there are none."""
    if recurrent is None:
        return None
    observation, parts = _normalized(layout, policy, observation), []
    for group, params in zip(layout.groups, policy.actors, strict=True):
        if not group.recurrent:
            parts.append(jnp.zeros((len(group.members), *recurrent.shape[:-1], 0)))
            continue
        seen = [jnp.concatenate([observation[i], layout.action_part(action, i)], axis=-1) for i in group.members]
        parts.append(gru.step(params[gru.PARAMS], _states(layout, group, recurrent), jnp.stack(seen)))
    return layout.join_actions(parts)


def _states(layout: JointLayout, group: Group, recurrent: chex.Array | None) -> chex.Array:
    """Those of a group's actors, [members, envs, units]."""
    assert recurrent is not None
    return jnp.stack([layout.state_part(recurrent, i) for i in group.members])


def _normalized(layout: JointLayout, policy: PolicyParams, observation: Sequence[chex.Array]) -> Sequence[chex.Array]:
    """Observations, one [envs, size] per agent, as networks see them."""
    statistics = policy.statistics
    if statistics is None:
        return observation
    return [running_statistics.normalize_part(layout, statistics, o, i) for i, o in enumerate(observation)]


def env_actions(layout: JointLayout, action: chex.Array) -> tuple[chex.Array, ...]:
    """What `Environment.step` takes, of joint action vectors [..., action_size]."""
    return tuple(layout.policy(i).to_env(layout.action_part(action, i)) for i in range(layout.num_agents))


def noise(
    layout: JointLayout, key: chex.PRNGKey, shape: tuple[int, ...], random: bool = False
) -> tuple[chex.Array | None, ...]:
    """Noise [*shape[:-1], members, shape[-1], action size] of every group, None of frozen ones; `random`: whole random
    actions instead."""
    return tuple(
        None
        if group.frozen
        else (group.policy.random if random else group.policy.noise)(
            jax.random.fold_in(key, g), (*shape[:-1], len(group.members), shape[-1])
        )
        for g, group in enumerate(layout.groups)
    )
