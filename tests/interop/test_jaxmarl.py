"""The JaxMARL convention against direct calls of the environment."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from matd3_jax.envs import Box, Discrete, make
from matd3_jax.interop.jaxmarl import JaxMARL


def test_names_and_spaces():
    env = JaxMARL(make("simple_tag", actions="discrete"))
    assert env.agents == ["adversary_0", "adversary_1", "adversary_2", "agent_0"] and env.num_agents == 4
    assert env.action_space("agent_0") == Discrete(5) and env.action_space("agent_0").n == 5
    assert env.observation_space("agent_0") == Box(14) and env.observation_space("adversary_1").shape == (16,)
    assert env.agent_classes == {"adversaries": env.agents[:3], "agents": ["agent_0"]}
    assert env.name == "SimpleTag"
    with pytest.raises(KeyError):
        env.action_space("agent_1")
    assert hash(env) == hash(JaxMARL(make("simple_tag", actions="discrete")))


def test_an_episode_and_the_reset_behind_it():
    inner = make("simple_push", actions="discrete", episode_length=3)
    env, key = JaxMARL(inner), jax.random.key(0)
    obs, state = env.reset(key)
    want_state, want = jax.jit(inner.reset)(key)
    chex.assert_trees_all_close((tuple(obs.values()), state), (want, want_state), atol=1e-6)
    assert list(obs) == env.agents
    step = jax.jit(inner.step)
    for t in range(3):
        key, key_step = jax.random.split(key)
        actions = {"agent_0": jnp.int32(t + 1), "adversary_0": jnp.int32(4 - t)}  # order does not matter
        ts = step(key_step, want_state, (actions["adversary_0"], actions["agent_0"]))
        obs, state, rewards, dones, infos = env.step(key_step, state, actions)
        want_state, last = ts.state, t == 2
        np.testing.assert_allclose([rewards[a] for a in env.agents], ts.reward, atol=1e-6)
        assert {k: bool(v) for k, v in dones.items()} == dict.fromkeys([*env.agents, "__all__"], last)
        assert bool(infos["truncated"]) == last and not infos["terminated"]
        chex.assert_trees_all_close(tuple(infos["final_observation"][a] for a in env.agents), ts.observation, atol=1e-6)
        if not last:
            chex.assert_trees_all_close(state, want_state, atol=1e-6)
            chex.assert_trees_all_close(tuple(obs[a] for a in env.agents), ts.observation, atol=1e-6)
    # After the last step: a new episode, from the second half of the step's key.
    fresh_state, fresh = jax.jit(inner.reset)(jax.random.split(key_step)[1])
    chex.assert_trees_all_close((tuple(obs[a] for a in env.agents), state), (fresh, fresh_state), atol=1e-6)
    assert np.abs(obs["agent_0"] - infos["final_observation"]["agent_0"]).max() > 0.01


def test_step_env_does_not_reset_and_reset_state_is_used():
    inner = make("simple_push", actions="discrete", episode_length=1)
    env = JaxMARL(inner)
    _, state = env.reset(jax.random.key(0))
    obs_a, other = env.reset(jax.random.key(7))
    actions = {agent: jnp.int32(0) for agent in env.agents}
    _, state_1, _, dones, _ = env.step_env(jax.random.key(1), state, actions)
    assert dones["__all__"] and state_1.step == 1
    obs, state_2, *_ = env.step(jax.random.key(1), state, actions, other)
    chex.assert_trees_all_close((obs, state_2), (obs_a, other), atol=1e-6)


def test_vmap_over_environments_that_end_apart():
    inner = make("simple_push", actions="discrete", episode_length=3)
    env = JaxMARL(inner)
    _, state = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), 3))
    state = state._replace(step=jnp.array([0, 2, 1], jnp.int32))
    actions = {agent: jnp.zeros(3, jnp.int32) for agent in env.agents}
    _, after, _, dones, _ = jax.vmap(env.step)(jax.random.split(jax.random.key(1), 3), state, actions)
    np.testing.assert_array_equal(dones["__all__"], [False, True, False])
    np.testing.assert_array_equal(after.step, [1, 0, 2])
    moved = np.abs(after.landmark - state.landmark).max(axis=(1, 2)) > 0
    np.testing.assert_array_equal(moved, [False, True, False])


def test_all_choices_are_available():
    env = JaxMARL(make("simple_crypto", actions="discrete"))
    _, state = env.reset(jax.random.key(0))
    np.testing.assert_array_equal(env.get_avail_actions(state)["bob_0"], np.ones(4))
    assert JaxMARL(make("point_reach")).get_avail_actions(None) == {}


def test_jaxmarls_log_wrapper_counts_episodes():
    wrappers = pytest.importorskip("jaxmarl.wrappers.baselines", reason="the extra 'jaxmarl' is not installed")
    inner = JaxMARL(make("simple_spread", actions="discrete", episode_length=2))
    env = wrappers.LogWrapper(inner, replace_info=True)
    _, state = env.reset(jax.random.key(0))
    actions = {agent: jnp.int32(1) for agent in env.agents}
    total = np.zeros(3)
    for t in range(2):
        _, state, rewards, dones, infos = env.step(jax.random.key(t), state, actions)
        total += [float(rewards[agent]) for agent in env.agents]
    assert dones["__all__"] and {leaf.shape for leaf in jax.tree.leaves(infos)} == {(3,)}  # as baselines reshape them
    np.testing.assert_allclose(infos["returned_episode_returns"], total, rtol=1e-5)
    np.testing.assert_array_equal(infos["returned_episode_lengths"], [2, 2, 2])


def test_jaxmarls_rollout_manager_takes_its_own_spaces():
    """That of its Q-learning, with agents of different sizes."""
    wrappers = pytest.importorskip("jaxmarl.wrappers.baselines", reason="the extra 'jaxmarl' is not installed")
    inner = make("simple_tag", actions="discrete", episode_length=2)
    manager = wrappers.CTRolloutManager(JaxMARL(inner, own_spaces=True), batch_size=2)
    observations, state = manager.batch_reset(jax.random.key(0))
    assert observations["agent_0"].shape == (2, 16 + 4) and observations["__all__"].shape == (2, 3 * 16 + 14)
    actions = {agent: manager.batch_sample(jax.random.key(0), agent) for agent in manager.agents}
    observations, state, rewards, dones, _ = manager.batch_step(jax.random.key(1), state, actions)
    assert not dones["__all__"].any() and rewards["__all__"].shape == (2,)
    soft = JaxMARL(make("simple_tag"), own_spaces=True).action_space("agent_0")
    assert (soft.low, soft.high, soft.shape) == (0.0, 1.0, (5,))
