"""Evaluation: whole deterministic episodes against NumPy, from fixed start states, apart from the training."""

import collections
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from learner_cases import layers
from ledger import ENDS, LIMIT, Ledger, by_hand

import matd3_jax
from matd3_jax.core import acting, rollout
from matd3_jax.training import session

SEEDS, EPISODES, CHUNK = 3, 6, 48
SMALL = {
    "seeds": SEEDS, "num_envs": 2, "rollout_length": 6, "batch_size": 8, "learning_starts": 24, "total_steps": 300,
    "log_every": CHUNK, "replay_capacity": 1200, "eval_episodes": EPISODES,
}  # fmt: skip


def train(**options):
    return matd3_jax.train("algo.hidden=[8]", "algo.policy_delay=1", env=Ledger(), **{**SMALL, **options})


@functools.cache
def traced():
    """(result of a run with evaluations every 100 env steps, how often each kind of evaluation was compiled)."""
    count, real = collections.Counter(), rollout.evaluate

    def evaluate(env, layout, policy, key, episodes, deterministic):
        count[episodes, deterministic] += 1
        return real(env, layout, policy, key, episodes, deterministic)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rollout, "evaluate", evaluate)
        result = train(eval_every=100)
        during = dict(count)
        for _ in range(2):
            result.evaluate(episodes=EPISODES)
            result.evaluate(episodes=5, deterministic=False)
    return result, during, dict(count)


def run():
    return traced()[0]


def play(layout, groups, seed, number):
    """(returns [agents], length) of a deterministic episode of Ledger with that number, in float64."""
    x, total = np.array([number, 0, 0, number, 0, 0, 0]), np.zeros(2)
    while True:
        action = []
        for i, o in enumerate((x[:3], x[3:])):
            g, k = layout.place(i)
            logits, _ = reference.forward(layers(groups[g].actor, seed, k), o[None])
            action.append(reference.softmax(logits)[0])
        reward, x, terminated, truncated = by_hand(x, np.concatenate(action))
        total += reward
        if terminated or truncated:
            return total, x[1]


@pytest.mark.slow
def test_episodes_by_hand():
    """Every episode of the trained policies played again in NumPy: its whole return (nothing after its end), its
    length, and the measures' means over its steps."""
    result = run()
    found = result.training.evaluate(result.state, 20, deterministic=True, seed=5)
    assert found.episode_return.shape == (SEEDS, 20, 2) and found.measures.shape == (SEEDS, 20, 2)
    groups = jax.tree.map(np.asarray, result.state.groups)
    for seed in range(SEEDS):
        for e in range(20):
            number = found.measures[seed, e, 0]
            returns, length = play(result.training.layout, groups, seed, number)
            assert found.length[seed, e] == length == (ENDS if number < 0.5 else LIMIT)
            # float32: networks of 8 units, sums of at most 5 rewards of about 10.
            np.testing.assert_allclose(found.episode_return[seed, e], returns, rtol=1e-5)
            np.testing.assert_allclose(found.measures[seed, e, 1], (length + 1) / 2, rtol=1e-6)
    assert set(np.unique(found.length)) == {ENDS, LIMIT}
    np.testing.assert_array_equal(result.evaluate(20, seed=5), found.episode_return)
    assert np.ptp(found.episode_return[:, 0, 0]) > 1e-3, "seeds have policies of their own"


@pytest.mark.slow
def test_deterministic_evaluations_play_the_averaged_actors():
    """With `actor_average` an evaluation is that of the averages, put in the actors' place; sampled ones are not."""
    result = matd3_jax.train("algo.hidden=[8]", "algo.policy_delay=1", "algo.actor_average=0.2", env=Ledger(), **SMALL)
    state, training = result.state, result.training
    averages = tuple(g._replace(actor=g.actor_average) for g in state.groups)
    assert all(
        np.abs(np.asarray(a) - np.asarray(b)).max() > 1e-4
        for g in state.groups
        for a, b in zip(jax.tree.leaves(g.actor), jax.tree.leaves(g.actor_average), strict=True)
    )
    swapped, still = state._replace(groups=averages), training.trainer.policy(state)
    got = training.evaluate(state, EPISODES, deterministic=True).episode_return
    np.testing.assert_array_equal(got, training.evaluate(swapped, EPISODES, deterministic=True).episode_return)
    np.testing.assert_array_equal(result.metrics["agent_0_eval_return"][:, -1], got[..., 0].mean(axis=1))
    online = acting.PolicyParams(tuple(g.actor for g in state.groups), still.hyper, still.statistics)
    jax.tree.map(np.testing.assert_array_equal, still, online)
    sampled = [training.evaluate(s, EPISODES, deterministic=False).episode_return for s in (state, swapped)]
    assert (sampled[0] != sampled[1]).any()


def test_sampled_play_differs():
    result = run()
    sampled, still = (result.evaluate(EPISODES, deterministic=d) for d in (False, True))
    assert (sampled != still).all()


def test_columns():
    """Evaluations stand in the first row, where a multiple of 100 env steps was crossed, and in the last row; their
    numbers are the means over those episodes, weighted as a team's training return is."""
    result = run()
    table = result.metrics
    step = table["step"][0]
    assert step[0] == 12 and (np.diff(step) == CHUNK).all() and step[-1] == 300
    due = [i in (0, len(step) - 1) or step[i] // 100 > step[i - 1] // 100 for i in range(len(step))]
    assert 3 < sum(due) < len(due)
    names = {n for n in table if "eval" in n}
    assert names == {
        "eval_return_agents", "eval_return_adversaries", "agent_0_eval_return", "agent_1_eval_return",
        "eval_episode_length", "eval_number", "eval_step",
    }  # fmt: skip
    for name in names:
        np.testing.assert_array_equal(~np.isnan(table[name]), np.tile(due, (SEEDS, 1)), err_msg=name)
    last = result.training.evaluate(result.state, EPISODES, deterministic=True)
    np.testing.assert_array_equal(table["eval_episode_length"][:, -1], last.length.mean(axis=1))
    np.testing.assert_array_equal(table["eval_step"][:, -1], last.measures[..., 1].mean(axis=1))
    for i, team in enumerate(("agents", "adversaries")):
        np.testing.assert_allclose(table[f"agent_{i}_eval_return"][:, -1], last.episode_return[..., i].mean(axis=1))
        np.testing.assert_array_equal(table[f"eval_return_{team}"], table[f"agent_{i}_eval_return"])


@pytest.mark.slow
def test_start_states_are_fixed():
    """The same episodes at every evaluation, for every seed and in runs of other training keys: curves differ by the
    policies alone. Episodes of one evaluation differ among themselves."""
    numbers = run().metrics["eval_number"]
    numbers = numbers[~np.isnan(numbers)]
    assert len(np.unique(numbers)) == 1
    other = train(eval_every=100, seed=7, seeds=1, total_steps=100).metrics["eval_number"][0, 0]
    assert other == numbers[0]
    result = run()
    found = result.training.evaluate(result.state, EPISODES, deterministic=True)
    assert len(np.unique(found.measures[0, :, 0])) == EPISODES


def test_compiled_once():
    """One program for all evaluations of a run, and one more for each other kind of evaluation afterwards."""
    _, during, after = traced()
    assert during == {(EPISODES, True): 1}
    assert after == {(EPISODES, True): 1, (5, False): 1}


@pytest.mark.slow
def test_training_does_not_depend_on_evaluation(monkeypatch):
    """Without evaluations (none is compiled then) and with one after every interval: the same table and state, bit for
    bit."""
    often = train(eval_every=1)
    assert not np.isnan(often.metrics["eval_return_agents"]).any()
    monkeypatch.setattr(rollout, "evaluate", None)
    never = train(eval_every=0)
    assert never.metrics.keys() == {name for name in often.metrics if "eval" not in name}
    for name, column in never.metrics.items():
        for other in (often, run()):
            np.testing.assert_array_equal(column, other.metrics[name], err_msg=name)
    for one, other in zip(*(jax.tree.leaves(r.state._replace(key=())) for r in (never, often)), strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize(
    ("every", "total", "steps"), [(None, 4000, 200), (0, 2000, 0), (70, 2000, 70), (None, 100, 120)]
)
def test_evaluation_interval(every, total, steps):
    settings = {**SMALL, "eval_every": every, "total_steps": total}
    config = matd3_jax.config.load([f"{k}={'null' if v is None else v}" for k, v in settings.items()])
    assert session.TrainingSession(config, Ledger()).eval_every == steps


def test_stops_when_all_episodes_have_ended():
    """An environment that may last 1000 steps is stepped no longer than the longest episode lasts."""
    steps = []

    class Counting(Ledger):
        def step(self, key, state, action):
            jax.debug.callback(lambda t: steps.append(int(t)), state.step)
            return super().step(key, state, action)

    result = run()
    env = Counting(episode_length=1000)
    policy = jax.tree.map(lambda leaf: leaf[0], result.training.trainer.policy(result.state))
    found = rollout.evaluate(env, result.training.layout, policy, jax.random.key(0), EPISODES, True)
    jax.block_until_ready(found)
    jax.effects_barrier()
    assert found.length.max() == LIMIT
    assert sorted(steps) == sorted(EPISODES * list(range(LIMIT)))


def test_cut_off_at_the_episode_length():
    """An environment that never says it has ended is played for `episode_length` steps."""

    class Endless(Ledger):
        def step(self, key, state, action):
            return super().step(key, state, action)._replace(terminated=jnp.bool_(False), truncated=jnp.bool_(False))

    result = run()
    policy = jax.tree.map(lambda leaf: leaf[0], result.training.trainer.policy(result.state))
    env = Endless(episode_length=8)
    found = rollout.evaluate(env, result.training.layout, policy, jax.random.key(0), EPISODES, True)
    np.testing.assert_array_equal(found.length, np.full(EPISODES, 8))
    np.testing.assert_allclose(found.measures[:, 1], 4.5)
