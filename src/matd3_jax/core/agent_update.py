"""One update of one agent, or of agents that share their networks, from the equations in `losses`. For one seed."""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import chex
import jax
import jax.numpy as jnp
import optax
from jax.flatten_util import ravel_pytree

from matd3_jax.core import losses, optimizer
from matd3_jax.core.agents import JointLayout
from matd3_jax.core.algorithm import HyperParams
from matd3_jax.core.group import Group
from matd3_jax.core.minibatch import Minibatch, Noise
from matd3_jax.core.sharing import mean_gradient, network_of

if TYPE_CHECKING:
    from matd3_jax.core.update import GroupState


def update_agent(
    layout: JointLayout,
    group: Group,
    hyper: HyperParams,
    move: bool,
    axis: str | None,
    mu_targets: Sequence[chex.ArrayTree],
    state: "GroupState",
    own_target: chex.ArrayTree,
    batch: Minibatch,
    noise: Noise,
    next_action: chex.Array | None = None,
) -> tuple["GroupState", tuple[chex.Array, chex.Array, chex.Array]]:
    """One agent: its state, and (critic loss, Q, actor loss). `state`: without the members' axis; `next_action`: the
    target actions, where they are known already."""
    if next_action is None:
        next_action = losses.target_actions(layout, group, hyper, mu_targets, own_target, batch, noise)
    y = losses.td_target(layout, group, hyper, state.critic_target, batch, next_action, noise.critics)

    critic_gradient = jax.grad(lambda params: losses.critic_loss(layout, group, params, batch, y), has_aux=True)
    gradients, (loss, q_value) = mean_over(axis, critic_gradient(state.critic))
    state = step_critics(group, hyper, state, gradients)
    if not move:
        return state, (loss, q_value, jnp.full((), jnp.nan))
    state, mu_loss = move_actor(layout, group, hyper, axis, state, batch, noise)
    return state, (loss, q_value, mu_loss)


def move_actor(
    layout: JointLayout,
    group: Group,
    hyper: HyperParams,
    axis: str | None,
    state: "GroupState",
    batch: Minibatch,
    noise: Noise,
    critic: chex.ArrayTree | None = None,
) -> tuple["GroupState", chex.Array]:
    """Actor and targets of one agent, whose critics have learned already: its state, and the actor loss; `critic`: its
    team's, where it has none of its own."""
    q_params = state.critic if critic is None else critic
    actor_gradient = jax.grad(
        lambda params: losses.actor_loss(layout, group, hyper, params, q_params, batch, noise), has_aux=True
    )
    gradients, mu_loss = mean_over(axis, actor_gradient(state.actor))
    return step_actor(group, hyper, state, gradients), mu_loss


def update_together(
    layout: JointLayout,
    group: Group,
    hyper: HyperParams,
    move: bool,
    axis: str | None,
    mu_targets: Sequence[chex.ArrayTree],
    state: "GroupState",
    agents: tuple[chex.Array, Any, Noise | None],
    cut: Callable[[Any], Minibatch],
    how: tuple[bool, bool],
    next_action: chex.Array | None = None,
    team_critic: chex.ArrayTree | None = None,
) -> tuple["GroupState", tuple[chex.Array, chex.Array, chex.Array]]:
    """All members of a group that share their networks: their state, and (critic loss, Q, actor loss), [members] each.

    Args:
        state: without the networks' axis.
        agents: (number in the group, what `cut` makes the minibatch of, noise) of all members, leading axis [members].
        how: whether members are computed one by one, and without a loop (`sharing.mean_gradient`).
        next_action: the target actions, where they are known already.
        team_critic: of the team, which has learned already; the members' critics are left alone then.
    """

    def of(params: chex.ArrayTree, k: chex.Array) -> chex.ArrayTree:
        return network_of(params, k, group.index_size)

    def critic_loss(params: chex.ArrayTree, one: tuple) -> tuple[chex.Array, tuple[chex.Array, chex.Array]]:
        k, batch, noise = one[0], cut(one[1]), one[2]
        action = next_action
        if action is None:
            own = of(state.actor_target, k)
            action = losses.target_actions(layout, group, hyper, mu_targets, own, batch, noise)
        y = losses.td_target(layout, group, hyper, of(state.critic_target, k), batch, action, noise.critics)
        return losses.critic_loss(layout, group, of(params, k), batch, jax.lax.stop_gradient(y))

    nothing = jnp.full(len(group.members), jnp.nan)
    loss = q_value = mu_loss = nothing
    if team_critic is None:
        gradients, (loss, q_value) = mean_over(axis, mean_gradient(critic_loss, state.critic, agents, *how))
        state = step_critics(group, hyper, state, gradients)
    if not move:
        return state, (loss, q_value, mu_loss)
    learned = state.critic

    def actor_loss(params: chex.ArrayTree, one: tuple) -> tuple[chex.Array, chex.Array]:
        k, batch, noise = one[0], cut(one[1]), one[2]
        critic = of(learned, k) if team_critic is None else team_critic
        return losses.actor_loss(layout, group, hyper, of(params, k), critic, batch, noise)

    gradients, mu_loss = mean_over(axis, mean_gradient(actor_loss, state.actor, agents, *how))
    return step_actor(group, hyper, state, gradients), (loss, q_value, mu_loss)


def step_critics(group: Group, hyper: HyperParams, state: "GroupState", gradients: chex.ArrayTree) -> "GroupState":
    """The state of one set of critics [critics, ...] after one step of their optimizers."""
    q_params, q_optimizer = optimizer.apply(
        group.algorithm,
        state.critic,
        state.critic_optimizer,
        gradients,
        hyper.critic_lr,
        hyper.max_grad_norm,
        stack_ndim=1,
    )
    return state._replace(critic=q_params, critic_optimizer=q_optimizer)


def step_actor(group: Group, hyper: HyperParams, state: "GroupState", gradients: chex.ArrayTree) -> "GroupState":
    """The state of one actor after one step of its optimizer, and of all targets (of critics where it has any)."""
    algorithm = group.algorithm
    mu_params, mu_optimizer = optimizer.apply(
        algorithm, state.actor, state.actor_optimizer, gradients, hyper.actor_lr, hyper.max_grad_norm, stack_ndim=0
    )
    # theta' <- tau theta + (1 - tau) theta'
    state = state._replace(
        actor=mu_params,
        actor_optimizer=mu_optimizer,
        actor_target=optax.incremental_update(mu_params, state.actor_target, hyper.tau),
        critic_target=optax.incremental_update(state.critic, state.critic_target, hyper.tau),
    )
    if algorithm.actor_average:
        average = optax.incremental_update(mu_params, state.actor_average, algorithm.actor_average)
        state = state._replace(actor_average=average)
    return state


def mean_over(axis: str | None, tree: chex.ArrayTree) -> chex.ArrayTree:
    """Means over the devices of the axis, as one vector: each array by itself costs a meeting of all devices."""
    if axis is None:
        return tree
    flat, restored = ravel_pytree(tree)
    return restored(jax.lax.pmean(flat, axis))
