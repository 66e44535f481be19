"""Overestimation measured: the critics' estimates compared with the true discounted returns (PAPER section 3).

A reservoir keeps states and joint actions collected since the last evaluation, each with the whole state of its
environment. From there the true value is played out: the stored action, then the policies as they are now. For one
seed; `vmap` for more.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp

from matd3_jax.core import acting, running_statistics
from matd3_jax.core.acting import PolicyParams
from matd3_jax.core.agents import JointLayout
from matd3_jax.envs.environment import Environment


class Pairs(NamedTuple):
    """States and joint actions; leading axis [pairs]."""

    state: Any
    """Of the environments, before the action."""
    inputs: chex.Array
    """[pairs, observation_size + action_size] joint observation and joint action as in the replay."""


class Reservoir(NamedTuple):
    """Each pair is drawn uniformly, on its own, from all that was collected since the last evaluation."""

    pairs: Pairs
    since: chex.Array
    """int32 scalar: rollouts done at the last evaluation."""


class Values(NamedTuple):
    """Of each pair and agent: [pairs, num_agents]."""

    estimate: chex.Array
    """Q_i(x, a), mean over the agent's critics."""
    truth: chex.Array
    """Discounted sum of the agent's rewards, from the state and the action on; mean of the team's where it has one
    critic."""


def allocate(state: Any, size: int, layout: JointLayout) -> Pairs:
    """`size` pairs that hold nothing yet. state: of one seed's environments, leading axis [num_envs]."""
    states = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf[:1], (size, *leaf.shape[1:])), state)
    return Pairs(states, jnp.zeros((size, layout.observation_size + layout.action_size)))


def keep(pairs: Pairs, new: Pairs, share: chex.Array, key: chex.PRNGKey) -> Pairs:
    """`pairs` after one more rollout that brought `new`: each is replaced with probability `share`, by one of `new`
    drawn uniformly.

    share: of `new` in all that was collected since the last evaluation, `new` included; with that every pair is a
    uniform draw from all of it.
    """
    size, number = pairs.inputs.shape[0], new.inputs.shape[0]
    which_key, draw_key = jax.random.split(key)
    replaced = jax.random.uniform(which_key, (size,)) < share
    drawn = jax.random.randint(draw_key, (size,), 0, number)

    def one(old: chex.Array, new: chex.Array) -> chex.Array:
        return jnp.where(replaced.reshape(size, *[1] * (old.ndim - 1)), new[drawn], old)

    return jax.tree.map(one, pairs, new)


def measure(
    env: Environment,
    layout: JointLayout,
    policy: PolicyParams,
    critics: Sequence[chex.ArrayTree],
    pairs: Pairs,
    key: chex.PRNGKey,
    steps: int,
) -> Values:
    """What the critics (parameters, one stack per group) say of the pairs, and the true values (see `play_out`)."""
    estimates = estimate(layout, policy, critics, pairs.inputs)
    return Values(estimates, layout.team_mean(play_out(env, layout, policy, pairs, key, steps)))


def estimate(
    layout: JointLayout, policy: PolicyParams, critics: Sequence[chex.ArrayTree], inputs: chex.Array
) -> chex.Array:
    """Q_i(x, a) of every agent, mean over its critics, in the units of its rewards: [pairs, num_agents]; nan for those
    of frozen teams."""
    x, action = jnp.split(inputs, [layout.observation_size], axis=-1)
    if policy.statistics is not None:
        x = running_statistics.normalize(policy.statistics, x)
    values: list[Any] = [None] * layout.num_agents
    for g, group in enumerate(layout.groups):
        if group.frozen:
            for i in group.members:
                values[i] = jnp.full(inputs.shape[:-1], jnp.nan)
            continue
        for k, i in enumerate(group.members):
            parts = [x, action]
            if group.algorithm.critic == "own":
                parts = [layout.observation_part(x, i), layout.action_part(action, i)]
            params = critics[layout.critic_group(g)]
            own = jax.tree.map(lambda leaf: leaf[0], params) if group.team_critic else group.of_member(params, k)
            value = group.critic.values(own, jnp.concatenate(parts, axis=-1)).mean(axis=0)
            values[i] = value / group.algorithm.reward_scale
    return jnp.stack(values, axis=-1)


def play_out(
    env: Environment, layout: JointLayout, policy: PolicyParams, pairs: Pairs, key: chex.PRNGKey, steps: int
) -> chex.Array:
    """Discounted sum of each agent's rewards over `steps` env steps, [pairs, num_agents]: one rollout from each pair.

    First the stored action, then the policies that the critics' targets mean: choices sampled, Box actions without
    noise. Termination ends a rollout; a time limit does not, as targets bootstrap through it. Each agent's rewards are
    discounted with the gamma of its team.
    """
    _, action = jnp.split(pairs.inputs, [layout.observation_size], axis=-1)
    number = action.shape[0]
    step_key, noise_key = jax.random.split(key)
    gamma = jnp.stack([jnp.asarray(policy.hyper[layout.place(i)[0]].gamma) for i in range(layout.num_agents)])
    # All noise in one draw for each group, not one for each step; None for a Box.
    noise = tuple(
        None
        if group.frozen
        else group.policy.own_noise(jax.random.fold_in(noise_key, g), (steps, len(group.members), number))
        for g, group in enumerate(layout.groups)
    )

    def step(carry, inputs):
        state, action, going, discount, total = carry
        draws, keys = inputs
        after = jax.vmap(env.step)(keys, state, acting.env_actions(layout, action))
        total += jnp.where(going[:, None], discount * after.reward, 0)
        action = acting.act(layout, policy, after.observation, draws)
        return (after.state, action, going & ~after.terminated, discount * gamma, total), None

    carry = (
        pairs.state, action, jnp.ones(number, bool), jnp.ones(layout.num_agents), jnp.zeros((number, layout.num_agents))
    )  # fmt: skip
    (*_, total), _ = jax.lax.scan(step, carry, (noise, jax.random.split(step_key, (steps, number))))
    return total
