"""Act in the environment: collect transitions for the replay, and evaluate policies. For one seed; `vmap` for more."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np

from matd3_jax.core import frozen, gru, running_statistics
from matd3_jax.core.agents import Group, JointLayout
from matd3_jax.core.algorithm import HyperParams
from matd3_jax.core.frozen import Scale
from matd3_jax.core.running_statistics import Statistics
from matd3_jax.envs.environment import Environment

APART = 2**31 - 1
"""Folded into a key whose `split` and other `fold_in` never get that far."""


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


class EnvState(NamedTuple):
    """The environments of one seed, mid-episode; leading axis [num_envs]."""

    state: Any
    observation: tuple[chex.Array, ...]
    episode_return: chex.Array
    """[num_envs, num_agents] reward gathered so far in the running episodes."""
    episode_step: chex.Array
    """[num_envs] env steps so far in the running episodes."""
    noise_quantile: chex.Array | None = None
    """[num_envs, num_agents] uniform on [0, 1): where in its range each agent's exploration noise is in the running
    episode. None where no agent has a range (see `ranged`)."""
    recurrent: chex.Array | None = None
    """[num_envs, state_size] states of the actors. None where there are none (`JointLayout.state_size`)."""


class Episodes(NamedTuple):
    """Sums over the episodes that ended in a rollout."""

    count: chex.Array
    episode_return: chex.Array
    """[num_agents] undiscounted."""
    length: chex.Array


class Evaluation(NamedTuple):
    """Whole episodes, each played in an environment of its own."""

    episode_return: chex.Array
    """[episodes, num_agents] undiscounted."""
    length: chex.Array
    """[episodes] env steps."""
    measures: chex.Array
    """[episodes, measures] of the environment (`Environment.measures`), means over the env steps of the episode."""


def start(
    env: Environment, key: chex.PRNGKey, num_envs: int, noise_range: bool = False, state_size: int = 0
) -> EnvState:
    """Fresh episodes in `num_envs` environments; `noise_range`: with noise quantiles; `state_size`: with states of the
    actors."""
    state, observation = jax.vmap(env.reset)(jax.random.split(key, num_envs))
    shape = (num_envs, len(env.agents))
    quantile = jax.random.uniform(jax.random.fold_in(key, APART), shape) if noise_range else None
    recurrent = jnp.zeros((num_envs, state_size)) if state_size else None
    return EnvState(state, observation, jnp.zeros(shape), jnp.zeros(num_envs, jnp.int32), quantile, recurrent)


def ranged(layout: JointLayout) -> bool:
    """Whether an agent's exploration noise is drawn from a range."""
    return any(algorithm.noise_range and not algorithm.frozen for algorithm in layout.algorithms)


def collect(
    env: Environment,
    layout: JointLayout,
    policy: PolicyParams,
    env_state: EnvState,
    key: chex.PRNGKey,
    length: int,
    random: bool = False,
    keep_states: bool = False,
    unroll: int = 1,
) -> tuple[EnvState, chex.Array, Episodes, Any]:
    """Play `length` steps in every environment with the exploring policies; episodes that end are followed by others.

    Returns the environments, the replay rows [length * num_envs, row_size] (the true next observation in them, also
    where an episode ended), what ended on the way, and the state of the environment before each row's action, leading
    axis [length * num_envs] (None unless `keep_states`).

    random: act uniformly at random instead, but for frozen teams: warm-up without the policies. unroll: steps that one
    iteration holds.
    """
    num_envs, on_demand = env_state.episode_step.shape[0], env.on_host or env.costly_reset
    noise_key, step_key, reset_key = jax.random.split(key, 3)
    # All noise of the rollout in one draw for each group, not one for each step.
    noise = _noise(layout, noise_key, (length, num_envs), random)

    def step(carry: EnvState, inputs):
        draws, step_keys, fresh, fresh_quantile = inputs
        before = carry.state if keep_states else None
        quantile = 0.5 if carry.noise_quantile is None else carry.noise_quantile
        action = act(layout, policy, carry.observation, draws, quantile, random, carry.recurrent)
        recurrent = remember(layout, policy, carry.observation, action, carry.recurrent)
        if on_demand:
            after, *fresh = jax.vmap(env.step_or_reset)(step_keys, fresh, carry.state, env_actions(layout, action))
        else:
            after = jax.vmap(env.step)(step_keys, carry.state, env_actions(layout, action))
        x, next_x = (jnp.concatenate(o, axis=-1) for o in (carry.observation, after.observation))
        rows = layout.pack_rows(x, action, after.reward, next_x, after.terminated, after.truncated, carry.recurrent)
        returns = carry.episode_return + after.reward
        steps = carry.episode_step + 1
        ended = after.terminated | after.truncated
        episodes = Episodes(
            ended.sum(), jnp.where(ended[:, None], returns, 0).sum(axis=0), jnp.where(ended, steps, 0).sum()
        )
        state, observation, quantile = jax.tree.map(
            lambda new, old: jnp.where(ended.reshape(ended.shape + (1,) * (old.ndim - 1)), new, old),
            (*fresh, fresh_quantile),
            (after.state, after.observation, carry.noise_quantile),
        )
        returns, steps = jnp.where(ended[:, None], 0, returns), jnp.where(ended, 0, steps)
        if recurrent is not None:
            recurrent = jnp.where(ended[:, None], 0, recurrent)
        carry = EnvState(state, observation, returns, steps, quantile, recurrent)
        return carry, (rows, episodes, before)

    step_keys, reset_keys = (jax.random.split(k, (length, num_envs)) for k in (step_key, reset_key))
    # Every step has a fresh start at hand, drawn in one batch: inside the loop they would be as many, drawn one by one.
    # Not on the host, nor where a reset is costly: there they are made where they are needed.
    fresh = reset_keys if on_demand else jax.vmap(jax.vmap(env.reset))(reset_keys)
    fresh_quantiles = None
    if env_state.noise_quantile is not None:
        shape = (length, *env_state.noise_quantile.shape)
        fresh_quantiles = jax.random.uniform(jax.random.fold_in(noise_key, APART), shape)
    inputs = (noise, step_keys, fresh, fresh_quantiles)
    env_state, (rows, episodes, states) = jax.lax.scan(step, env_state, inputs, unroll=unroll)
    rows, states = jax.tree.map(lambda leaf: leaf.reshape(length * num_envs, *leaf.shape[2:]), (rows, states))
    return env_state, rows, jax.tree.map(lambda e: e.sum(axis=0), episodes), states


def evaluate(
    env: Environment,
    layout: JointLayout,
    policy: PolicyParams,
    key: chex.PRNGKey,
    episodes: int,
    deterministic: bool,
) -> Evaluation:
    """Play `episodes` whole episodes side by side with one policy for all agents; stops as soon as all have ended.

    deterministic: no noise at all (softmax of the logits, likeliest choice, squashed output); otherwise the policies
    act as they do while collecting.
    """

    def choose(key, state, observation, recurrent):
        return decide(layout, policy, observation, None if deterministic else key, recurrent)

    return play(env, choose, key, episodes, fresh_state(layout, episodes))


def play(env: Environment, choose: Callable, key: chex.PRNGKey, episodes: int, recurrent: Any = None) -> Evaluation:
    """Play `episodes` whole episodes side by side; stops as soon as all have ended.

    Args:
        choose: (key, states, observations, states of the actors) -> (actions, states of the actors), as
            `Environment.reset` gives and `Environment.step` takes them but with a leading axis [episodes].
        recurrent: the states of the actors at the start.
    """
    state_key, step_key = jax.random.split(key)
    step_keys = jax.random.split(step_key, env.episode_length)
    env_state = start(env, state_key, episodes)

    def going(carry):
        t, _, _, running = carry
        return (t < env.episode_length) & running.any()

    def step(carry):
        t, env_state, measured, running = carry
        act_key, env_key = jax.random.split(step_keys[t])
        actions, recurrent = choose(act_key, env_state.state, env_state.observation, env_state.recurrent)
        after = jax.vmap(env.step)(jax.random.split(env_key, episodes), env_state.state, actions)
        measured += jnp.where(running[:, None], jax.vmap(env.measure)(after.state), 0)
        env_state = EnvState(
            after.state,
            after.observation,
            env_state.episode_return + jnp.where(running[:, None], after.reward, 0),
            env_state.episode_step + running,
            recurrent=recurrent,
        )
        return t + 1, env_state, measured, running & ~(after.terminated | after.truncated)

    env_state = env_state._replace(recurrent=recurrent)
    carry = (jnp.int32(0), env_state, jnp.zeros((episodes, len(env.measures))), jnp.ones(episodes, bool))
    _, env_state, measured, _ = jax.lax.while_loop(going, step, carry)
    return Evaluation(env_state.episode_return, env_state.episode_step, measured / env_state.episode_step[:, None])


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
    draws = None if key is None else _noise(layout, key, observation[0].shape[:1])
    action = act(layout, policy, observation, draws, recurrent=recurrent)
    return env_actions(layout, action), remember(layout, policy, observation, action, recurrent)


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


def remember(
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


def _noise(
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
