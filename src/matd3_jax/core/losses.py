"""The equations of the paper: target, critic loss and actor loss of one agent, for one seed.

Symbols (section 4): x joint observation, o_i agent i's part, a joint action, mu actor, Q critic, primes targets. With
one critic and no smoothing these are MADDPG's (Lowe et al. 2017); with the observation and action of the agent alone
TD3's and DDPG's (Fujimoto et al. 2018); with the others' actions moved against the agent (`worst_case`) M3DDPG's (Li
et al. 2019).
"""

from collections.abc import Callable, Sequence
from functools import partial

import chex
import jax
import jax.numpy as jnp

from matd3_jax.core import gru
from matd3_jax.core.agents import JointLayout
from matd3_jax.core.algorithm import HyperParams
from matd3_jax.core.group import Group
from matd3_jax.core.gru import History
from matd3_jax.core.minibatch import Minibatch, Noise
from matd3_jax.core.networks import apply

SMALLEST_SLOPE = 1e-12
"""Gradients with a smaller norm are divided by this instead: none at all (dead ReLUs) moves nothing."""


def td_target(
    layout: JointLayout,
    group: Group,
    hyper: HyperParams,
    critic_target: chex.ArrayTree,
    batch: Minibatch,
    next_action: chex.Array,
    chosen: chex.Array | None = None,
) -> chex.Array:
    """y_i = r_i + gamma min_j Q'_ij(x', a'_1, ..., a'_N), with a' = mu'(o') + epsilon from `target_actions`.

    Adversarial: the others' a' moved against what the target takes, min_j Q'_ij. Returns what the critics' loss takes,
    leading axis [batch]. Where an episode terminated y_i = r_i.

    Args:
        chosen: numbers [target_critics] of the critics j that the minimum is over (REDQ, Chen et al. 2021); None: all.
    """
    next_inputs = jnp.concatenate([batch.next_x, next_action], axis=-1)
    critic = group.target_critic
    if chosen is not None:
        critic_target = jax.tree.map(lambda leaf: leaf[chosen], critic_target)
    next_inputs = with_states(layout, critic_target, next_inputs, batch.critic_history, after=True)
    if group.algorithm.adversarial:
        least = partial(critic.target_value, critic_target)
        next_inputs = worst_case(layout, hyper, least, next_inputs, batch.action_column)
    scale = group.algorithm.reward_scale
    reward = batch.reward if scale == 1 else scale * batch.reward
    return critic.target(critic_target, reward, hyper.gamma * batch.discount, next_inputs)


def target_actions(
    layout: JointLayout,
    group: Group,
    hyper: HyperParams,
    mu_targets: Sequence[chex.ArrayTree],
    own_target: chex.ArrayTree,
    batch: Minibatch,
    noise: Noise,
) -> chex.Array:
    """a'_j = mu'_j(o'_j) + epsilon, epsilon = clip(N(0, sigma), -c, c) with smoothing, one sample for all critics of an
    agent: [batch, action size], of all agents for central critics, else of the agent itself. Of frozen teams what they
    will do: their policy, without epsilon."""
    central = group.algorithm.central
    others = zip(layout.groups, mu_targets, strict=True) if central else [(group, own_target)]
    parts = []
    for j, (other, params) in enumerate(others):
        if other.frozen:
            parts.append(batch.frozen_next[j])
            continue
        seen, history = batch.next_observations[j], batch.histories[j] if batch.histories else None
        seen = with_states(layout, params, seen, history, after=True)
        output = other.outputs(params, seen) if central else apply(group.actor, params, seen)
        part = other.policy.sample(output, noise.target[j])
        draw = noise.smoothing[j]
        if draw is not None:
            part = other.policy.smooth(part, draw, hyper.target_noise, hyper.target_noise_clip)
        parts.append(part)
    return layout.join_actions(parts) if central else parts[0]


def critic_loss(
    layout: JointLayout, group: Group, params: chex.ArrayTree, batch: Minibatch, target: chex.Array
) -> tuple[chex.Array, tuple[chex.Array, chex.Array]]:
    """sum_j mean (Q_ij(x, a_1, ..., a_N) - y_i)^2, or what another head has in its place; also (its mean over the
    critics j, mean Q_i1)."""
    loss, value = group.critic.loss(params, critic_inputs(layout, params, batch), target)
    return loss.sum(), (loss.mean(), value.mean())


def actor_loss(
    layout: JointLayout,
    group: Group,
    hyper: HyperParams,
    params: chex.ArrayTree,
    critic: chex.ArrayTree,
    batch: Minibatch,
    noise: Noise,
) -> tuple[chex.Array, chex.Array]:
    """-mean Q_i1(x, a_1, ..., mu_i(o_i), ..., a_N) + regularizer * mean mu_i's output^2, the others' actions from the
    replay, adversarial: moved against Q_i1 there; twice, as value and as metric. Q_i1: or the mean over the critics
    (`actor_critics`)."""
    output = apply(group.actor, params, with_states(layout, params, batch.observation, batch.history))
    action = group.policy.sample(output, noise.action)
    if batch.critic_history is not None:  # states of those critics alone
        critic = jax.tree.map(lambda leaf: leaf[: group.algorithm.critics_climbed], critic)
    inputs, change = critic_inputs(layout, critic, batch), action - batch.action
    if group.algorithm.adversarial:

        def climbed(inputs: chex.Array) -> chex.Array:
            return group.critic.value(critic, inputs, jax.lax.stop_gradient(change), batch.action_column)

        inputs = worst_case(layout, hyper, climbed, inputs, batch.action_column)
    q = group.critic.value(critic, inputs, change, batch.action_column)
    loss = -q.mean() + hyper.logit_regularizer * jnp.mean(jnp.square(output))
    return loss, loss


def critic_inputs(layout: JointLayout, params: chex.ArrayTree, batch: Minibatch) -> chex.Array:
    """What critics with these parameters read of a minibatch: [batch, inputs], or [critics, batch, inputs] where each
    has states of its own."""
    return with_states(layout, params, batch.inputs, batch.critic_history)


def with_states(
    layout: JointLayout, params: chex.ArrayTree, inputs: chex.Array, history: History | None, after: bool = False
) -> chex.Array:
    """`inputs` [..., batch, inputs] with the states of the network with these parameters beside them, those before each
    step or after it; as they are without a history."""
    if history is None:
        return inputs
    return gru.beside(inputs, gru.states(params[gru.PARAMS], history, layout.burn_in)[after])


def worst_case(
    layout: JointLayout,
    hyper: HyperParams,
    value: Callable[[chex.Array], chex.Array],
    inputs: chex.Array,
    own_column: chex.Array | int,
) -> chex.Array:
    """The `inputs` of a central critic after one step of every other agent against the one that acts at `own_column`:
    a_j - alpha_j g_j / |g_j| with g_j = d value / d a_j, for each row [batch] by itself (Li et al. 2019, multi-agent
    adversarial learning; the length as in their program).

    alpha_j is `adversarial_step_team` for agents of the same team and `adversarial_step` for all others, frozen ones
    too; of Box actions in half ranges, and they stay within their bounds. A constant to whoever differentiates.
    """
    assert hyper.adversarial_step is not None and hyper.adversarial_step_team is not None
    x, action = jnp.split(inputs, [layout.observation_size], axis=-1)
    slope = jax.grad(lambda inputs: value(inputs).sum())(inputs)[..., layout.observation_size :]
    own = layout.observation_size + jnp.array(layout.action_starts) == own_column
    same_team = jnp.array([[one == other for other in layout.teams] for one in layout.teams])
    team = (own[:, None] & same_team).any(axis=0)
    steps = jnp.where(team, hyper.adversarial_step_team, hyper.adversarial_step)
    moved = []
    for j in range(layout.num_agents):
        part, gradient = layout.action_part(action, j), layout.action_part(slope, j)
        norm = jnp.linalg.norm(gradient, axis=-1, keepdims=True)
        shifted = layout.policy(j).shift(part, -steps[j] * gradient / jnp.maximum(norm, SMALLEST_SLOPE))
        moved.append(jnp.where(own[j], part, shifted))
    return jax.lax.stop_gradient(jnp.concatenate([x, *moved], axis=-1))
