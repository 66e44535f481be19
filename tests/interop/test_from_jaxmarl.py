"""Environments of JaxMARL against JaxMARL's own steps; what needs no JaxMARL against small ones of its interface."""

import importlib.util
import sys

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxmarl_like import Endless, Images, Line

import matd3_jax
from matd3_jax import config, envs
from matd3_jax.envs import Box, Discrete, OptionError
from matd3_jax.interop.import_jaxmarl import import_jaxmarl
from matd3_jax.interop.jaxmarl import JaxMARL

installed = pytest.mark.skipif(
    importlib.util.find_spec("jaxmarl") is None, reason="JaxMARL is not installed (the extra 'jaxmarl')"
)


def play(env, actions):
    """The time steps of an episode from key 0 in which every agent does the same each time."""
    state, observation = env.reset(jax.random.key(0))
    step, found = jax.jit(env.step), []
    for t, action in enumerate(actions):
        taken = tuple(jnp.asarray(action, jnp.float32) for _ in env.agents)
        found.append(step(jax.random.key(t), state, taken))
        state = found[-1].state
    return found


def test_terminations_are_told_from_the_time_limit():
    env = envs.from_jaxmarl(Line())
    envs.check(env)
    assert env.episode_length == 5 and env.teams == ("agents", "adversaries")
    still = [-1.0 + 2 / 2, -1.0]  # (0, 0) in its own bounds
    ended = [(bool(ts.terminated), bool(ts.truncated)) for ts in play(env, [still] * 5)]
    assert ended == [(False, False)] * 4 + [(False, True)]
    ended = [(bool(ts.terminated), bool(ts.truncated)) for ts in play(env, [[1.0, 0.0], [1.0, 0.0]])]
    assert ended == [(False, False), (True, False)]  # at 3, at 6
    # The task ends in the very step in which the time is up: nothing is bootstrapped.
    assert [bool(ts.terminated) for ts in play(env, [still] * 4 + [[1.0, 1.0]])] == [False] * 4 + [True]


def test_boxes_of_different_bounds_are_scaled():
    env = envs.from_jaxmarl(Line())
    assert env.action_spaces == (Box(2, -1.0, 1.0), Box(2, -1.0, 1.0))
    rewards = [float(ts.reward[0]) for ts in play(env, [[-1, -1], [1, -1], [-1, 1], [0, 0]])]
    np.testing.assert_allclose(rewards, [-1, 1, 3, 2], atol=1e-6)  # sums of (-1, 0), (1, 0), (-1, 4), (0, 2)
    same = envs.from_jaxmarl(Line(low=(-2.0, -2.0), high=(3.0, 3.0)))
    assert same.action_spaces[0] == Box(2, -2.0, 3.0)
    np.testing.assert_allclose(play(same, [[1.25, -0.5]])[0].reward, [0.75, 0.75])


def test_pictures_and_their_global_state():
    env = envs.from_jaxmarl(Images())
    envs.check(env)
    assert env.observation_sizes == (6, 6) and env.full_observation_size == 2
    ts = play(env, [[0.5, 0.0]])[0]
    np.testing.assert_array_equal(ts.observation[1], np.ones(6, np.float32))
    np.testing.assert_allclose(env.full_observation(ts.state), [2.5, 2.5])


def test_a_time_limit_of_our_own():
    with pytest.raises(OptionError, match="Endless has no time limit: give episode_length"):
        envs.from_jaxmarl(Endless())
    env = envs.from_jaxmarl(Endless(), episode_length=2)
    still = [0.0, -1.0]
    assert [bool(ts.truncated) for ts in play(env, [still] * 2)] == [False, True]
    assert [bool(ts.truncated) for ts in play(envs.from_jaxmarl(Line(), episode_length=3), [still] * 3)][-1]
    with pytest.raises(OptionError, match="episode_length=9: Line ends episodes after 5 env steps by itself"):
        envs.from_jaxmarl(Line(), episode_length=9)


def test_ours_there_and_back_again():
    """Through JaxMARL's interface and back: infos say what the time limit ended."""
    ours = envs.make("simple_push", actions="discrete", episode_length=3)
    env = envs.from_jaxmarl(JaxMARL(ours), episode_length=3)
    envs.check(env)
    assert env.action_spaces == ours.action_spaces and env.teams == ours.teams
    state, observation = env.reset(jax.random.key(3))
    want_state, want = ours.reset(jax.random.key(3))
    chex.assert_trees_all_close(observation, want)
    for t in range(3):
        action = (jnp.int32(t), jnp.int32(4 - t))
        ts, want = env.step(jax.random.key(t), state, action), ours.step(jax.random.key(t), want_state, action)
        chex.assert_trees_all_close(
            (ts.observation, ts.reward, ts.terminated, ts.truncated),
            (want.observation, want.reward, want.terminated, want.truncated),
            atol=1e-6,
        )
        state, want_state = ts.state, want.state
    assert ts.truncated and not ts.terminated


@pytest.mark.parametrize(
    ("env", "words"),
    [
        (object(), "object is no environment of JaxMARL: it has no agents, reset"),
        (Line(low=(-np.inf, 0.0)), "no finite bounds"),
    ],
)
def test_what_is_refused(env, words):
    with pytest.raises(OptionError, match=words):
        envs.from_jaxmarl(env)


def test_one_that_resets_by_itself_is_refused():
    env = Line()
    env.auto_reset = True
    with pytest.raises(OptionError, match="Line resets by itself within a step: make it with auto_reset=False"):
        envs.from_jaxmarl(env)


def test_without_jaxmarl(monkeypatch):
    monkeypatch.setitem(sys.modules, "jaxmarl", None)
    with pytest.raises(OptionError, match=r"env=jaxmarl needs the extra 'jaxmarl': pip install 'matd3_jax\[jaxmarl\]'"):
        envs.make("jaxmarl", id="MPE_simple_v3")


def test_settings():
    settings = config.load(["env=jaxmarl", "env.id=ant_4x2", "env.kwargs.backend=spring", "recipe=fast"])
    assert settings.env["kwargs"] == {"backend": "spring"} and settings.recipe == "fast"
    assert config.load(["env=jaxmarl", "env.id=MPE_simple_v3"]).recipe == "paper"


# ---- with JaxMARL ----------------------------------------------------------------------------------------------------


@installed
def test_ids_and_options():
    with pytest.raises(OptionError, match="needs an id"):
        envs.make("jaxmarl")
    with pytest.raises(OptionError, match="no such environment; did you mean 'MPE_simple_tag_v3'"):
        envs.make("jaxmarl", id="MPE_simpel_tag_v3")
    with pytest.raises(OptionError, match="env.id=jaxnav: JaxMARL cannot make it with kwargs=.*beams"):
        envs.make("jaxmarl", id="jaxnav", kwargs={"beams": 3})
    assert envs.make("jaxmarl", id="MPE_simple_v3") == envs.make("jaxmarl", id="MPE_simple_v3", kwargs={})
    assert envs.make("jaxmarl", id="MPE_simple_v3", kwargs={"max_steps": 9}).episode_length == 10


@installed
def test_importing_it_leaves_the_streams_alone(capsys):
    before = sys.stdout, sys.stderr
    import_jaxmarl("this test")
    assert (sys.stdout, sys.stderr) == before
    assert "Importing" not in capsys.readouterr().out


@installed
@pytest.mark.parametrize(
    ("id", "adversaries", "length"),
    [
        ("MPE_simple_tag_v3", 3, 26),
        ("MPE_simple_world_comm_v3", 4, 26),
        ("MPE_simple_crypto_v3", 1, 26),
        ("MPE_simple_speaker_listener_v4", 0, 26),
        ("HeuristicEnemySMAX", 0, 100),
        ("jaxnav", 0, 500),
    ],
)
def test_theirs_keep_the_contract(id, adversaries, length):
    env = envs.make("jaxmarl", id=id)
    envs.check(env)
    assert env.teams.count("adversaries") == adversaries and env.episode_length == length
    assert sum(env.return_weights) == pytest.approx(len(set(env.teams)))


@installed
@pytest.mark.parametrize("action_type", ["Discrete", "Continuous"])
def test_the_numbers_are_those_of_step_env(action_type):
    """A whole episode of MPE, which never terminates: its `done` is the time limit, after 26 env steps."""
    jaxmarl = import_jaxmarl("this test")
    theirs = jaxmarl.make("MPE_simple_spread_v3", num_agents=2, num_landmarks=2, action_type=action_type)
    env = envs.make(
        "jaxmarl",
        id="MPE_simple_spread_v3",
        kwargs={"num_agents": 2, "num_landmarks": 2, "action_type": action_type},
    )
    assert env.action_spaces[0] == (Discrete(5) if action_type == "Discrete" else Box(5, 0.0, 1.0))
    key = jax.random.key(5)
    state, observation = env.reset(key)
    want_obs, want_state = theirs.reset(key)
    step, ends = jax.jit(env.step), []
    for _ in range(26):
        key, action_key, step_key = jax.random.split(key, 3)
        sampled = [s.sample(k) for s, k in zip(env.action_spaces, jax.random.split(action_key), strict=True)]
        ts = step(step_key, state, tuple(sampled))
        want_obs, want_state, rewards, dones, _ = theirs.step_env(
            step_key, want_state, dict(zip(theirs.agents, sampled, strict=True))
        )
        np.testing.assert_allclose(ts.reward, [rewards[a] for a in theirs.agents], rtol=1e-5)
        for seen, agent in zip(ts.observation, theirs.agents, strict=True):
            np.testing.assert_allclose(seen, want_obs[agent], atol=1e-5)
        assert bool(ts.terminated | ts.truncated) == bool(dones["__all__"])
        ends.append((bool(ts.terminated), bool(ts.truncated)))
        state = ts.state
    assert ends == [(False, False)] * 25 + [(False, True)]


@installed
def test_crashes_of_jaxnav_terminate_and_its_clock_truncates():
    env = envs.make("jaxmarl", id="jaxnav", kwargs={"lidar_num_beams": 10, "max_steps": 50})
    state, _ = env.reset(jax.random.key(0))
    action = tuple(jnp.zeros(2) for _ in env.agents)
    step = jax.jit(env.step)

    def ended(crashed, at):
        inner = state.inner.replace(move_term=jnp.full(2, crashed), step=jnp.int32(at))
        ts = step(jax.random.key(1), state._replace(inner=inner, step=jnp.int32(at)), action)
        return bool(ts.terminated), bool(ts.truncated)

    assert ended(False, 3) == (False, False)
    assert ended(True, 3) == (True, False)
    assert ended(False, 49) == (False, True)
    assert ended(True, 49)[0]


@installed
@pytest.mark.slow
def test_mabrax_says_itself_what_was_truncated():
    env = envs.make("jaxmarl", id="hopper_3x1", kwargs={"episode_length": 3, "backend": "spring"})
    envs.check(env)
    assert env.episode_length == 3 and env.full_observation_size == 11  # brax's observation, each agent a part of it
    state, observation = env.reset(jax.random.key(0))
    step, ends = jax.jit(env.step), []
    for t in range(3):
        ts = step(jax.random.key(t), state, tuple(jnp.zeros(1) for _ in env.agents))
        ends.append((bool(ts.terminated), bool(ts.truncated)))
        state = ts.state
    assert ends == [(False, False), (False, False), (False, True)]
    assert np.isfinite(env.full_observation(state)).all()
    with pytest.raises(OptionError, match="auto_reset=False"):
        envs.make("jaxmarl", id="hopper_3x1", kwargs={"auto_reset": True})


@installed
def test_our_simple_spread_is_theirs_by_the_rules_of_mpe2():
    """Means over agents of random play, 26 env steps each, within what 600 episodes tell."""

    def returns(env):
        def episode(key):
            reset_key, key = jax.random.split(key)
            state, _ = env.reset(reset_key)

            def body(state, key):
                keys = jax.random.split(key, 4)
                action = tuple(space.sample(k) for space, k in zip(env.action_spaces, keys[1:], strict=True))
                ts = env.step(keys[0], state, action)
                return ts.state, ts.reward.mean()

            return jax.lax.scan(body, state, jax.random.split(key, 26))[1].sum()

        return np.asarray(jax.jit(jax.vmap(episode))(jax.random.split(jax.random.key(0), 600)))

    theirs = returns(envs.make("jaxmarl", id="MPE_simple_spread_v3"))
    ours = returns(envs.make("simple_spread", rules="mpe2", actions="discrete", episode_length=26))
    error = np.hypot(theirs.std(), ours.std()) / np.sqrt(600)
    assert -29 < theirs.mean() < -26  # -27.5 in 2,000 episodes
    assert abs(theirs.mean() - ours.mean()) < 4 * error


@installed
@pytest.mark.slow
def test_a_run_learns():
    """Random play has a return of -27.5, standing still one of -25.1 (2,000 episodes each)."""
    result = matd3_jax.train(
        *("env.id=MPE_simple_spread_v3", "seeds=1", "total_steps=80_000", "learning_starts=5_000", "num_envs=20"),
        *("rollout_length=5", "batch_size=256", "replay_capacity=100_000", "eval_every=0"),
        env="jaxmarl",
    )
    assert result.evaluate(episodes=100).mean() > -23
