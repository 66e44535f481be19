"""Overestimation: true values and estimates against rollouts and networks by hand, the reservoir against the replay."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
import scipy.stats
from learner_cases import layers
from ledger import ENDS, HYPER, Ledger, LedgerState, by_hand

from matd3_jax.core import q_bias, update
from matd3_jax.core.acting import PolicyParams
from matd3_jax.core.agents import JointLayout
from matd3_jax.core.algorithm import Algorithm
from matd3_jax.core.q_bias import Pairs
from matd3_jax.core.running_statistics import Statistics
from matd3_jax.envs import make
from matd3_jax.envs.point_reach import PointState
from matd3_jax.training.evaluator import Evaluator
from matd3_jax.training.loop import TrainLoop
from matd3_jax.training.schedule import Schedule

MATD3 = Algorithm(hidden=(5,), policy_delay=1)  # or else the loop to compile is twice as long
IDDPG = Algorithm(name="iddpg", hidden=(6,), num_critics=1, policy_delay=1, critic="own")
LEDGER = JointLayout.of(Ledger(), {"agents": MATD3, "adversaries": IDDPG})
GAMMA = (0.9, 0.7)
LEDGER_HYPER = tuple(HYPER._replace(gamma=gamma) for gamma in GAMMA)
POINT = make("point_reach", num_agents=2, dim=2, episode_length=3)


def pairs_of_ledger(number):
    """Running episodes of both kinds, and any actions."""
    rng = np.random.default_rng(0)
    name = rng.uniform(0.01, 0.99, number).astype(np.float32)
    step = rng.integers(0, np.where(name < 0.5, ENDS, 9))
    total = rng.normal(size=(number, 2)).astype(np.float32)
    state = LedgerState(jnp.asarray(name), jnp.asarray(step, jnp.int32), jnp.asarray(total))
    x = jnp.concatenate(jax.vmap(Ledger().observe)(state), axis=-1)
    action = rng.dirichlet([1, 1], (number, 2)).reshape(number, 4)
    return Pairs(state, jnp.concatenate([x, jnp.asarray(action, jnp.float32)], axis=-1))


@functools.cache
def fresh(layout):
    return jax.jit(lambda key: update.init(layout, key))(jax.random.key(6))


def policy_of_ledger(bias):
    """Actors that give the logits (bias, -bias) whatever they see."""

    def constant(group):
        actor = jax.tree.map(jnp.zeros_like, group.actor)
        return {**actor, "bias_1": actor["bias_1"] + jnp.array([bias, -bias])}

    return PolicyParams(tuple(map(constant, fresh(LEDGER))), LEDGER_HYPER, None)


def play_out(env, layout, policy, pairs, steps):
    play = jax.jit(lambda *args: q_bias.play_out(env, layout, *args, jax.random.key(1), steps))
    return np.asarray(play(policy, pairs))


# ---- true values -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("steps", [1, 7])
def test_true_values_step_by_step(steps):
    """The stored action first, then the policies' (here always the first choice); each team's own gamma; nothing after
    a termination; a time limit (step 5) passed by."""
    pairs = pairs_of_ledger(60)
    got = play_out(Ledger(), LEDGER, policy_of_ledger(60.0), pairs, steps)
    outcomes = []
    for k, (x, action) in enumerate(np.split(np.asarray(row, np.float64), [7]) for row in pairs.inputs):
        want, ended, limits = np.zeros(2), False, 0
        for t in range(steps):
            reward, x, terminated, truncated = by_hand(x, action)
            want, limits = want + np.array(GAMMA) ** t * reward, limits + truncated
            ended = bool(terminated)
            if ended:
                break
            action = np.array([1, 0, 1, 0])
        outcomes.append((ended, limits > 0))
        # float32: sums of seven rewards of up to 20.
        np.testing.assert_allclose(got[k], want, rtol=1e-5, atol=1e-5)
    assert steps == 1 or {(True, False), (False, True)} <= set(outcomes)


def test_choices_are_sampled():
    """With equal logits a choice is the softmax of Gumbel noise: of two entries uniform on (0, 1), variance 1/12. From
    one pair many times: value r_0 + gamma (r_0 + a) after two env steps."""
    one = jax.tree.map(lambda leaf: jnp.repeat(leaf[:1], 4000, axis=0), pairs_of_ledger(1))
    one = one._replace(state=one.state._replace(number=jnp.full(4000, 0.9)))
    got = np.asarray(play_out(Ledger(), LEDGER, policy_of_ledger(0.0), one, 2))
    first = np.asarray(one.state.total)[0] + np.asarray(one.inputs)[0, [7, 9]] + [0, 10]
    sampled = (got - first) / GAMMA - first
    np.testing.assert_allclose(sampled.mean(axis=0), 0.5, atol=5 * np.sqrt(1 / 12 / 4000))
    np.testing.assert_allclose(sampled.var(axis=0), 1 / 12, rtol=0.1)  # of 4,000 uniform numbers: 1.4 %
    assert abs(np.corrcoef(sampled.T)[0, 1]) < 0.08, "agents draw noise of their own"


def by_numpy(statistics, x):
    return np.clip((x - statistics.mean) / np.sqrt(np.asarray(statistics.variance) + 1e-8), -10, 10)


@functools.cache
def on_points():
    """(layout, policy, groups, pairs) of point_reach: own critics, normalized observations, exploration noise."""
    rng = np.random.default_rng(3)
    layout = JointLayout.of(POINT, {"agents": IDDPG})
    groups = fresh(layout)
    statistics = Statistics(*(jnp.asarray(rng.uniform(0.1, 0.5, 12), jnp.float32) for _ in range(2)))
    hyper = HYPER._replace(gamma=0.8, exploration_noise=0.5)
    place = [jnp.asarray(rng.uniform(-1, 1, (20, *shape)), jnp.float32) for shape in ((2, 2), (2, 2), (2,), (4,))]
    state = PointState(*place[:3], step=jnp.asarray(rng.integers(0, 3, 20), jnp.int32))
    x = jnp.concatenate(jax.vmap(POINT.observe)(state), axis=-1)
    pairs = Pairs(state, jnp.concatenate([x, place[3]], axis=-1))
    return layout, PolicyParams(tuple(g.actor for g in groups), (hyper,), statistics), groups, pairs


def test_true_values_of_box_actions():
    """Damped masses in NumPy, the actors' squashed outputs without noise on normalized observations, six env steps
    though the time limit is three."""
    layout, policy, groups, pairs = on_points()
    got = play_out(POINT, layout, policy, pairs, 6)
    pos, vel, target = (np.asarray(part, np.float64) for part in pairs.state[:3])
    force = np.asarray(pairs.inputs[:, 12:], np.float64).reshape(20, 2, 2)
    value = 0
    for t in range(6):
        vel = 0.75 * vel + 0.5 * force
        pos = pos + 0.1 * vel
        distance = np.linalg.norm(pos - target[:, None], axis=2).mean(axis=1)
        value = value + 0.8**t * (-distance - 0.01 * (force**2).sum(axis=2).mean(axis=1))
        outputs = []
        for k in range(2):
            seen = np.concatenate([vel[:, k], target - pos[:, k], pos[:, 1 - k] - pos[:, k]], axis=1)
            own = Statistics(*(part[6 * k : 6 * k + 6] for part in policy.statistics))
            outputs.append(reference.forward(layers(groups[0].actor, k), by_numpy(own, seen))[0])
        force = 2 / (1 + np.exp(-np.stack(outputs, axis=1))) - 1
    np.testing.assert_allclose(got, np.stack([value, value], axis=1), rtol=1e-4)


# ---- estimates -------------------------------------------------------------------------------------------------------


def test_estimates_are_the_critics():
    """Two central critics, their mean; one own critic, which reads its agent's parts."""
    pairs = pairs_of_ledger(9)
    groups = fresh(LEDGER)
    got = q_bias.estimate(LEDGER, policy_of_ledger(0.0), [g.critic for g in groups], pairs.inputs)
    rows = np.asarray(pairs.inputs, np.float64)
    both = [reference.forward(layers(groups[0].critic, 0, j), rows)[0][:, 0] for j in range(2)]
    assert np.abs(both[0] - both[1]).max() > 0.1
    own = np.concatenate([rows[:, 3:7], rows[:, 9:11]], axis=1)
    alone = reference.forward(layers(groups[1].critic, 0, 0), own)[0][:, 0]
    np.testing.assert_allclose(got, np.stack([np.mean(both, axis=0), alone], axis=1), rtol=1e-4, atol=1e-5)


def test_estimates_read_normalized_observations():
    layout, policy, groups, pairs = on_points()
    values = q_bias.measure(POINT, layout, policy, [g.critic for g in groups], pairs, jax.random.key(5), 2)
    x, action = np.split(np.asarray(pairs.inputs, np.float64), [12], axis=1)
    x = by_numpy(policy.statistics, x)
    for k in range(2):
        own = np.concatenate([x[:, 6 * k : 6 * k + 6], action[:, 2 * k : 2 * k + 2]], axis=1)
        want = reference.forward(layers(groups[0].critic, k, 0), own)[0][:, 0]
        np.testing.assert_allclose(values.estimate[:, k], want, rtol=1e-4, atol=1e-5)


# ---- the reservoir ---------------------------------------------------------------------------------------------------

SEEDS, SLOTS = 3, 12_000
SCHEDULE = Schedule(num_envs=3, rollout_length=4, batch_size=8, replay_capacity=120, learning_starts=36)


def trainer(slots):
    hyper = {"agents": LEDGER_HYPER[0], "adversaries": LEDGER_HYPER[1]}
    return TrainLoop(Ledger(), LEDGER, SCHEDULE, hyper, SEEDS, q_bias_pairs=slots)


def plain(state):
    data = state._replace(key=jax.random.key_data(state.key))
    return jax.tree.map(np.asarray, data)


@functools.cache
def run(slots=SLOTS):
    """(trainer, states, values measured, compilations in the end): states after two rollouts of warm-up, two more, an
    evaluation, two and two more."""
    t = trainer(slots)
    state, _ = t.warm_up(t.init(jax.vmap(jax.random.key)(jnp.arange(SEEDS))))
    states, interval, measured = [plain(state)], t.interval(2), None
    state, _ = interval(state)
    states.append(plain(state))
    if slots:
        measured = jax.tree.map(np.asarray, Evaluator(t).measure_q_bias(state, 3))
        state = Evaluator(t).restart_reservoir(state)
    compilations = []
    jax.monitoring.register_event_duration_secs_listener(
        lambda event, seconds, **_: compilations.append(event) if "backend_compile" in event else None
    )
    for _ in range(2):
        state, _ = interval(state)
        states.append(plain(state))
    return t, states, measured, len(compilations)


@pytest.mark.slow
@pytest.mark.parametrize(("state", "rollouts"), [(0, (0, 2)), (1, (0, 4)), (2, (4, 6)), (3, (4, 8))])
def test_the_reservoir_is_uniform_since_the_last_evaluation(state, rollouts):
    """Each pair is one transition of the replay, state and all; each transition since the last evaluation, and no
    other, is as likely; pairs are drawn one by one, and for each seed by itself."""
    states = run()[1]
    reservoir = states[state].reservoir
    counts = []
    for seed in range(SEEDS):
        held = jax.tree.map(lambda leaf, s=seed: leaf[s], reservoir.pairs)
        x = np.concatenate(jax.vmap(Ledger().observe)(held.state), axis=1)
        np.testing.assert_array_equal(x, held.inputs[:, :7])
        first, end = (c * SCHEDULE.rollout_steps for c in rollouts)
        rows = states[-1].replay[seed, :, :11]
        place = {row.tobytes(): k for k, row in enumerate(rows)}
        assert len(place) >= end
        drawn = np.array([place[row.tobytes()] for row in held.inputs])
        assert drawn.min() >= first and drawn.max() < end
        counts.append(np.bincount(drawn - first, minlength=end - first))
        # 12,000 draws: one in a million uniform reservoirs would fail.
        assert scipy.stats.chisquare(counts[-1]).pvalue > 1e-6
    assert (counts[0] != counts[1]).any()


def test_measuring_by_seed():
    """Each seed's own networks and reservoir; rewards after the first env step differ with the seed's policies."""
    _, states, measured, _ = run()
    assert measured.estimate.shape == measured.truth.shape == (SEEDS, SLOTS, 2)
    for seed in range(SEEDS):
        inputs = states[1].reservoir.pairs.inputs[seed].astype(np.float64)
        both = [reference.forward(layers(states[1].groups[0].critic, seed, 0, j), inputs)[0][:, 0] for j in range(2)]
        np.testing.assert_allclose(measured.estimate[seed, :, 0], np.mean(both, axis=0), rtol=1e-3, atol=1e-4)
        # Totals grow by 0 to 1 with each action: so much lies between three env steps and their first.
        first = inputs[:, [2, 5]] + inputs[:, [7, 9]] + [0, 10]
        ended = (inputs[:, 0] < 0.5) & (inputs[:, 1] == ENDS - 1)
        np.testing.assert_allclose(measured.truth[seed][ended], first[ended], rtol=1e-5, atol=1e-5)
        on = (inputs[:, 0] > 0.5) | (inputs[:, 1] < ENDS - 2)
        more = (measured.truth[seed] - first * (1 + np.array(GAMMA)))[on]
        assert (more > 0).all() and ended.any() and on.any()


@pytest.mark.slow
def test_training_is_the_same_with_and_without():
    """Networks, optimizers, replay, environments and keys; without, not a leaf of it. After the warm-up to the bit, and
    so later as XLA compiles the loop by default; with little optimization it rounds some sums otherwise."""
    on, off = (run(slots)[1] for slots in (SLOTS, 0))
    for k, (one, other) in enumerate(zip(on, off, strict=True)):
        assert other.reservoir is None
        for a, b in zip(jax.tree.leaves(one._replace(reservoir=None)), jax.tree.leaves(other), strict=True):
            if k and np.issubdtype(a.dtype, np.floating):
                np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6)
            else:
                np.testing.assert_array_equal(a, b)
    assert len(jax.tree.leaves(trainer(0).abstract_state())) == len(jax.tree.leaves(off[0]))


def test_an_evaluation_costs_no_second_compilation():
    """The state with a restarted reservoir fits the program that is there."""
    assert run()[3] == 0
