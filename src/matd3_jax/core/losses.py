"""The equations of the paper: target, critic loss and actor loss of one agent, for one seed.

Symbols (section 4): x joint observation, o_i agent i's part, a joint action, mu actor, Q critic, primes targets. With
one critic and no smoothing these are MADDPG's (Lowe et al. 2017); with the observation and action of the agent alone
TD3's and DDPG's (Fujimoto et al. 2018).
"""

from collections.abc import Sequence

import chex
import jax.numpy as jnp

from matd3_jax.core.agents import Group, JointLayout
from matd3_jax.core.algorithm import HyperParams
from matd3_jax.core.minibatch import Minibatch, Noise
from matd3_jax.core.networks import apply


def td_target(
    group: Group, hyper: HyperParams, critic_target: chex.ArrayTree, batch: Minibatch, next_action: chex.Array
) -> chex.Array:
    """y_i = r_i + gamma min_j Q'_ij(x', a'_1, ..., a'_N), with a' = mu'(o') + epsilon from `target_actions`.

    Returns what the critics' loss takes, leading axis [batch]. Where an episode terminated y_i = r_i.
    """
    next_inputs = jnp.concatenate([batch.next_x, next_action], axis=-1)
    scale = group.algorithm.reward_scale
    reward = batch.reward if scale == 1 else scale * batch.reward
    return group.critic.target(critic_target, reward, hyper.gamma * batch.discount, next_inputs)


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
    central = group.algorithm.critic == "central"
    if central:
        others = [(other, params, other.actors) for other, params in zip(layout.groups, mu_targets, strict=True)]
    else:
        others = [(group, own_target, group.actor)]
    parts = []
    for j, (other, params, network) in enumerate(others):
        if other.frozen:
            parts.append(batch.frozen_next[j])
            continue
        part = other.policy.sample(apply(network, params, batch.next_observations[j]), noise.target[j])
        draw = noise.smoothing[j]
        if draw is not None:
            part = other.policy.smooth(part, draw, hyper.target_noise, hyper.target_noise_clip)
        parts.append(part)
    return layout.join_actions(parts) if central else parts[0]


def critic_loss(
    group: Group, params: chex.ArrayTree, batch: Minibatch, target: chex.Array
) -> tuple[chex.Array, tuple[chex.Array, chex.Array]]:
    """sum_j mean (Q_ij(x, a_1, ..., a_N) - y_i)^2, or the critics' cross-entropy to the target distribution; also (its
    mean over the critics j, mean Q_i1)."""
    loss, value = group.critic.loss(params, batch.inputs, target)
    return loss.sum(), (loss.mean(), value.mean())


def actor_loss(
    group: Group, hyper: HyperParams, params: chex.ArrayTree, critic: chex.ArrayTree, batch: Minibatch, noise: Noise
) -> tuple[chex.Array, chex.Array]:
    """-mean Q_i1(x, a_1, ..., mu_i(o_i), ..., a_N) + regularizer * mean mu_i's output^2, the others' actions from the
    replay; twice, as value and as metric."""
    output = apply(group.actor, params, batch.observation)
    action = group.policy.sample(output, noise.action)
    q = group.critic.value(critic, batch.inputs, action - batch.action, batch.action_column)
    loss = -q.mean() + hyper.logit_regularizer * jnp.mean(jnp.square(output))
    return loss, loss
