"""point_reach against its rules written once more in NumPy, and against what makes it a task at all."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from matd3_jax.envs import Box, make


def numpy_step(pos, vel, target, force):
    """(pos, vel, reward) by the documented rules, agent by agent."""
    force = np.clip(force, -1, 1)
    vel = 0.75 * vel + 0.5 * force
    pos = pos + 0.1 * vel
    distances = [np.sqrt(((p - target) ** 2).sum()) for p in pos]
    return pos, vel, -np.mean(distances) - 0.01 * np.mean([(f**2).sum() for f in force])


@pytest.mark.parametrize(("num_agents", "dim"), [(2, 2), (3, 1)])
def test_steps(num_agents, dim):
    env = make("point_reach", num_agents=num_agents, dim=dim)
    assert env.action_spaces == (Box(dim, -1.0, 1.0),) * num_agents
    assert env.observation_sizes == ((1 + num_agents) * dim,) * num_agents
    assert sum(env.return_weights) == pytest.approx(1)
    rng = np.random.default_rng(0)
    state, _ = env.reset(jax.random.key(0))
    pos, vel, target = (np.asarray(x, np.float64) for x in (state.pos, state.vel, state.target))
    step = jax.jit(env.step)
    for t in range(25):
        force = rng.uniform(-1.5, 1.5, (num_agents, dim))  # partly beyond the bounds
        ts = step(None, state, tuple(jnp.asarray(force, jnp.float32)))
        pos, vel, reward = numpy_step(pos, vel, target, force)
        state = ts.state
        np.testing.assert_allclose(state.pos, pos, atol=1e-5)
        np.testing.assert_allclose(state.vel, vel, atol=1e-5)
        np.testing.assert_allclose(ts.reward, [reward] * num_agents, atol=1e-5)
        for i in range(num_agents):
            rest = [pos[j] - pos[i] for j in range(num_agents) if j != i]
            np.testing.assert_allclose(ts.observation[i], np.concatenate([vel[i], target - pos[i], *rest]), atol=1e-5)
        assert bool(ts.truncated) == (t == 24) and not ts.terminated


def test_one_step_by_hand():
    """A push of 1 from rest, 1 left of the target: v = 0.5, p = 0.05, distance 0.95, cost 0.01."""
    env = make("point_reach", num_agents=1, dim=1)
    state, _ = env.reset(jax.random.key(0))
    state = state._replace(pos=jnp.zeros((1, 1)), target=jnp.ones(1))
    ts = env.step(None, state, (jnp.ones(1),))
    np.testing.assert_allclose(ts.state.vel, [[0.5]])
    np.testing.assert_allclose(ts.reward, [-0.96], rtol=1e-6)
    np.testing.assert_allclose(ts.observation[0], [0.5, 0.95], rtol=1e-6)


def test_reset():
    env = make("point_reach")
    state, observation = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), 4000))
    place = np.concatenate([state.pos, state.target[:, None]], axis=1).reshape(4000, 6)
    assert np.abs(place).max() <= 1
    assert np.abs(place.mean(axis=0)).max() < 5 / np.sqrt(3 * 4000)
    assert np.abs((place**2).mean(axis=0) - 1 / 3).max() < 5 * np.sqrt(4 / 45 / 4000)
    assert not np.any(state.vel)
    chex.assert_trees_all_equal(observation, jax.vmap(env.observe)(state))


def test_acting_on_what_is_seen_pays():
    """Steering at the target from the observation alone halves the cost of doing nothing; noise only adds to it."""
    env = make("point_reach")

    def steer(observation, key):
        return tuple(jnp.clip(6 * o[2:4] - 2 * o[:2], -1, 1) for o in observation)

    def rest(observation, key):
        return (jnp.zeros(2),) * 2

    def noise(observation, key):
        return tuple(jax.random.uniform(k, (2,), minval=-1.0) for k in jax.random.split(key))

    def episode(policy, key):
        def step(carry, key):
            ts = env.step(None, carry[0], policy(carry[1], key))
            return (ts.state, ts.observation), ts.reward[0]

        return jax.lax.scan(step, env.reset(key), jax.random.split(key, env.episode_length))[1].sum()

    keys = jax.random.split(jax.random.key(1), 500)
    steered, rested, noisy = (
        float(jax.jit(jax.vmap(lambda k: episode(policy, k)))(keys).mean())  # noqa: B023
        for policy in (steer, rest, noise)
    )
    assert -steered < -rested / 2 and -rested < -noisy


def test_slopes_are_finite_on_the_target():
    env = make("point_reach")
    state, _ = env.reset(jax.random.key(0))
    state = state._replace(pos=jnp.zeros((2, 2)), target=jnp.zeros(2))
    slope = jax.grad(lambda pos: env.step(None, state._replace(pos=pos), (jnp.zeros(2),) * 2).reward[0])(state.pos)
    assert np.isfinite(slope).all()
