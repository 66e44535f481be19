"""Agents that move and speak, through the whole loop: what they play, what the others hear, and that it is learnt."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from learner_cases import layers

import matd3_jax
from matd3_jax.envs import Environment, Simplex, TimeStep
from matd3_jax.evaluation import trajectory

SMALL = {
    "seeds": 1, "num_envs": 2, "rollout_length": 5, "batch_size": 8, "learning_starts": 20, "total_steps": 60,
    "log_every": 20, "replay_capacity": 100,
}  # fmt: skip
RUNS = {
    "soft": ("simple_reference", "soft", ()),
    "discrete": ("simple_world_comm", "discrete", ("env.num_good=1", "env.num_adversaries=2")),
}
HEARD = {"simple_reference": {0: (1,), 1: (0,)}, "simple_world_comm": {0: (0, 1)}}
"""Speaker -> those whose observation ends with its word."""


CASES = ["soft", pytest.param("discrete", marks=pytest.mark.slow)]


@functools.cache
def trained(name):
    env, actions, options = RUNS[name]
    return matd3_jax.train(
        f"env.actions={actions}", "algo.hidden=[8]", "algo.policy_delay=1", *options, env=env, **SMALL
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_what_is_played_is_what_is_heard(name):
    """Every stored action is valid part by part, and the word in it stands in the listeners' next observation."""
    result, env = trained(name), RUNS[name][0]
    layout, written = result.training.layout, 10 * int(result.state.rollouts)
    assert 60 <= written <= SMALL["replay_capacity"]
    parts = layout.row_parts(np.asarray(result.state.replay)[0, :written])
    for i, space in enumerate(layout.action_spaces):
        action, start = layout.action_part(parts.action, i), 0
        for size in space.sizes:
            part = action[:, start : start + size]
            np.testing.assert_allclose(part.sum(axis=1), 1, atol=1e-6)  # float32 softmax
            assert (part >= 0).all() and len(np.unique(part.argmax(axis=1))) > 2
            assert RUNS[name][1] == "soft" or set(np.unique(part)) == {0, 1}
            start += size
        assert start == action.shape[1]
    for speaker, listeners in HEARD[env].items():
        word = layout.action_part(parts.action, speaker)[:, 5:]
        for listener in listeners:
            np.testing.assert_array_equal(layout.observation_part(parts.next_x, listener)[:, -word.shape[1] :], word)


@pytest.mark.parametrize("name", CASES)
def test_updates_move_movement_and_word(name):
    """Updates move the actors in the columns of the movement and in those of the word, and losses are finite."""
    result = trained(name)
    training = result.training
    before, _ = training.start()
    for g, group in enumerate(training.layout.groups):
        old, new = (
            np.asarray(state.groups[g].actor[f"kernel_{len(group.algorithm.hidden)}"])
            for state in (before, result.state)
        )
        assert (np.abs(new - old).max(axis=(0, 1, 2)) > 1e-4).all()
    losses = [values[:, -1] for column, values in result.metrics.items() if "loss" in column]
    assert losses and np.isfinite(losses).all()


@dataclasses.dataclass(frozen=True)
class Telling(Environment):
    """One env step: sees a number from 0 to 2, and is paid for the move and for the word that stand for it.

    The move is the number's parity, so that neither part gives the other away.
    """

    agents: tuple[str, ...] = ("speaker",)  # type: ignore[misc]
    observation_sizes: tuple[int, ...] = (3,)  # type: ignore[misc]
    action_spaces: tuple[Simplex, ...] = (Simplex((2, 3)),)  # type: ignore[misc]
    episode_length: int = 1  # type: ignore[misc]

    def reset(self, key):
        state = jax.random.randint(key, (), 0, 3)
        return state, self.observe(state)

    def observe(self, state):
        return (jax.nn.one_hot(state, 3),)

    def step(self, key, state, action):
        reward = action[0][state % 2] + action[0][2 + state]
        return TimeStep(state, self.observe(state), reward[None], jnp.bool_(True), jnp.bool_(False))


@pytest.mark.slow
def test_move_and_word_are_learnt():
    """Each is the right one for what is seen, and nearly surely; at first no word is more than likely."""
    # Actors slow against the critics: none is sure of a choice before the values are there.
    result = matd3_jax.train(
        "algo.hidden=[16]", "algo.actor_lr=0.001", "algo.critic_lr=0.01", "algo.logit_regularizer=0.01", env=Telling(),
        algo="iddpg", seeds=2, num_envs=4, rollout_length=5, updates_per_collect=4, batch_size=64, learning_starts=100,
        replay_capacity=2000, total_steps=6000, log_every=6000, eval_every=0,
    )  # fmt: skip
    before, _ = result.training.start()

    def shares(state, seed):
        """Probabilities of the right move and of the right word, [numbers, 2]."""
        logits, _ = reference.forward(layers(state.groups[0].actor, seed, 0), np.eye(3))
        move, word = reference.softmax(logits[:, :2]), reference.softmax(logits[:, 2:])
        return np.stack([move[[0, 1, 2], [0, 1, 0]], word[[0, 1, 2], [0, 1, 2]]], axis=1)

    for seed in range(2):
        assert (shares(before, seed) < 0.7).all()
        assert (shares(result.state, seed) > 0.9).all()


@pytest.mark.parametrize("name", CASES)
def test_deterministic_words(name):
    """Without noise the word is the softmax of its own logits, or the likeliest one, whatever the movement's are."""
    result, (env, actions, _) = trained(name), RUNS[name]
    training = result.training
    states = trajectory.play(training, result.state, max_steps=3).states
    seen = jax.vmap(training.env.observe)(states)
    for speaker in HEARD[env]:
        g, k = training.layout.place(speaker)
        logits, _ = reference.forward(layers(result.state.groups[g].actor, 0, k), np.asarray(seen[speaker][:-1]))
        want = reference.softmax(logits[:, 5:])
        if actions == "discrete":
            want = np.eye(want.shape[1])[want.argmax(axis=1)]
        np.testing.assert_allclose(states.comm[1:, speaker], want, atol=1e-5)  # float32
