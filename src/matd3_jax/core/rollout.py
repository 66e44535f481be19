"""Act in the environment: collect transitions for the replay, and evaluate policies. For one seed; `vmap` for more."""

from collections.abc import Callable
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp

from matd3_jax.core import acting
from matd3_jax.core.acting import PolicyParams
from matd3_jax.core.agents import JointLayout
from matd3_jax.envs.environment import Environment

APART = 2**31 - 1
"""Folded into a key whose `split` and other `fold_in` never get that far."""


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
    episode. None where no agent has a range (see `acting.ranged`)."""
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
    noise = acting.noise(layout, noise_key, (length, num_envs), random)

    def step(carry: EnvState, inputs):
        draws, step_keys, fresh, fresh_quantile = inputs
        before = carry.state if keep_states else None
        quantile = 0.5 if carry.noise_quantile is None else carry.noise_quantile
        action = acting.act(layout, policy, carry.observation, draws, quantile, random, carry.recurrent)
        recurrent = acting.next_state(layout, policy, carry.observation, action, carry.recurrent)
        done = acting.env_actions(layout, action)
        if on_demand:
            after, *fresh = jax.vmap(env.step_or_reset)(step_keys, fresh, carry.state, done)
        else:
            after = jax.vmap(env.step)(step_keys, carry.state, done)
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
        return acting.decide(layout, policy, observation, None if deterministic else key, recurrent)

    return play(env, choose, key, episodes, acting.fresh_state(layout, episodes))


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
