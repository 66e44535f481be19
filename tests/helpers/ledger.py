"""A small environment whose transitions can be distinguished and checked by hand."""

import dataclasses
from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np

from matd3_jax.core.algorithm import HyperParams
from matd3_jax.envs import Environment, Simplex, TimeStep

ENDS, LIMIT = 3, 5
"""Episodes whose number is below 0.5 terminate with step ENDS, the others are truncated with step LIMIT."""

HYPER = HyperParams(
    actor_lr=0.01,
    critic_lr=0.01,
    gamma=0.9,
    tau=0.1,
    target_noise=0.2,
    target_noise_clip=0.5,
    exploration_noise=0.1,
    logit_regularizer=1e-3,
    max_grad_norm=0.5,
)


class LedgerState(NamedTuple):
    number: chex.Array
    """Random number in (0, 1) of the episode: with the step it names a transition."""
    step: chex.Array
    total: chex.Array
    """[num_agents]: sum of the first entries of the agent's actions."""


@dataclasses.dataclass(frozen=True)
class Ledger(Environment):
    """Agent i sees (number, step, its total, and i further zeros); its reward is its total plus 10 i."""

    teams: tuple[str, ...] = ("agents", "adversaries")  # type: ignore[misc]
    episode_length: int = LIMIT  # type: ignore[misc]

    @property
    def agents(self):
        return tuple(f"agent_{i}" for i in range(len(self.teams)))

    @property
    def observation_sizes(self):
        return tuple(3 + i for i in range(len(self.teams)))

    @property
    def action_spaces(self):
        return (Simplex((2,)),) * len(self.teams)

    @property
    def measures(self):
        return ("number", "step")

    def measure(self, state):
        return jnp.stack([state.number, state.step.astype(jnp.float32)])

    def reset(self, key):
        number = jax.random.uniform(key, minval=0.01, maxval=0.99)
        state = LedgerState(number, jnp.int32(0), jnp.zeros(len(self.teams)))
        return state, self.observe(state)

    def step(self, key, state, action):
        state = LedgerState(state.number, state.step + 1, state.total + jnp.stack([a[0] for a in action]))
        terminated = (state.number < 0.5) & (state.step == ENDS)
        reward = state.total + 10.0 * jnp.arange(len(self.teams))
        return TimeStep(state, self.observe(state), reward, terminated, state.step == LIMIT)

    def observe(self, state):
        head = jnp.stack([state.number, state.step.astype(jnp.float32)])
        return tuple(jnp.concatenate([head, state.total[i : i + 1], jnp.zeros(i)]) for i in range(len(self.teams)))


def by_hand(x, action):
    """(reward, x', terminated, truncated) of one transition of a two-agent Ledger, from its x and joint action."""
    number, step = x[0], x[1] + 1
    total = x[[2, 5]] + action[[0, 2]]
    terminated = number < 0.5 and step == ENDS
    next_x = np.array([number, step, total[0], number, step, total[1], 0])
    return total + [0, 10], next_x, terminated, step == LIMIT
