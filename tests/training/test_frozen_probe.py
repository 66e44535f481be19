"""Learning against a frozen team, on a task so small that the best response to its policy is known.

A wrong action of the frozen team shows here as a number: where episodes are played, and where targets look ahead.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from learner_cases import layers

import matd3_jax
from matd3_jax.envs import Box, Environment, TimeStep

pytestmark = pytest.mark.slow

SLOPE, WANTED = 0.6, 0.3


@dataclasses.dataclass(frozen=True)
class Answer(Environment):
    """The agent moves to a place c in [-1, 1], the adversary answers there with b, and the agent says what b will be.

    Both see (step, c). Step 0: c becomes the agent's action, or with `drawn` a random number. Step 1: the agent gets
    -4 (b - 0.3)^2 - (a - b)^2 for its action a, the adversary -(b - slope c)^2. So the adversary learns b = slope c,
    and the best response to b(c) = 0.6 c is to move to 0.5 and say 0.3; to an adversary that learns the slope -0.6, to
    move to -0.5 (four seeds came to -0.4 to -0.6); to one that plays 0, or at random, to say 0, wherever it is.
    """

    slope: float = SLOPE
    drawn: bool = False
    episode_length: int = 2  # type: ignore[misc]
    agents = ("rival", "mover")
    teams = ("adversaries", "agents")
    observation_sizes = (2, 2)
    action_spaces = (Box(1, -1.0, 1.0), Box(1, -1.0, 1.0))

    def reset(self, key):
        state = (jnp.float32(0), jnp.float32(0))
        return state, self.observe(state)

    def observe(self, state):
        return (jnp.stack(state),) * 2

    def step(self, key, state, action):
        step, c = state
        (b,), (a,) = action
        rewards = jnp.stack([-((b - self.slope * c) ** 2), -4 * (b - WANTED) ** 2 - (a - b) ** 2])
        there = jax.random.uniform(key, minval=-1.0) if self.drawn else a
        state = (step + 1, jnp.where(step == 0, there, c))
        return TimeStep(state, self.observe(state), step * rewards, step == 1, jnp.bool_(False))


SETTINGS = [
    "algo.hidden=[32]", "algo.lr=0.005", "algo.gamma=0.9", "algo.tau=0.05", "algo.clip=none",
    "algo.logit_regularizer=0", "algo.exploration_noise=0.4", "num_envs=16", "rollout_length=2", "batch_size=64",
    "updates_per_collect=4", "algo.policy_delay=1", "replay_capacity=6400", "learning_starts=640", "warmup=random",
    "eval_every=0", "checkpoint_every=0", "log_every=3200", "seeds=2",
]  # fmt: skip
STEPS = 6400 + 640


def place(training, agent):
    number = training.layout.agents.index(agent)
    return training.layout.place(number)


def actor(result, agent):
    """Parameters of an agent's actor, leading axis [seeds]."""
    g, k = place(result.training, agent)
    return [np.asarray(leaf)[:, k] for leaf in jax.tree.leaves(result.state.groups[g].actor)]


def play(result, agent, seed, seen):
    """Deterministic actions [points] of an actor for observations [points, 2], in NumPy."""
    g, k = place(result.training, agent)
    output, _ = reference.forward(layers(result.state.groups[g].actor, seed, k), np.asarray(seen, np.float64))
    return reference.act(Box(1, -1.0, 1.0), output, 0)[0][:, 0]


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    """A run whose rival has learned b = 0.6 c, everywhere."""
    run = tmp_path_factory.mktemp("runs") / "source"
    return matd3_jax.train(*SETTINGS, env=Answer(drawn=True), total_steps=STEPS, run_dir=run)


def test_the_learner_finds_the_best_response_to_what_is_frozen(source, tmp_path):
    """And the frozen policy is that of the other run to the bit, though its rewards now ask for the opposite."""
    frozen = [f"adversary.policy={source.run_dir}", "adversary.frozen=true"]
    run = tmp_path / "response"
    result = matd3_jax.train(*SETTINGS, *frozen, env=Answer(slope=-SLOPE), total_steps=STEPS, run_dir=run)
    before, after = (actor(one, "rival") for one in (source, result))
    assert len(before) == 4
    for a, b in zip(before, after, strict=True):
        np.testing.assert_array_equal(a, b)
    places = np.linspace(-1, 1, 41)
    seen = np.stack([np.ones(41), places], axis=1)
    for seed in range(2):
        b = play(source, "rival", seed, seen)
        np.testing.assert_allclose(b, SLOPE * places, atol=0.25)
        (moved,) = play(result, "mover", seed, [[0, 0]])
        there = np.array([[1, moved]])
        (said,), (answer,) = play(result, "mover", seed, there), play(source, "rival", seed, there)
        assert moved > 0.2 and abs(answer - WANTED) < 0.15, (moved, answer)
        assert abs(said - answer) < 0.15, (said, answer)
