"""Environments with one agent through gymnasium's vector interface, against direct calls of the environment."""

import gymnasium
import jax
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from matd3_jax import envs
from matd3_jax.envs.wrappers.joint_team import JointTeam
from matd3_jax.errors import OptionError, UserError
from matd3_jax.interop.to_gymnasium import vector_env

LENGTH = 3


class Apart(type(envs.make("point_reach"))):
    """One of its two copies, told by where its target is, ends in its second step, the other by the time limit."""

    def step(self, key, state, action):
        ts = super().step(key, state, action)
        return ts._replace(terminated=(ts.state.step == 2) & (state.target[0] > 0))


def copies(mode):
    """Two copies of which the second, and it alone, terminates; their environment and seed."""
    inner = JointTeam(Apart(episode_length=LENGTH))
    targets = [float(inner.reset(jax.random.split(jax.random.key(seed))[1])[0].target[0]) for seed in range(20)]
    seed = next(i for i in range(19) if targets[i] < 0 < targets[i + 1])
    env = vector_env(inner, 2, mode)
    env.reset(seed=seed)
    return env, inner, seed


def act(env):
    return np.zeros(env.action_space.shape, np.float32)


def test_spaces():
    env = vector_env("simple_spread", 3, joint=True)
    assert env.num_envs == 3 and env.metadata["autoreset_mode"] == AutoresetMode.NEXT_STEP
    assert env.single_observation_space.shape == (54,) and env.observation_space.shape == (3, 54)
    assert env.action_space.shape == (3, 15) and env.single_action_space.shape == (15,)
    env.action_space.seed(0)
    actions = env.action_space.sample()
    assert env.action_space.contains(actions) and all(env.single_action_space.contains(one) for one in actions)
    assert not env.action_space.contains(actions * np.float32(0.9))
    hard = vector_env("simple_spread", 3, joint=True, actions="discrete")
    assert hard.single_action_space == gymnasium.spaces.MultiDiscrete([5, 5, 5])
    hard.reset(seed=0)
    observations, rewards, *_ = hard.step(hard.action_space.sample())
    assert hard.observation_space.contains(observations) and rewards.shape == (3,)
    assert vector_env("simple", 2, actions="discrete").single_action_space == gymnasium.spaces.Discrete(5)


def test_copies_are_those_of_their_seeds():
    env = vector_env("simple", 3)
    one = vector_env("simple", 1)
    together = env.reset(seed=5)[0]
    for i in range(3):
        np.testing.assert_allclose(one.reset(seed=5 + i)[0][0], together[i], atol=1e-6)
    np.testing.assert_allclose(env.reset(seed=[7, 5, 6])[0], np.stack([env.reset(seed=s)[0][0] for s in (7, 5, 6)]))


def test_next_step_is_the_reset():
    env, inner, seed = copies(AutoresetMode.NEXT_STEP)
    observed, ends, rewards = [], [], []
    for _ in range(4):
        observation, reward, terminated, truncated, info = env.step(act(env))
        assert info == {}
        observed.append(observation)
        rewards.append(reward)
        ends.append((terminated.tolist(), truncated.tolist()))
    # The second copy: terminated in step 2, reset in step 3. The first: truncated in step 3, reset in step 4.
    assert ends[:2] == [([False] * 2, [False] * 2), ([False, True], [False] * 2)]
    assert ends[2] == ([False] * 2, [True, False]) and rewards[2][1] == 0 and rewards[2][0] < 0
    assert ends[3][1] == [False, False] and rewards[3][0] == 0 and rewards[3][1] < 0
    assert np.abs(observed[2][1] - observed[1][1]).max() > 0.01  # the next episode's
    # The reset's key goes on in the copy's own sequence: after the start and two steps.
    key = jax.random.key(seed + 1)
    for _ in range(4):  # start, two steps, and the step that is not used
        key, _ = jax.random.split(key)
    np.testing.assert_allclose(inner.reset(jax.random.split(key)[1])[1][0], observed[2][1], atol=1e-5)


def test_same_step_keeps_the_last_observation():
    env = copies(AutoresetMode.SAME_STEP)[0]
    still = copies(AutoresetMode.DISABLED)[0]
    for t in range(2):
        observation, _, terminated, truncated, info = env.step(act(env))
        want, *_ = still.step(act(still))
        if t == 0:
            assert info == {}
            np.testing.assert_allclose(observation, want, atol=1e-6)
    assert terminated.tolist() == [False, True] and not truncated.any()
    assert info["_final_obs"].tolist() == [False, True] and info["final_obs"][0] is None
    np.testing.assert_allclose(info["final_obs"][1], want[1], atol=1e-6)
    np.testing.assert_allclose(observation[0], want[0], atol=1e-6)
    assert np.abs(observation[1] - want[1]).max() > 0.01
    observation, reward, terminated, truncated, info = env.step(act(env))
    assert truncated.tolist() == [True, False] and reward[1] < 0 and info["_final_obs"].tolist() == [True, False]


def test_without_autoreset_the_caller_resets():
    env, *_ = copies(AutoresetMode.DISABLED)
    for _ in range(2):
        observation, *_ = env.step(act(env))
    with pytest.raises(UserError, match=r"copies \[1\] have ended; reset them"):
        env.step(act(env))
    after, _ = env.reset(options={"reset_mask": np.array([False, True])})
    np.testing.assert_array_equal(after[0], observation[0])
    assert np.abs(after[1] - observation[1]).max() > 0.01
    _, _, terminated, truncated, _ = env.step(act(env))
    assert truncated.tolist() == [True, False] and not terminated[1]


def test_gymnasiums_own_wrapper_counts_episodes():
    env = gymnasium.wrappers.vector.RecordEpisodeStatistics(vector_env("simple", 2, episode_length=LENGTH))
    env.reset(seed=0)
    total = np.zeros(2)
    for _ in range(LENGTH):
        _, reward, _, truncated, info = env.step(env.action_space.sample())
        total += reward
    assert truncated.all()
    np.testing.assert_allclose(info["episode"]["r"], total, rtol=1e-5)
    np.testing.assert_array_equal(info["episode"]["l"], [LENGTH, LENGTH])


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: vector_env("simple_push"), "SimplePush has 2 agents, and gymnasium's environments have one"),
        (lambda: vector_env("simple", 0), "num_envs=0: must be a whole number of at least 1"),
        (lambda: vector_env("simple", 1, "Never"), "autoreset_mode='Never': must be one of 'NextStep', 'SameStep'"),
        (lambda: vector_env("simple").step(np.zeros((1, 5))), "call reset first"),
        (lambda: vector_env("simple").reset(options={"reset_mask": np.array([1])}), "1 booleans"),
        (lambda: vector_env("simple", 2).reset(options={"reset_mask": np.array([True, False])}), "without it first"),
        (lambda: vector_env("simple", 2).reset(seed=[1, 2, 3]), "3 seeds for 2 environments"),
    ],
)
def test_what_is_refused(make, words):
    with pytest.raises((UserError, OptionError), match=words):
        make()


def test_actions_of_another_shape():
    env = vector_env("simple", 2)
    env.reset(seed=0)
    with pytest.raises(UserError, match=r"actions have the shape \[5\]; must be \[2, 5\]"):
        env.step(np.zeros(5))
