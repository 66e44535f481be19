"""One set of critics for a whole team (`critic=shared`), as HARL's MATD3 has it (Zhong et al. 2024). For one seed.

It reads x and all actions and learns from the mean of the team's rewards, once an update, from one minibatch; every
agent's actor climbs it, with the others' actions as replayed. It is kept in the state of the team's first group.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import chex
import jax
import optax

from matd3_jax.core import losses
from matd3_jax.core.agent_update import mean_over, step_critics
from matd3_jax.core.agents import JointLayout
from matd3_jax.core.algorithm import HyperParams
from matd3_jax.core.minibatch import Minibatch, Noise

if TYPE_CHECKING:
    from matd3_jax.core.update import GroupState

PARTS = ("critic", "critic_target", "critic_optimizer")
"""Of a group's state, all that belongs to critics."""


def without(state: "GroupState") -> "GroupState":
    """A group's state but for its critics."""
    return state._replace(**dict.fromkeys(PARTS))


def update(
    layout: JointLayout,
    g: int,
    hyper: HyperParams,
    move: bool,
    axis: str | None,
    mu_targets: Sequence[chex.ArrayTree],
    state: "GroupState",
    batch: Minibatch,
    noise: Noise,
) -> tuple["GroupState", chex.Array, chex.Array]:
    """One update of a team's critics: (the state of its first group, loss, Q).

    Args:
        g: number of the first group.
        move: whether the target critics move, too.
        batch, noise: of any of the team's agents.
    """
    group = layout.groups[g]
    own = state._replace(**{part: jax.tree.map(lambda leaf: leaf[0], getattr(state, part)) for part in PARTS})
    next_action = losses.target_actions(layout, group, hyper, mu_targets, None, batch, noise)
    y = losses.td_target(layout, group, hyper, own.critic_target, batch, next_action, noise.critics)
    gradient = jax.grad(lambda params: losses.critic_loss(layout, group, params, batch, y), has_aux=True)
    gradients, (loss, q_value) = mean_over(axis, gradient(own.critic))
    own = step_critics(group, hyper, own, gradients)
    if move:
        own = own._replace(critic_target=optax.incremental_update(own.critic, own.critic_target, hyper.tau))
    new = {part: jax.tree.map(lambda leaf: leaf[None], getattr(own, part)) for part in PARTS}
    return state._replace(**new), loss, q_value
