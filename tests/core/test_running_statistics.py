"""Observation normalization: statistics against NumPy over everything collected, and wherever networks read."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from learner_cases import layers
from ledger import HYPER

from matd3_jax.core import rollout, running_statistics
from matd3_jax.core.agents import JointLayout
from matd3_jax.core.algorithm import Algorithm
from matd3_jax.core.running_statistics import Statistics
from matd3_jax.envs import make
from matd3_jax.training import checkpoint
from matd3_jax.training.loop import TrainLoop
from matd3_jax.training.schedule import Schedule

SEEDS, CAPACITY = 3, 48
ENV = make("point_reach", num_agents=2, dim=2)  # Box actions: without noise they are known from the observation
ALGORITHM = Algorithm(name="maddpg", hidden=(6,), num_critics=1, policy_delay=1)
SCHEDULE = Schedule(num_envs=3, rollout_length=4, batch_size=8, replay_capacity=CAPACITY, learning_starts=36)


def trainer(n_step=1, normalize=True):
    layout = JointLayout.of(ENV, {"agents": ALGORITHM}, n_step)
    hyper = {"agents": HYPER._replace(exploration_noise=0.0)}
    return TrainLoop(ENV, layout, SCHEDULE, hyper, SEEDS, normalize_observations=normalize)


def in_numpy(state):
    return jax.tree.map(np.asarray, state._replace(key=()))


@functools.cache
def run():
    """(trainer, its states after the warm-up and after each of six rollouts, rows [seeds, n, row] of all play)."""
    t = trainer()
    state, _ = t.warm_up(t.init(jax.vmap(jax.random.key)(jnp.arange(SEEDS))))
    states = [in_numpy(state)]
    rows = [states[0].replay[:SEEDS, : 2 * SCHEDULE.rollout_steps]]
    interval = t.interval(1)
    for _ in range(6):
        at = int(state.rollouts) * SCHEDULE.rollout_steps % CAPACITY
        state, _ = interval(state)
        states.append(in_numpy(state))
        rows.append(states[-1].replay[:SEEDS, at : at + SCHEDULE.rollout_steps])
    return t, state, states, rows


def by_numpy(statistics, x):
    """Normalized observations in float64, written from what docs/algorithms.md says."""
    mean, variance = (np.asarray(part, np.float64) for part in statistics)
    return np.clip((x - mean) / np.sqrt(variance + 1e-8), -10, 10)


def of_seed(statistics, seed):
    return Statistics(*(part[seed] for part in statistics))


# ---- the statistics --------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_statistics_of_everything_collected():
    """After the warm-up and after each rollout, also when the ring has dropped the first rows: mean and variance of
    each entry over all observations acted on, for each seed its own."""
    _, _, states, rows = run()
    for k, state in enumerate(states):
        x = np.concatenate(rows[: k + 1], axis=1)[..., :12].astype(np.float64)
        assert x.shape[1] == (2 + k) * SCHEDULE.rollout_steps
        # float32: a handful of means of means; entries are of order 1.
        np.testing.assert_allclose(state.statistics.mean[:SEEDS], x.mean(axis=1), atol=1e-6)
        np.testing.assert_allclose(state.statistics.variance[:SEEDS], x.var(axis=1), rtol=1e-5, atol=1e-8)
    assert x.shape[1] > CAPACITY
    assert np.abs(np.diff(states[-1].statistics.mean[:SEEDS], axis=0)).max() > 0.01


def test_float32_lasts():
    """20,000 rollouts of entries far from zero, drifting, nearly constant and constant."""
    rng = np.random.default_rng(0)
    rollouts, n = 20_000, 10
    drift = np.linspace(0, 5, rollouts)[:, None, None]
    x = rng.normal(size=(rollouts, n, 4)) * [1, 1, 1e-3, 0] + [1000, 0, 1, 0.1] + drift * [0, 1, 0, 0]
    x = x.astype(np.float32)

    def step(statistics, inputs):
        return running_statistics.merge(statistics, *inputs), None

    got, _ = jax.jit(lambda x: jax.lax.scan(step, running_statistics.initial(4), (x, jnp.arange(rollouts))))(x)
    flat = x.reshape(-1, 4).astype(np.float64)
    # In standard deviations (1e-4 for the constant one), where float32 itself resolves 1000 to 6e-5.
    error = np.abs(got.mean - flat.mean(axis=0)) / np.maximum(flat.std(axis=0), 1e-4)
    assert error.max() < 0.01
    np.testing.assert_allclose(got.variance[:3], flat.var(axis=0)[:3], rtol=0.01)
    assert 0 <= got.variance[3] < 1e-12


def test_bounds():
    """Normalized values stop at +-10, constant entries give 0, and at the start nothing changes but for the bound."""
    statistics = Statistics(jnp.array([1.0, 0.5]), jnp.array([4.0, 0.0]))
    got = running_statistics.normalize(statistics, jnp.array([[3.0, 0.5], [100.0, 0.6], [-100.0, 0.4]]))
    np.testing.assert_allclose(got, [[1, 0], [10, 10], [-10, -10]], atol=1e-6)
    x = jnp.array([[-3.0, 0.7, 20.0]])
    np.testing.assert_allclose(
        running_statistics.normalize(running_statistics.initial(3), x), [[-3.0, 0.7, 10.0]], rtol=1e-6
    )


def test_a_floor_keeps_small_what_hardly_ever_moves():
    """Deviations below the floor count as the floor, others as they are: of what networks read, not of what is kept."""
    statistics = Statistics(jnp.array([1.0, 0.5, 0.0]), jnp.array([4.0, 0.0, 1e-6]))
    x = jnp.array([[3.0, 0.6, 0.02]])
    got = running_statistics.normalize(running_statistics.floored(statistics, 0.1), x)
    np.testing.assert_allclose(got, [[1, 1, 0.2]], atol=1e-5)
    assert running_statistics.normalize(statistics, x)[0, 2] > 9
    t, state, _, _ = run()
    t.learner.least_deviation = 0.4
    try:
        for seed in range(SEEDS):
            kept, read = of_seed(state.statistics, seed), of_seed(t.policy(state).statistics, seed)
            np.testing.assert_allclose(read.variance, np.maximum(kept.variance, 0.16), rtol=1e-6)
            np.testing.assert_array_equal(read.mean, kept.mean)
            assert (kept.variance < 0.16).any() and (kept.variance > 0.16).any()
            rows = np.asarray(t.learner.minibatches(state, [HYPER], seed, jnp.arange(5)))
            raw = np.asarray(state.replay[seed, :5])
            want = (raw[:, :12] - kept.mean) / np.sqrt(np.maximum(kept.variance, 0.16))
            np.testing.assert_allclose(rows[:, :12], np.clip(want, -10, 10), rtol=1e-4, atol=1e-5)
    finally:
        t.learner.least_deviation = 0.0


# ---- where networks read ---------------------------------------------------------------------------------------------


def actions(groups, seed, x):
    """What both agents do for joint observations x [n, 12] as their networks read them, in float64."""
    outputs = [reference.forward(layers(groups[0].actor, seed, k), x[:, 6 * k : 6 * k + 6])[0] for k in range(2)]
    return np.concatenate([2 / (1 + np.exp(-output)) - 1 for output in outputs], axis=1)


@pytest.mark.parametrize("collect", [1, 5])
def test_collecting_reads_normalized_observations(collect):
    """Without noise the stored actions are those of the actors, as they were, on the stored observations in units of
    the statistics of all rollouts before; the replay keeps observations raw (they are what the environment gives)."""
    _, _, states, rows = run()
    before = states[collect - 1]
    for seed in range(SEEDS):
        x = rows[collect][seed, :, :12]
        want = actions(before.groups, seed, by_numpy(of_seed(before.statistics, seed), x))
        np.testing.assert_allclose(rows[collect][seed, :, 12:16], want, atol=1e-5)
        assert np.abs(want - actions(before.groups, seed, x)).max() > 1e-3
    # Positions after an env step: p' = p + 0.1 v', here of agent 0 relative to the target.
    row = rows[collect][0]
    np.testing.assert_allclose(row[:, 20:22], row[:, 2:4] - 0.1 * row[:, 18:20], atol=1e-6)


def test_evaluation_reads_normalized_observations():
    """A deterministic episode of one env step, by hand."""
    t, state, states, _ = run()
    seed = 1
    policy = jax.tree.map(lambda leaf: leaf[seed], t.policy(state))
    env = make("point_reach", num_agents=2, dim=2, episode_length=1)
    key = jax.random.key(3)
    found = rollout.evaluate(env, t.layout, policy, key, 5, deterministic=True)
    first, observation = jax.vmap(env.reset)(jax.random.split(jax.random.split(key)[0], 5))
    x = np.concatenate(observation, axis=1).astype(np.float64)
    force = actions(states[-1].groups, seed, by_numpy(of_seed(states[-1].statistics, seed), x)).reshape(5, 2, 2)
    # At rest at the start: v' = 0.5 u, p' = p + 0.05 u.
    distance = np.linalg.norm(np.asarray(first.pos) + 0.05 * force - np.asarray(first.target)[:, None], axis=2)
    reward = -distance.mean(axis=1) - 0.01 * (force**2).sum(axis=2).mean(axis=1)
    np.testing.assert_allclose(found.episode_return, np.stack([reward, reward], axis=1), atol=1e-5)


@pytest.mark.parametrize("n_step", [1, 3])
def test_updates_read_normalized_observations(n_step):
    """x and x' of minibatches in the units of the seed's statistics as they are now; nothing else in a row changes.
    Some entries reach the bound."""
    _, state, states, _ = run()
    state = state._replace(statistics=state.statistics._replace(variance=state.statistics.variance / 20))
    t, plain = trainer(n_step), trainer(n_step, normalize=False)
    next_x = slice(18, 30)
    if n_step > 1:  # one entry more, before x'
        rows = jnp.split(state.replay, [18], axis=-1)
        state = state._replace(replay=jnp.concatenate([rows[0], jnp.ones_like(rows[0][..., :1]), rows[1]], axis=-1))
        next_x = slice(19, 31)
    indices = jnp.arange(CAPACITY).reshape(2, -1)
    columns = np.zeros(t.layout.row_size, bool)
    columns[:12] = columns[next_x] = True
    for seed in range(SEEDS):
        got = np.asarray(jax.jit(t.learner.minibatches)(state, [HYPER], seed, indices))
        raw = np.asarray(plain.learner.minibatches(state._replace(statistics=None), [HYPER], seed, indices))
        np.testing.assert_array_equal(got[..., ~columns], raw[..., ~columns])
        statistics = of_seed(in_numpy(state).statistics, seed)
        for part in (slice(0, 12), next_x):
            want = by_numpy(statistics, raw[..., part])
            np.testing.assert_allclose(got[..., part], want, rtol=1e-5, atol=1e-5)
            assert 0 < (np.abs(want) == 10).mean() < 0.5


# ---- what is carried -------------------------------------------------------------------------------------------------


def test_off_there_is_nothing_of_it():
    """No leaf in the state, hence none in the program and in checkpoints; on there are two."""
    off, on = (trainer(normalize=flag).abstract_state() for flag in (False, True))
    assert off.statistics is None and len(jax.tree.leaves(on)) == len(jax.tree.leaves(off)) + 2


def test_checkpoints_keep_the_statistics(tmp_path):
    """To the bit, in what `resume` reads as in what `evaluate` and `render` read."""
    t, state, states, _ = run()
    path = checkpoint.save(tmp_path, 96, t, state, keep=1)
    for read in (checkpoint.restore, checkpoint.restore_actors):
        got = read(path, t).statistics
        for part, want in zip(got, states[-1].statistics, strict=True):
            np.testing.assert_array_equal(part, want)
