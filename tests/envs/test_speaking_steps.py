"""simple_speaker_listener with a speaker that falls silent: what is heard when, against a replay in NumPy."""

import dataclasses

import jax
import numpy as np
import pytest

from matd3_jax import config
from matd3_jax.envs import make
from matd3_jax.envs.wrappers.joint_team import JointTeam
from matd3_jax.training.session import TrainingSession

LENGTH = 5
"""Env steps of an episode."""


def heard(words, index, spoken):
    """What the listener observes before its action number `index` of an episode (0: after the reset), by the rule of
    the docstring; `words`: what the speaker's actions say, those of this episode in their order."""
    return words[index - 1] if 1 <= index <= spoken else np.zeros(3)


@pytest.mark.parametrize("spoken", [1, 2, LENGTH, 100])
@pytest.mark.parametrize(("rules", "actions"), [("orig", "soft"), ("mpe2", "discrete"), ("orig", "continuous")])
def test_an_episode_is_that_of_a_speaker_that_never_stops_but_for_what_is_heard(rules, actions, spoken):
    """Two episodes, the second from the first one's reset again; all else, to the bit."""
    options = {"rules": rules, "actions": actions, "episode_length": LENGTH}
    usual = make("simple_speaker_listener", **options)
    env = dataclasses.replace(usual, speaking_steps=spoken)
    reset, steps = jax.jit(env.reset), [jax.jit(one.step) for one in (usual, env)]
    for episode in range(2):
        (state, seen), (other, shown) = reset(jax.random.key(episode)), usual.reset(jax.random.key(episode))
        assert jax.tree.structure(state) == jax.tree.structure(other)
        words = []
        for index in range(LENGTH + 1):
            np.testing.assert_array_equal(seen[1][8:], heard(words, index, spoken))
            np.testing.assert_array_equal(shown[1][8:], heard(words, index, LENGTH))
            np.testing.assert_array_equal(seen[1][:8], shown[1][:8])
            np.testing.assert_array_equal(seen[0], shown[0])
            assert [x.dtype for x in seen] == [x.dtype for x in shown]
            if index == LENGTH:
                break
            key = jax.random.fold_in(jax.random.key(9), LENGTH * episode + index)
            action = tuple(space.sample(jax.random.fold_in(key, i)) for i, space in enumerate(env.action_spaces))
            words.append(np.eye(3, dtype=np.float32)[action[0]] if actions == "discrete" else np.asarray(action[0]))
            assert np.abs(words[-1]).max() > 0.1  # or silence would look like a word
            before, after = steps[0](None, other, action), steps[1](None, state, action)
            other, shown, state, seen = before.state, before.observation, after.state, after.observation
            np.testing.assert_array_equal(before.reward, after.reward)
            assert bool(before.truncated) == bool(after.truncated) == (index + 1 == LENGTH)


def test_what_the_replay_keeps_of_a_rollout_with_many_episodes():
    """Of every row: what was heard before the action and after it, the end of the episode included. Nothing is heard
    at the start of the next one, whatever was said at the end of the one before."""
    envs, steps, spoken = 3, 14, 2
    options = [f"env.speaking_steps={spoken}", f"env.episode_length={LENGTH}", "algo.hidden=[8]", "batch_size=8"]
    schedule = [f"num_envs={envs}", "rollout_length=7", "learning_starts=63", "total_steps=84", "replay_capacity=105"]
    lines = ["env=simple_speaker_listener", "seeds=2", *options, *schedule]
    trainer = TrainingSession(config.load(lines)).trainer
    layout = trainer.layout
    state, _ = trainer.warm_up(trainer.init(jax.vmap(jax.random.key)(np.arange(2))))
    assert 7 * int(state.rollouts) == steps
    for seed in range(2):
        parts = layout.row_parts(np.asarray(state.replay)[seed, : envs * steps])
        shape = (steps, envs, -1)  # all environments begin together
        words = layout.action_part(parts.action, 0).reshape(shape)
        before, after = (layout.observation_part(x, 1).reshape(shape)[..., 8:] for x in (parts.x, parts.next_x))
        for t in range(steps):
            first = t - t % LENGTH
            for k in range(envs):
                said, index = words[first:, k], t - first
                np.testing.assert_array_equal(before[t, k], heard(said, index, spoken))
                np.testing.assert_array_equal(after[t, k], heard(said, index + 1, spoken))
        assert (np.abs(words).max(axis=-1) > 0.1).all()  # the speaker goes on, in vain


def test_one_agent_in_everybody_s_place_hears_no_more():
    env = make("simple_speaker_listener", speaking_steps=1)
    joint = JointTeam(env)
    state, _ = joint.reset(jax.random.key(0))
    step = jax.jit(joint.step)
    for index in range(3):
        (space,) = joint.action_spaces
        action = space.sample(jax.random.key(index))
        after = step(None, state, (action,))
        (seen,), state = after.observation, after.state
        np.testing.assert_array_equal(seen[-3:], action[:3] if index == 0 else np.zeros(3))
