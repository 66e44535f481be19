"""Tasks that need memory: what is seen or done at the first step counts at the last, where nothing of it is to be seen.

The best that policies without memory can get is known, and so are the values that critics without memory cannot tell
apart.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from ledger import HYPER

from matd3_jax.core import gru, losses, minibatch
from matd3_jax.core.agents import JointLayout
from matd3_jax.core.algorithm import Algorithm
from matd3_jax.envs import Box, Environment, Simplex, TimeStep
from matd3_jax.training.evaluator import Evaluator
from matd3_jax.training.loop import TrainLoop
from matd3_jax.training.schedule import Schedule

pytestmark = pytest.mark.slow

LENGTH = 4
HYPER = HYPER._replace(gamma=0.9, tau=0.05, critic_lr=0.005, actor_lr=0.003, exploration_noise=0.5)
ALGORITHMS = {
    "mlp": Algorithm(hidden=(16,), clip="none"),
    "gru": Algorithm(hidden=(16,), clip="none", actor="gru", gru_units=8),
    "gru-own": Algorithm(hidden=(16,), clip="none", actor="gru", gru_units=8, critic="own", num_critics=1),
}


@dataclasses.dataclass(frozen=True)
class Recall(Environment):
    """Everybody sees the step and at step 0 a cue, -1 or 1; only the last of the steps is rewarded."""

    episode_length: int = LENGTH  # type: ignore[misc]

    @property
    def agents(self):
        return ("force", "choice", "promise")

    @property
    def observation_sizes(self):
        return (2,) * 3

    @property
    def action_spaces(self):
        return (Box(1, -1.0, 1.0), Simplex((2,)), Box(1, -1.0, 1.0))

    def reset(self, key):
        cue = 2.0 * jax.random.bernoulli(key) - 1
        state = (jnp.int32(0), cue, jnp.float32(0))
        return state, self.observe(state)

    def step(self, key, state, action):
        step, cue, first = state
        first = jnp.where(step == 0, action[2][0], first)
        reward = jnp.stack([
            -jnp.square(action[0][0] - 0.5 * cue),  # force: half of the cue; without memory 0, and -0.25
            cue * (action[1][0] - action[1][1]),  # choice: without memory either, and 0
            first,  # promise: what it did at step 0
        ])  # fmt: skip
        last = step == LENGTH - 1
        state = (step + 1, cue, first)
        return TimeStep(state, self.observe(state), jnp.where(last, reward, 0), last, jnp.zeros((), bool))

    def observe(self, state):
        step, cue, _ = state
        return (jnp.stack([step / LENGTH, jnp.where(step == 0, cue, 0)]),) * 3


ENV = Recall()


@functools.cache
def trained(name):
    """(loop, state) after 1,600 updates."""
    layout = JointLayout.of(ENV, {"agents": ALGORITHMS[name]}, 1, *((4, 2) if name != "mlp" else ()))
    schedule = Schedule(
        num_envs=16, rollout_length=4, updates_per_collect=16, batch_size=64, replay_capacity=6400, learning_starts=128
    )
    loop = TrainLoop(ENV, layout, schedule, {"agents": HYPER}, 2)
    state, metrics = loop.interval(100)(loop.init(jax.vmap(jax.random.key)(jnp.arange(2))))
    assert np.isfinite(metrics.update.critic_loss).all()
    return loop, state


def returns(name):
    """[seeds, agents] of deterministic episodes."""
    loop, state = trained(name)
    keys = jax.vmap(jax.random.key)(jnp.arange(2))
    return np.asarray(Evaluator(loop).evaluate(state, keys, 64, True).episode_return).mean(axis=1)


@pytest.mark.parametrize("name", ["gru", "gru-own"])
def test_what_was_seen_is_remembered(name):
    found = returns(name)
    assert (found[:, 0] > -0.05).all() and (found[:, 1] > 0.9).all()


def test_without_memory_it_cannot_be_known():
    found = returns("mlp")
    assert (found[:, 0] < -0.2).all() and (found[:, 1] < 0.4).all()


def test_critics_remember_what_was_done():
    """The value of the last step is the action of the first; its exploration is nowhere else to be seen."""
    loop, state = trained("gru")
    layout = loop.layout
    rows = np.asarray(state.replay)[0].reshape(-1, 16, layout.row_size).swapaxes(0, 1)
    episodes = jnp.asarray(rows.reshape(-1, LENGTH, layout.row_size)[-512:])
    g, k = layout.place(2)
    whole = dataclasses.replace(layout, burn_in=0, sequence_length=LENGTH)
    place = jax.tree.map(lambda leaf: jnp.asarray(leaf)[k], minibatch.places(whole, whole.groups[g]))
    flat = episodes.reshape(-1, layout.row_size)
    batch = minibatch.minibatch(whole, whole.groups[g], flat, place, 0.9, sequences=episodes)
    critic = jax.tree.map(lambda leaf: leaf[0, k], state.groups[g].critic)
    value = whole.groups[g].critic.values(critic, losses.critic_inputs(whole, critic, batch))[0]
    first = np.asarray(layout.action_part(layout.row_parts(episodes).action, 2))[:, 0, 0]
    last = np.asarray(value).reshape(-1, LENGTH)[:, -1]
    assert first.std() > 0.1
    assert np.abs(last - first).mean() < 0.1 * np.abs(first - first.mean()).mean() + 0.03
    assert gru.PARAMS in critic
