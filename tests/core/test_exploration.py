"""Exploration noise from a range: a scale for each environment and agent, kept for an episode, then drawn again."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from ledger import HYPER

from matd3_jax.core import acting, rollout, update
from matd3_jax.core.acting import PolicyParams
from matd3_jax.core.agents import JointLayout
from matd3_jax.core.algorithm import Algorithm
from matd3_jax.envs import make

ENVS, LENGTH, EPISODE = 500, 12, 6
LOW, HIGH = 0.01, 0.05
"""Narrow, so that hardly any action is clipped by the Box: the noise can be read off the actions."""


def fresh(layout):
    return jax.jit(lambda key: update.init(layout, key))(jax.random.key(0))


def started(env, layout, envs):
    return jax.jit(lambda key: rollout.start(env, key, envs, acting.ranged(layout)))(jax.random.key(1))


@pytest.fixture(scope="module")
def collected():
    """(quantiles at the start, at the end, noise [steps, envs, agents, entries]) of two episodes of every environment.

    Actors whose weights are 0 act in the middle of the Box: an action is its noise.
    """
    env = make("point_reach", num_agents=2, episode_length=EPISODE)
    algorithm = Algorithm(hidden=(4,), noise_range=True)
    layout = JointLayout.of(env, {"agents": algorithm})
    hyper = HYPER._replace(exploration_noise=LOW, exploration_noise_high=HIGH)
    actors = tuple(jax.tree.map(jnp.zeros_like, g.actor) for g in fresh(layout))
    policy = PolicyParams(actors, (hyper,) * len(layout.groups), None)
    start = started(env, layout, ENVS)
    end, rows, _, _ = jax.jit(lambda s: rollout.collect(env, layout, policy, s, jax.random.key(2), LENGTH))(start)
    space = env.action_spaces[0]
    action = np.asarray(layout.row_parts(rows).action).reshape(LENGTH, ENVS, 2, -1)
    noise = (action - (space.high + space.low) / 2) / ((space.high - space.low) / 2)
    return np.asarray(start.noise_quantile), np.asarray(end.noise_quantile), noise


def test_the_scale_is_where_the_quantile_says_for_a_whole_episode(collected):
    start, _, noise = collected
    scale = LOW + start * (HIGH - LOW)
    first = noise[:EPISODE] / scale[..., None]
    # 500 x 6 x 2 standard normals for each agent: their spread is known to 1 / sqrt(2 n) = 0.9 %.
    np.testing.assert_allclose(first.std(axis=(0, 1, 3)), 1, atol=0.04)
    # The same within the tenths of the range: a scale that did not follow the quantile would show here.
    for low in np.arange(0, 1, 0.1):
        chosen = (start >= low) & (start < low + 0.1)
        assert abs(np.moveaxis(first, 0, 1)[chosen.any(axis=1)].std() - 1) < 0.2
        values = np.concatenate([first[:, chosen[:, i], i].ravel() for i in range(2)])
        assert abs(values.std() - 1) < 5 / np.sqrt(2 * values.size)


def test_scales_are_drawn_again_for_the_next_episode_and_uniformly(collected):
    start, end, _ = collected
    for quantile in (start, end):
        assert quantile.shape == (ENVS, 2)
        values = np.sort(quantile.ravel())
        # Kolmogorov and Smirnov: the largest distance of 1,000 uniform draws exceeds 0.06 once in 700.
        assert np.abs(values - (np.arange(values.size) + 0.5) / values.size).max() < 0.06
    assert (start != end).all()
    assert abs(np.corrcoef(start.ravel(), end.ravel())[0, 1]) < 0.15
    assert abs(np.corrcoef(start[:, 0], start[:, 1])[0, 1]) < 0.2, "each agent has a scale of its own"


def test_the_second_episode_plays_at_its_own_scale(collected):
    _, end, noise = collected
    # LENGTH is two whole episodes, so `end` belongs to the third; the second's scale differs from the first's.
    first, second = (part.std(axis=(0, 3)) for part in (noise[:EPISODE], noise[EPISODE:]))
    assert abs(np.corrcoef(first.ravel(), second.ravel())[0, 1]) < 0.15
    assert noise[EPISODE:].std() == pytest.approx(noise[:EPISODE].std(), rel=0.1)


def test_without_a_range_nothing_is_kept_and_nothing_changes():
    """The state has no leaf more, and the actions are those of a range that is one number."""
    env = make("point_reach", episode_length=EPISODE)
    found = {}
    for ranged in (False, True):
        layout = JointLayout.of(env, {"agents": Algorithm(hidden=(4,), noise_range=ranged)})
        groups = fresh(layout)
        hyper = HYPER._replace(exploration_noise=0.2, exploration_noise_high=0.2)
        policy = PolicyParams(tuple(g.actor for g in groups), (hyper,) * len(groups), None)
        start = started(env, layout, 3)
        assert (start.noise_quantile is None) == (not ranged)
        collect = jax.jit(lambda s, e=env, o=layout, p=policy: rollout.collect(e, o, p, s, jax.random.key(2), LENGTH))
        found[ranged] = collect(start)[1]
    np.testing.assert_array_equal(found[False], found[True])


def test_outside_of_collecting_the_noise_is_in_the_middle_of_the_range():
    env = make("point_reach", num_agents=2)
    fixed, ranged = (
        JointLayout.of(env, {"agents": Algorithm(hidden=(4,), noise_range=noise_range)})
        for noise_range in (False, True)
    )
    actors = tuple(g.actor for g in fresh(fixed))
    observation = [jnp.ones((5, size)) for size in env.observation_sizes]
    middle = PolicyParams(actors, (HYPER._replace(exploration_noise=0.3),), None)
    ends = PolicyParams(actors, (HYPER._replace(exploration_noise=0.2, exploration_noise_high=0.4),), None)
    key = jax.random.key(3)
    decide = jax.jit(acting.decide, static_argnums=0)
    (one, _), (other, _) = decide(fixed, middle, observation, key), decide(ranged, ends, observation, key)
    for a, b in zip(one, other, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-6)  # float32


def test_mixed_teams_keep_their_own_noise():
    """A team with one number next to a team with a range: its actions are those it has next to any."""
    algorithms = {"agents": Algorithm(hidden=(4,), noise_range=True), "adversaries": Algorithm(hidden=(4,))}
    env = make("simple_tag", actions="continuous")
    layout = JointLayout.of(env, algorithms)
    plain = JointLayout.of(env, {team: dataclasses.replace(a, noise_range=False) for team, a in algorithms.items()})
    actors = tuple(g.actor for g in fresh(layout))
    hyper = HYPER._replace(exploration_noise=0.2, exploration_noise_high=0.4)
    policy = PolicyParams(actors, (hyper,) * len(layout.groups), None)
    observation = [jnp.ones((5, size)) for size in env.observation_sizes]
    draws = acting.noise(layout, jax.random.key(1), (5,))
    quantile = jnp.full((5, layout.num_agents), 0.9)
    act = jax.jit(acting.act, static_argnums=0)
    got, want = act(layout, policy, observation, draws, quantile), act(plain, policy, observation, draws)
    for i, team in enumerate(layout.teams):
        same = np.array_equal(layout.action_part(got, i), layout.action_part(want, i))
        assert same == (team == "adversaries")
