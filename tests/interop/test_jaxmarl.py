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
