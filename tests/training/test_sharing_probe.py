"""Agents that see the same and want different things, learnt by the whole loop with networks in common.

Only the index tells them apart: a network that lost it, or gave it to the wrong agent, shows here as a number.
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
from matd3_jax.envs import Box, Environment, TimeStep
from matd3_jax.training.loop import TrainLoop
from matd3_jax.training.schedule import Schedule

pytestmark = pytest.mark.slow

GAMMA, PLACES, BASE = 0.8, np.array([-0.5, 0.1, 0.6]), np.array([-1.0, 0.0, 1.5])
MODES = {
    "kind": {"share_parameters": "kind"},
    "kind-own": {"share_parameters": "kind", "critic": "own"},
    "team": {"critic": "shared"},
    "both": {"share_parameters": "kind", "critic": "shared"},
}
SEEDS = 2
HYPER = HYPER._replace(gamma=GAMMA, tau=0.05, critic_lr=0.005, actor_lr=0.002, exploration_noise=0.4)


@dataclasses.dataclass(frozen=True)
class Apart(Environment):
    """Everybody sees the step, of two, then it is over; agent i gets base_i - (a_i - place_i)^2 in each."""

    episode_length: int = 2  # type: ignore[misc]
    agents = ("left", "middle", "right")
    observation_sizes = (1,) * 3
    action_spaces = (Box(1, -1.0, 1.0),) * 3

    def reset(self, key):
        return jnp.float32(0), self.observe(jnp.float32(0))

    def step(self, key, state, action):
        reward = BASE - (jnp.concatenate(action) - PLACES) ** 2
        return TimeStep(state + 1, self.observe(state + 1), reward, state == 1, jnp.bool_(False))

    def observe(self, step):
        return (step[None],) * 3


@functools.cache
def trained(mode):
    """(groups, replay) after 3,200 updates, in NumPy."""
    algorithm = Algorithm(hidden=(48, 48), clip="none", policy_delay=1, **MODES[mode])
    layout = JointLayout.of(Apart(), {"agents": algorithm})
    schedule = Schedule(
        num_envs=16, rollout_length=4, updates_per_collect=16, batch_size=64, replay_capacity=3200, learning_starts=64
    )
    trainer = TrainLoop(Apart(), layout, schedule, {"agents": HYPER}, SEEDS)
    state, _ = trainer.interval(200)(trainer.init(jax.vmap(jax.random.key)(jnp.arange(SEEDS))))
    (group,) = jax.tree.map(np.asarray, state.groups)
    return group, np.asarray(state.replay)


def played(mode, seed, agent, steps):
    """What an agent plays in these steps, an index of its own behind what it sees."""
    group, _ = trained(mode)
    shared = "share_parameters" in MODES[mode]
    seen = np.asarray(steps, float)[:, None]
    if shared:
        seen = np.concatenate([seen, np.tile(np.eye(3)[agent], (len(seen), 1))], axis=1)
    output, _ = reference.forward(layers(group.actor, seed, 0 if shared else agent), seen)
    return reference.act(Box(1, -1.0, 1.0), output, 0)[0][:, 0]


@pytest.mark.parametrize("seed", range(SEEDS))
@pytest.mark.parametrize("mode", MODES)
def test_each_comes_to_its_own_place(mode, seed):
    """Places are half a unit or more from each other; everybody sees the same numbers."""
    for agent, place in enumerate(PLACES):
        np.testing.assert_allclose(played(mode, seed, agent, [0, 1]), place, atol=0.2)


@pytest.mark.parametrize("seed", range(SEEDS))
@pytest.mark.parametrize("mode", MODES)
def test_values_of_everything_replayed(mode, seed):
    """The last step: the reward itself, of the agent or the mean of the team; the first: gamma times what the policies
    get besides. Root of the mean squared error, over actions as they were replayed; rewards of agents are 1 apart."""
    group, replay = trained(mode)
    x, action, reward = replay[seed, :, 0].astype(float), replay[seed, :, 3:6], replay[seed, :, 6:9]
    then = np.stack([BASE[i] - (played(mode, seed, i, [1])[0] - PLACES[i]) ** 2 for i in range(3)])
    of_team = MODES[mode].get("critic") == "shared"
    for agent in range(3):
        value, later = (reward.mean(axis=1), then.mean()) if of_team else (reward[:, agent], then[agent])
        want = value + np.where(x == 0, GAMMA * later, 0)
        read = replay[seed, :, :6].astype(float)
        if MODES[mode].get("critic") == "own":
            read = np.stack([x, action[:, agent]], axis=1)
        if not of_team:
            read = np.concatenate([read, np.tile(np.eye(3)[agent], (len(read), 1))], axis=1)
        q = reference.forward(layers(group.critic, seed, 0, 0), read)[0][:, 0]
        assert len(q) == 3200 and np.sqrt(np.mean((q - want) ** 2)) < 0.15
