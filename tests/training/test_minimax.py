"""A game whose minimax policy and values are known in closed form, learnt by the whole loop."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from learner_cases import layers
from ledger import HYPER

from matd3_jax.core.agents import JointLayout
from matd3_jax.core.algorithm import Algorithm
from matd3_jax.envs import Box, Environment, TimeStep
from matd3_jax.training.loop import TrainLoop
from matd3_jax.training.schedule import Schedule

pytestmark = pytest.mark.slow

GAMMA, SHIFT = 0.8, 0.75
STEPS, TEAM = np.array([0.0, 0.25, 0.5]), 0.1
"""One seed for each length of the opponent's step, in one program; the first is MADDPG but for the teammate's."""
M3DDPG = Algorithm(hidden=(32,), clip="none", num_critics=1, policy_delay=1, adversarial=True)
OPPONENT = dataclasses.replace(M3DDPG, name="maddpg", adversarial=False)
HYPER = HYPER._replace(gamma=GAMMA, tau=0.05, critic_lr=0.005, actor_lr=0.002, exploration_noise=0.4)


@dataclasses.dataclass(frozen=True)
class Game(Environment):
    """Numbers a (leader), c (waiting) and, of the other team, b; everybody sees the step, of two, then it is over.

    The leader gets 4 (a (b + 0.75) - a^2 / 2), the opponent -4 b^2, so that b comes near 0. With b as it is
    a = b + 0.75 is best; where the worst b within alpha of it counts, a (b - alpha + 0.75) - a^2 / 2 for a > 0, alpha
    less. Who waits gets a + b in the second step, so that the first is worth gamma (a + b), or what is left of it in
    the worst case.
    """

    episode_length: int = 2  # type: ignore[misc]

    @property
    def agents(self):
        return ("leader", "waiting", "opponent")

    @property
    def teams(self):
        return ("agents", "agents", "adversaries")

    @property
    def observation_sizes(self):
        return (1,) * 3

    @property
    def action_spaces(self):
        return (Box(1, -1.0, 1.0),) * 3

    def reset(self, key):
        return jnp.float32(0), self.observe(jnp.float32(0))

    def step(self, key, state, action):
        a, _, b = (part[0] for part in action)
        reward = jnp.stack([4 * (a * (b + SHIFT) - a**2 / 2), state * (a + b), -4 * b**2])
        return TimeStep(state + 1, self.observe(state + 1), reward, state == 1, jnp.bool_(False))

    def observe(self, step):
        return (step[None],) * 3


@functools.cache
def trained():
    """(layout, groups, replay) after 2,400 updates, in NumPy."""
    layout = JointLayout.of(Game(), {"agents": M3DDPG, "adversaries": OPPONENT})
    schedule = Schedule(
        num_envs=16, rollout_length=4, updates_per_collect=16, batch_size=128, replay_capacity=3200, learning_starts=128
    )
    hyper = {"agents": HYPER._replace(adversarial_step=STEPS, adversarial_step_team=TEAM), "adversaries": HYPER}
    trainer = TrainLoop(Game(), layout, schedule, hyper, len(STEPS))
    state, _ = trainer.interval(150)(trainer.init(jax.vmap(jax.random.key)(jnp.arange(len(STEPS)))))
    return layout, jax.tree.map(np.asarray, state.groups), np.asarray(state.replay)


def played(seed, agent):
    """What an agent plays in the first and the second step."""
    layout, groups, _ = trained()
    g, k = layout.place(agent)
    output, _ = reference.forward(layers(groups[g].actor, seed, k), np.array([[0.0], [1.0]]))
    return reference.act(layout.action_spaces[agent], output, 0)[0][:, 0]


@pytest.mark.parametrize("seed", range(len(STEPS)))
def test_the_minimax_policy(seed):
    """Mean of both steps, b as replayed. Tolerance: two fifths of what one length of the step is from the next."""
    b = trained()[2][seed, :, 5].mean()
    assert b == pytest.approx(0, abs=0.1)
    assert played(seed, 0).mean() == pytest.approx(SHIFT + b - STEPS[seed], abs=0.1)


@pytest.mark.parametrize("seed", range(len(STEPS)))
def test_the_minimax_value(seed):
    """The first step is worth gamma times the second's worst case, a - alpha_team + b - alpha; tolerance: a
    quarter of what one length of the step is from the next."""
    layout, groups, rows = trained()
    first = rows[seed, rows[seed, :, 0] == 0]
    g, k = layout.place(1)
    q, _ = reference.forward(layers(groups[g].critic, seed, k, 0), first[:, :6])
    a, b = played(seed, 0)[1], played(seed, 2)[1]
    assert len(first) > 1000
    assert q.mean() == pytest.approx(GAMMA * (a - TEAM + b - STEPS[seed]), abs=0.05)
