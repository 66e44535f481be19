"""n-step returns from the replay against plain Python on the recorded play: several environments, ends of episodes of
both kinds, rollouts, the ring's seam and its newest rows."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from ledger import HYPER, Ledger, by_hand

from matd3_jax.core import n_step, replay, update
from matd3_jax.core.agents import JointLayout
from matd3_jax.core.algorithm import Algorithm
from matd3_jax.training.loop import TrainLoop
from matd3_jax.training.schedule import Schedule

GAMMAS = (0.7, 0.0)
"""Of the two agents; with 0 the sum is the first reward, and nothing but a one-step return has a future."""
ENVS, LENGTH, CAPACITY = 3, 4, 60
ALGORITHM = Algorithm(name="maddpg", hidden=(4,), num_critics=1, policy_delay=1)
SCHEDULE = Schedule(num_envs=ENVS, rollout_length=LENGTH, batch_size=8, replay_capacity=CAPACITY, learning_starts=36)


def layout(n_step):
    return JointLayout.of(Ledger(), {"agents": ALGORITHM, "adversaries": ALGORITHM}, n_step)


def test_successors():
    """Row numbers and existence against a ring of (environment, time) labels, through two and a half rounds."""
    n = ENVS * LENGTH
    successors = jax.jit(replay.successors, static_argnums=(2, 3))
    ring, time = [None] * CAPACITY, 0
    for count in range(1, 13):
        for _ in range(LENGTH):
            for e in range(ENVS):
                ring[(time * ENVS + e) % CAPACITY] = (e, time)
            time += 1
        filled = [i for i, label in enumerate(ring) if label is not None]
        written = replay.Written(CAPACITY, n, jnp.int32(count))
        numbers, there = successors(written, jnp.array(filled), ENVS, 6)
        for i, row, exists in zip(filled, np.asarray(numbers), np.asarray(there), strict=True):
            e, t = ring[i]
            assert exists.tolist() == [t + k < time for k in range(6)]
            assert [ring[j] for j in row[exists]] == [(e, t + k) for k in range(6) if t + k < time]
            assert ((row >= 0) & (row < CAPACITY)).all()


def test_successors_far_on():
    """After a billion rollouts (count * n overflows int32) the newest row of each environment still has none."""
    count = 2**31 - 1
    newest = (count - 1) % 5 * 12 + 11
    _, there = replay.successors(replay.Written(60, 12, jnp.int32(count)), jnp.array([newest, newest - 3]), 3, 3)
    assert there.tolist() == [[True, False, False], [True, True, False]]


@functools.cache
def play(rollouts):
    """(trainer, state, rows in the order of play [steps, ENVS, row]) of two seeds after so many rollouts."""
    hyper = {"agents": HYPER._replace(gamma=GAMMAS[0]), "adversaries": HYPER._replace(gamma=GAMMAS[1])}
    trainer = TrainLoop(Ledger(), layout(3), SCHEDULE, hyper, 2, devices=jax.devices()[:1])
    state, _ = trainer.warm_up(trainer.init(jax.vmap(jax.random.key)(jnp.arange(2))))
    interval, rows = trainer.interval(1), [np.asarray(state.replay[:, : 2 * ENVS * LENGTH])]
    while int(state.rollouts) < rollouts:
        at = int(state.rollouts) * ENVS * LENGTH % CAPACITY
        state, _ = interval(state)
        rows.append(np.asarray(state.replay[:, at : at + ENVS * LENGTH]))
    played = np.concatenate(rows, axis=1).reshape(2, -1, ENVS, trainer.layout.row_size)
    return trainer, state, played


def by_python(rows, n):
    """(rewards [2], x', whether it terminated, m) of the n-step return from the first of `rows`, all of one environment
    and after it; ends of episodes by the rules of Ledger, not by what the rows say of them."""
    total, powers = np.zeros(2), np.ones(2)
    for k, row in enumerate(rows[:n]):
        reward, next_x, terminated, truncated = by_hand(row[:7], row[7:11])
        total += powers * reward
        if terminated or truncated or k + 1 in (n, len(rows)):
            return total, next_x, terminated, k + 1
        powers *= GAMMAS
    raise AssertionError


# Two rollouts: the ring fills up; 5: just full; 8: round once and a half, the seam in the middle.
@pytest.mark.slow
@pytest.mark.parametrize("rollouts", [2, 5, 8])
@pytest.mark.parametrize("n", [2, 3, 7])
def test_returns_by_python(n, rollouts):
    """For every row in the replay of both seeds: x and actions, rewards, number of steps, x' and discount. n = 7 is
    longer than an episode and than a rollout."""
    trainer, state, played = play(rollouts)
    steps = played.shape[1]

    @jax.jit
    def drawn(seed, indices):
        written = replay.Written(CAPACITY, SCHEDULE.rollout_steps, state.rollouts)
        return n_step.draw(layout(n), state.replay, seed, indices, written, ENVS, jnp.array(GAMMAS))

    oldest = max(0, steps - CAPACITY // ENVS)
    lengths, ends = set(), set()
    for seed in range(2):
        indices = [(t * ENVS + e) % CAPACITY for t in range(oldest, steps) for e in range(ENVS)]
        rows = np.asarray(drawn(seed, jnp.array(indices)))
        assert rows.shape == (len(indices), 7 + 4 + 2 + 1 + 7 + 1)
        for b, (t, e) in enumerate((t, e) for t in range(oldest, steps) for e in range(ENVS)):
            reward, next_x, terminated, m = by_python(played[seed, t:, e], n)
            np.testing.assert_array_equal(rows[b, :11], played[seed, t, e, :11])
            # float32: sums of at most 7 rewards of about 10, x' of one addition.
            np.testing.assert_allclose(rows[b, 11:13], reward, rtol=1e-5)
            assert rows[b, 13] == m - 1 and rows[b, 21] == 1 - terminated
            np.testing.assert_allclose(rows[b, 14:21], next_x, rtol=1e-6)
            lengths.add(m)
            ends.add("terminated" if terminated else "newest" if t + m == steps else "cut" if m < n else "whole")
    assert lengths >= set(range(1, min(n, 4) + 1))
    assert ends >= {"terminated", "newest"} | ({"whole"} if n < 5 else {"cut"})


def test_updates_get_them(monkeypatch):
    """What the loop's updates are given: returns discounted by each agent's own gamma, from all of the replay."""

    def stub(layout, state, hyper, rows, *args, **kwargs):
        parts = layout.row_parts(rows)
        return state, update.UpdateMetrics(parts.reward.mean(axis=(0, 1)), *2 * [jnp.full(2, parts.more.mean())])

    monkeypatch.setattr(update, "update", stub)
    trainer, state, played = play(5)
    trainer.schedule = trainer.learner.schedule = dataclasses.replace(SCHEDULE, batch_size=20_000)
    state, metrics = trainer.interval(1)(jax.tree.map(jnp.copy, state))
    new = np.asarray(state.replay[:, : SCHEDULE.rollout_steps]).reshape(2, LENGTH, ENVS, -1)
    played = np.concatenate([played[:, -CAPACITY // ENVS + LENGTH :], new], axis=1)
    for seed in range(2):
        found = [by_python(played[seed, t:, e], 3) for t in range(CAPACITY // ENVS) for e in range(ENVS)]
        # 40,000 draws from 60 returns: the mean's standard error is below 0.01 (rewards' spread below 2).
        want = np.mean([reward for reward, *_ in found], axis=0)
        np.testing.assert_allclose(metrics.update.critic_loss[seed, 0], want, atol=0.05)
        want = np.mean([m - 1 for *_, m in found])
        np.testing.assert_allclose(metrics.update.q_value[seed, 0], want, atol=0.02)
