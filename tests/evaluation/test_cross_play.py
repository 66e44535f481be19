"""Teams of different runs against each other: episodes against NumPy policies and `TrainingSession.evaluate`."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from cross_cases import ENV, OWN, RUNS, SEED, SMALL, STEPS, make, meet, runs
from learner_cases import layers
from ledger import Ledger

from matd3_jax.evaluation import cross_play
from matd3_jax.evaluation.cross_play_table import pairs_of


def by_numpy(run, seed, team, observation):
    """{agent: action} of a team for everybody's observations, in float64, written from what a run's settings say."""
    settings, layout = run.training.config, run.training.layout
    who = [i for i, t in enumerate(ENV.teams) if t == team]
    algorithm = settings.teams()[team]
    agents = [i for i, t in enumerate(layout.teams) if t == team]
    seen = [observation[i] for i in who]
    if algorithm.joint:
        seen = [np.concatenate(seen)]
    actions = []
    for agent, x in zip(agents, seen, strict=True):
        if settings.normalize_observations:
            start = sum(layout.observation_sizes[:agent])
            mean, variance = (np.float64(leaf)[seed, start : start + len(x)] for leaf in run.state.statistics)
            x = np.clip((x - mean) / np.sqrt(variance + 1e-8), -10, 10)
        g, k = layout.place(agent)
        logits, _ = reference.forward(layers(run.state.groups[g].actor, seed, k), x[None])
        actions += [reference.softmax(part[None])[0] for part in logits[0].reshape(-1, 5)]
    return dict(zip(who, actions, strict=True))


@pytest.mark.slow
@pytest.mark.parametrize(("one", "two"), [("mixed", "normal"), ("joint", "mixed"), ("normal", "joint")])
def test_episodes_by_hand(one, two):
    """Seeds of different places, step after step with NumPy policies: the same mean returns of every agent."""
    episodes, (k, m) = 4, (1, 0)
    got = meet(runs(), one, two, [[k, m]], episodes)
    state_key, step_key = jax.random.split(jax.random.fold_in(jax.random.key(SEED), 2**31 - 1))
    step = jax.jit(ENV.step)
    total = np.zeros(3)
    for key in jax.random.split(state_key, episodes):
        state, observation = ENV.reset(key)
        for t in range(STEPS):
            seen = [np.asarray(o, np.float64) for o in observation]
            chosen = by_numpy(runs()[one], k, "agents", seen) | by_numpy(runs()[two], m, "adversaries", seen)
            after = step(jax.random.key(t), state, tuple(jnp.float32(chosen[i]) for i in range(3)))
            state, observation = after.state, after.observation
            total += np.asarray(after.reward)
    # float32: five rewards of order 1, small networks.
    np.testing.assert_allclose(got[0], total / episodes, rtol=1e-4, atol=1e-5)
    assert np.abs(got[0] - meet(runs(), one, two, [[0, 1]], episodes)[0]).max() > 1e-3, "seeds have their own policies"


@pytest.mark.slow
@pytest.mark.parametrize("name", RUNS)
def test_own_pairs_are_evaluations(name):
    """Trained together, deterministic: the numbers of `evaluate`, team by team, which has never heard of teams."""
    training, state = runs()[name]
    seeds = training.config.seeds
    played = meet(runs(), name, name, OWN[:seeds], episodes=6)
    found = training.evaluate(state, 6, True, SEED).episode_return.mean(axis=1)
    for team in cross_play.TEAMS:
        weights = np.array(ENV.return_weights) * (np.array(ENV.teams) == team)
        np.testing.assert_allclose(played @ weights, found @ training.team_weights(team), rtol=1e-5, atol=1e-5)


class Twin(Ledger):
    """Everybody sees the same kind of thing: one group of all agents, teams in turns; episodes end at 3 or 5 steps."""

    @property
    def observation_sizes(self):
        return (3,) * len(self.teams)

    def observe(self, state):
        return tuple(o[:3] for o in super().observe(state))


TWIN = Twin(teams=("agents", "adversaries", "agents"))
TWIN_SETTINGS = [*SMALL[2:], "seeds=2", "normalize_observations=true"]


def test_teams_that_are_alike():
    """Agents of both teams with the same sizes and algorithm: each team has its own networks and statistics."""
    run = make(TWIN_SETTINGS, TWIN)
    assert [group.members for group in run.training.layout.groups] == [(0, 2), (1,)]
    played = meet({"twin": run}, "twin", "twin", OWN[:2], episodes=8, env=TWIN)
    found = run.training.evaluate(run.state, 8, True, SEED)
    np.testing.assert_allclose(played, found.episode_return.mean(axis=1), rtol=1e-5)
    assert len(np.unique(found.length)) == 2


def test_hard_choices_and_boxes():
    """A joint team of hard choices, and of boxes: own pairs are evaluations."""
    for actions in ("discrete", "continuous"):
        run = make([*SMALL, "algo=td3", "seeds=2", f"env.actions={actions}"])
        env = dataclasses.replace(ENV, actions=actions)
        teams = [cross_play.team_of(run.training, env, run.state, team) for team in cross_play.TEAMS]
        played = cross_play.play(env, teams, OWN[:2], 4, True, SEED)
        found = run.training.evaluate(run.state, 4, True, SEED).episode_return.mean(axis=1)
        np.testing.assert_allclose(played[:, 0], found[:, 0], rtol=1e-5, atol=1e-5)
        # The joined agent's reward is the mean of its members'.
        np.testing.assert_allclose(played[:, 1:].mean(axis=1), found[:, 1], rtol=1e-5, atol=1e-5)


def test_order_and_batches(monkeypatch):
    """Seeds x seeds: each row is what that pair plays alone, also where the pairs are cut into batches."""
    pairs = pairs_of(3, 2, matched=False)
    together = meet(runs(), "mixed", "normal", pairs)
    for pair, row in zip(pairs, together, strict=True):
        np.testing.assert_allclose(meet(runs(), "mixed", "normal", [pair])[0], row, rtol=1e-5, atol=1e-5)
    monkeypatch.setattr(cross_play, "SIDE_BY_SIDE", {"cpu": 4})
    np.testing.assert_allclose(meet(runs(), "mixed", "normal", pairs), together, rtol=1e-5, atol=1e-5)
    assert len(np.unique(together.round(4), axis=0)) == 6


@pytest.mark.slow
def test_sampled_noise():
    """As in training, each team by itself: returns like those of sampled evaluations, and of policies without
    preferences nobody's noise goes with anybody's."""
    run = make(TWIN_SETTINGS, TWIN)
    one, two = (meet({"twin": run}, "twin", "twin", OWN[:2], 3000, False, s, TWIN) for s in (0, 1))
    found = run.training.evaluate(run.state, 3000, False, 0).episode_return
    error = found.std(axis=1) / np.sqrt(3000)
    still = run.training.evaluate(run.state, 3000, True, 0).episode_return.mean(axis=1)
    # Start states are shared with the evaluation of the same seed, but not the noise.
    assert (np.abs(one - found.mean(axis=1)) < 4 * error).all() and not np.allclose(one, found.mean(axis=1), rtol=1e-6)
    assert not np.allclose(one, two, rtol=1e-6)
    assert (np.abs(still - found.mean(axis=1)) > 4 * error).any()
    groups = jax.tree.map(np.zeros_like, run.state.groups)
    run = run._replace(state=run.state._replace(groups=groups))
    length = 4.0  # of an episode of 3 or 5 steps, on average: alone it moves the three returns together
    returns = np.array([meet({"twin": run}, "twin", "twin", [[0, 0]], 1, False, s, TWIN)[0] for s in range(150)])
    short = returns[:, 1] < 10 * length  # the second agent gets ten more a step
    for kind in (short, ~short):
        r = np.corrcoef(returns[kind].T)[np.triu_indices(3, 1)]
        assert kind.sum() > 50 and np.abs(r).max() < 0.45
