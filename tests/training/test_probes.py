"""Probe environments: problems so small that their values are known, learnt by the whole loop.

A wrong discount, bootstrap, sign, action column or exploration shows here as a number, whatever the code is like.
"""

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
from matd3_jax.envs import Box, Environment, Simplex, TimeStep
from matd3_jax.training.loop import TrainLoop
from matd3_jax.training.schedule import Schedule

pytestmark = pytest.mark.slow

GAMMA = 0.8
ALGORITHMS = {
    "matd3": Algorithm(hidden=(16,), clip="none"),
    "maddpg": Algorithm(hidden=(16,), clip="none", num_critics=1, policy_delay=1),
    "iddpg": Algorithm(hidden=(16,), clip="none", num_critics=1, policy_delay=1, critic="own"),
    "matd3-layer-norm": Algorithm(hidden=(16,), clip="none", critic_norm="layer"),
    "matd3-categorical": Algorithm(
        hidden=(16,), clip="none", critic_head="categorical", critic_atoms=49, critic_range=(-6.0, 6.0)
    ),
    "matd3-quantile": Algorithm(
        hidden=(16,), clip="none", critic_head="quantile", critic_quantiles=9, dropped_quantiles=0, actor_critics="all"
    ),
    "matd3-subset": Algorithm(hidden=(16,), clip="none", num_critics=4, target_critics=2, actor_critics="all"),
}
HYPER = HYPER._replace(
    gamma=GAMMA,
    tau=0.05,
    critic_lr=0.005,
    # Two seeds: critics of policies that stay as they are, and actors that learn.
    actor_lr=np.array([0.0, 0.003]),
    exploration_noise=0.5,
)
CRITICS, ACTORS = 0, 1
N_STEP = {"matd3-3-step": ("matd3", 3)}
"""Values of returns over several steps: the policies that the critics judge stay as they are, so they are the same."""


@dataclasses.dataclass(frozen=True)
class Probes(Environment):
    """One question for each agent; everybody sees (step * ends, sign, ends).

    Episodes of two steps. Half of them terminate (`ends` 1); in the others the step cannot be seen and a time limit
    cuts, so that to the agent they go on for ever. `sign` is -1 or 1 throughout the episode.
    """

    episode_length: int = 2  # type: ignore[misc]

    @property
    def agents(self):
        return ("late", "constant", "signal", "choice", "pair_0", "pair_1", "force")

    @property
    def observation_sizes(self):
        return (3,) * 7

    @property
    def action_spaces(self):
        return (Simplex((2,)),) * 6 + (Box(1, -1.0, 1.0),)

    def reset(self, key):
        sign, ends = jax.random.bernoulli(key, shape=(2,)).astype(jnp.float32)
        state = (jnp.float32(0), 2 * sign - 1, ends)
        return state, self.observe(state)

    def step(self, key, state, action):
        step, sign, ends = state
        lean = [a[0] - a[1] for a in action[:6]]
        reward = jnp.stack([
            step * ends,  # late: nothing but 1 at the end
            jnp.float32(1),  # constant
            sign,  # signal
            sign * lean[3],  # choice: the first entry for sign 1, the second for sign -1
            lean[4] * lean[5],  # pair: agree
            lean[4] * lean[5],
            -((action[6][0] - 0.5 * sign) ** 2),  # force: half of the sign
        ])  # fmt: skip
        state, last = (step + 1, sign, ends), step == 1
        return TimeStep(state, self.observe(state), reward, last & (ends == 1), last & (ends == 0))

    def observe(self, state):
        step, sign, ends = state
        return (jnp.stack([step * ends, sign, ends]),) * 7


ENV = Probes()


@functools.cache
def trained(name):
    """(layout, groups, replay) after 1,120 updates, in NumPy."""
    name, n_step = N_STEP.get(name, (name, 1))
    layout = JointLayout.of(ENV, {"agents": ALGORITHMS[name]}, n_step)
    schedule = Schedule(
        num_envs=16, rollout_length=4, updates_per_collect=16, batch_size=64, replay_capacity=3200, learning_starts=64
    )
    trainer = TrainLoop(ENV, layout, schedule, {"agents": HYPER}, 2)
    state, metrics = trainer.interval(70)(trainer.init(jax.vmap(jax.random.key)(jnp.arange(2))))
    assert np.isfinite(metrics.update.critic_loss).all()
    return layout, jax.tree.map(np.asarray, state.groups), np.asarray(state.replay)


def values(name, agent, seed=CRITICS):
    """(observations, actions of all, first critic's values) on the replay's rows, for one agent by name."""
    layout, groups, rows = trained(name)
    i = ENV.agents.index(agent)
    g, k = layout.place(i)
    x, action = rows[seed, :, :21].reshape(-1, 7, 3), rows[seed, :, 21:34]
    if layout.algorithms[i].critic == "central":
        inputs = rows[seed, :, :34]
    else:
        inputs = np.concatenate([x[:, i], action[:, 2 * i : 2 * i + 2]], axis=1)
    assert (x[:, i] == x[:, 0]).all() and len(inputs) == 3200
    q, _ = reference.forward(layers(groups[g].critic, seed, k, 0), inputs)
    return x[:, i], action, reference.head(layout.algorithms[i]).value(q)[0]


@pytest.mark.parametrize("agent", ["late", "constant", "signal"])
@pytest.mark.parametrize("name", [*ALGORITHMS, *N_STEP])
def test_values(name, agent):
    """Values that no action changes, in all six observations.

    One step from termination: the reward (constant: 1, signal: its sign); two steps: r + gamma r', and gamma alone for
    the late reward; where only a time limit cuts: the sum for ever, r / (1 - gamma) = 5 r.
    Tolerance: 1 % of the largest value, 5; a small network trained with a constant learning rate is off by half of that
    at most (measured), while a mistake of one step of discount is 20 %.
    """
    x, _, q = values(name, agent)
    for step, sign, ends in {tuple(row) for row in x.tolist()}:
        reward = {"late": ends * 1.0, "constant": 1.0, "signal": sign}[agent]
        if ends:
            want = reward if step else GAMMA * reward + (0 if agent == "late" else reward)
        else:
            want = reward / (1 - GAMMA)
        here = (x == (step, sign, ends)).all(axis=1)
        assert here.sum() > 100
        assert abs(q[here].mean() - want) < 0.05, (step, sign, ends)


@pytest.mark.parametrize("name", ALGORITHMS)
def test_reward_of_two(name):
    """A reward made of both agents' actions, one step from the end: a central critic explains it, an own one cannot
    (measured: a tenth and the whole of what the other's action brings in)."""
    for agent, own, other in (("pair_0", 8, 10), ("pair_1", 10, 8)):
        x, action, q = values(name, agent)
        last = (x[:, 0] == 1) & (x[:, 2] == 1)
        lean, its = (action[last, k] - action[last, k + 1] for k in (own, other))
        reward, sign = lean * its, x[last, 1]
        error = np.mean((q[last] - reward) ** 2)
        for s in (-1, 1):  # what is left for one who knows the other's mean, but not its action
            its[sign == s] -= its[sign == s].mean()
        hidden = np.mean((lean * its) ** 2)
        assert error < 0.3 * hidden if ALGORITHMS[name].critic == "central" else 0.9 * hidden < error < 1.3 * hidden


@pytest.mark.parametrize("name", ALGORITHMS)
def test_actors_find_the_best_action(name):
    """The likeliest choice depends on the sign as it should, and nearly surely; the force comes near half of the sign
    (the reward is flat there: 0.3 away from it costs 0.09 of the 1 between the best force and the worst nearby)."""
    layout, groups, _ = trained(name)
    for agent in ("choice", "force"):
        i = ENV.agents.index(agent)
        g, k = layout.place(i)
        for sign in (-1, 1):
            output, _ = reference.forward(layers(groups[g].actor, ACTORS, k), np.array([[0, sign, 1], [1, sign, 1]]))
            action, _ = reference.act(layout.action_spaces[i], output, 0)
            if agent == "choice":
                assert (sign * (action[:, 0] - action[:, 1]) > 0.8).all()
            else:
                np.testing.assert_allclose(action[:, 0], 0.5 * sign, atol=0.3)
