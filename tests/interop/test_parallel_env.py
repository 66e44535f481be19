"""Environments here through PettingZoo's parallel interface: its own tests, and steps against direct calls."""

import sys
import warnings

import jax
import numpy as np
import pytest

from matd3_jax import envs
from matd3_jax.errors import OptionError, UserError
from matd3_jax.interop.to_pettingzoo import parallel_env

pytest.importorskip("pettingzoo", reason="PettingZoo is not installed (the extra 'pettingzoo')")

CASES = [
    ("simple_tag", {}),
    ("simple_world_comm", {"actions": "discrete"}),
    ("simple_push", {"actions": "continuous"}),
    ("point_reach", {}),
]


@pytest.mark.parametrize(("name", "options"), CASES, ids=[name for name, _ in CASES])
def test_pettingzoos_own_tests(name, options):
    """They warn of what they do not like."""
    from pettingzoo.test import parallel_api_test, parallel_seed_test

    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        parallel_api_test(parallel_env(name, episode_length=5, **options), num_cycles=8)
        parallel_seed_test(lambda: parallel_env(name, episode_length=5, **options), num_cycles=5)


def test_steps_are_those_of_the_environment():
    inner = envs.make("simple_tag", episode_length=4)
    env, step = parallel_env(inner), jax.jit(inner.step)
    observations, infos = env.reset(seed=7)
    key, now = jax.random.split(jax.random.key(7))
    state, want = inner.reset(now)
    assert env.agents == list(inner.agents) == list(observations) == list(infos)
    for t in range(4):
        actions = {agent: env.action_space(agent).sample() for agent in reversed(env.agents)}
        key, now = jax.random.split(key)
        ts = step(now, state, tuple(actions[agent] for agent in inner.agents))
        state = ts.state
        observations, rewards, terminations, truncations, infos = env.step(actions)
        for agent, seen, reward in zip(inner.agents, ts.observation, ts.reward, strict=True):
            np.testing.assert_allclose(observations[agent], seen, atol=1e-5)
            assert env.observation_space(agent).contains(observations[agent])
            assert rewards[agent] == pytest.approx(float(reward), abs=1e-5) and isinstance(rewards[agent], float)
        np.testing.assert_allclose(env.state(), inner.full_observation(state), atol=1e-5)
        assert env.state_space.contains(env.state())
        assert terminations == dict.fromkeys(inner.agents, False)
        assert truncations == dict.fromkeys(inner.agents, t == 3)
    assert env.agents == []
    with pytest.raises(UserError, match="the episode is over; call reset"):
        env.step(actions)


def test_a_termination_is_no_truncation():
    class Wall(type(envs.make("point_reach"))):
        """Ends, as a task, in its second step."""

        def step(self, key, state, action):
            ts = super().step(key, state, action)
            return ts._replace(terminated=ts.state.step == 2)

    env = parallel_env(Wall())
    env.reset(seed=0)
    actions = {agent: env.action_space(agent).sample() for agent in env.agents}
    assert not any(env.step(actions)[2].values())
    _, _, terminations, truncations, _ = env.step(actions)
    assert all(terminations.values()) and not any(truncations.values()) and env.agents == []


def test_seeds_and_the_episodes_after_them():
    one, other = (parallel_env("simple_push") for _ in range(2))
    first = one.reset(seed=3)[0]["agent_0"]
    second = one.reset()[0]["agent_0"]
    assert np.abs(first - second).max() > 0.01
    other.reset(seed=3)
    np.testing.assert_array_equal(other.reset()[0]["agent_0"], second)
    unseeded = [parallel_env("simple_push").reset()[0]["agent_0"] for _ in range(2)]
    assert np.abs(unseeded[0] - unseeded[1]).max() > 0.01


def test_soft_choices_have_a_space_of_their_own():
    from gymnasium.spaces import Box, Discrete

    env = parallel_env("simple_world_comm")
    space = env.action_space("leadadversary_0")
    assert isinstance(space, Box) and space.shape == (9,) and space.sizes == (5, 4)
    space.seed(0)
    drawn = np.stack([space.sample() for _ in range(4000)])
    assert all(map(space.contains, drawn)) and drawn.dtype == np.float32
    np.testing.assert_allclose(drawn[:, :5].sum(axis=1), 1, atol=1e-5)
    ours = jax.vmap(env.env.action_spaces[0].sample)(jax.random.split(jax.random.key(0), 4000))
    for moment in (np.mean, np.std):  # as our own space draws; 0.005 is over three standard errors
        np.testing.assert_allclose(moment(drawn, axis=0), moment(np.asarray(ours), axis=0), atol=0.02)
    for wrong in (np.full(9, 0.2), np.eye(9)[0], np.full(8, 0.2, np.float32), "a", -drawn[0]):
        assert not space.contains(wrong)
    assert space.contains(np.eye(5)[[0]].ravel().tolist() + [0, 0, 0, 1])
    assert isinstance(parallel_env("simple_push", actions="discrete").action_space("agent_0"), Discrete)


def test_pictures():
    env = parallel_env("simple_tag", render_mode="rgb_array", size=120)
    assert env.metadata["render_modes"] == ["rgb_array"] and env.metadata["render_fps"] == 10
    with pytest.raises(UserError, match="call reset first"):
        env.render()
    env.reset(seed=0)
    before = env.render()
    assert before.dtype == np.uint8 and before.ndim == 3 and max(before.shape) == 120 and before.shape[2] == 3
    for _ in range(5):
        env.step({agent: np.eye(5, dtype=np.float32)[1] for agent in env.agents})
    assert (env.render() != before).any()
    assert parallel_env("simple_tag").render() is None


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: parallel_env("simple_tga"), "did you mean 'simple_tag'"),
        (lambda: parallel_env("simple_tag", num_godo=2), "no option 'num_godo'"),
        (lambda: parallel_env("simple_tag", render_mode="human"), "render_mode='human': must be 'rgb_array' or None"),
        (lambda: parallel_env(envs.make("simple_tag"), num_good=2), "num_good: options go with an environment's name"),
        (lambda: parallel_env(3), "no environment"),
        (lambda: parallel_env("simple_tag").state(), "state: call reset first"),
    ],
)
def test_what_is_refused(make, words):
    with pytest.raises((UserError, OptionError), match=words):
        make()


def test_every_agent_has_to_act():
    env = parallel_env("simple_push", actions="discrete")
    env.reset(seed=0)
    with pytest.raises(UserError, match="no action for 'agent_0'; did you mean 'agent_1'"):
        env.step({"adversary_0": 0, "agent_1": 1})


def test_without_pettingzoo(monkeypatch):
    monkeypatch.delitem(sys.modules, "matd3_jax.interop.parallel_environment", raising=False)
    monkeypatch.setitem(sys.modules, "pettingzoo", None)
    with pytest.raises(UserError, match=r"needs the extra 'pettingzoo': pip install 'matd3_jax\[pettingzoo\]'"):
        parallel_env("simple_tag")
