"""The loop: what is stored, when updates come and what they move, and that seeds, devices and intervals do not
matter."""

import dataclasses
import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from ledger import ENDS, HYPER, LIMIT, Ledger, by_hand

from matd3_jax.core import rollout, update
from matd3_jax.core.agents import JointLayout
from matd3_jax.core.algorithm import Algorithm
from matd3_jax.envs.point_reach import PointReach
from matd3_jax.training import sharding
from matd3_jax.training.evaluator import Evaluator
from matd3_jax.training.loop import TrainLoop
from matd3_jax.training.schedule import Schedule

pytestmark = pytest.mark.slow

MATD3 = Algorithm(hidden=(4,))
MADDPG = Algorithm(name="maddpg", hidden=(4,), num_critics=1, policy_delay=1)
SCHEDULE = Schedule(num_envs=3, rollout_length=4, batch_size=8, replay_capacity=60, learning_starts=36)
SEEDS = 3


def make(seeds, schedule=SCHEDULE, delays=(2, 1), env=None, tau=0.1, **options):
    """A trainer of Ledger with one team an agent: MATD3-like for the first, MADDPG-like for the others."""
    env = env or Ledger()
    algorithms = {
        team: dataclasses.replace(MADDPG if i else MATD3, policy_delay=delay)
        for i, (team, delay) in enumerate(zip(env.teams, delays, strict=True))
    }
    # A learning rate for each seed: seeds must not mix up their hyper-parameters.
    rates = np.array([0.01, 0.02, 0.03])[seeds]
    hyper = {team: HYPER._replace(critic_lr=rates, tau=tau) for team in env.teams}
    return TrainLoop(env, JointLayout.of(env, algorithms), schedule, hyper, len(seeds), **options)


def start(trainer, seeds):
    return trainer.warm_up(trainer.init(jax.vmap(jax.random.key)(jnp.asarray(seeds))))


def plain(tree):
    """A pytree in NumPy, keys as numbers."""

    def one(leaf):
        return np.asarray(jax.random.key_data(leaf) if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) else leaf)

    return jax.tree.map(one, tree)


def back(state, seeds):
    """Some seeds of what `plain` made of a state, ready to be trained on."""
    key, rollouts = jax.random.wrap_key_data(state.key[seeds]), jnp.int32(state.rollouts)
    some = jax.tree.map(lambda leaf: jnp.asarray(leaf[seeds]), state._replace(key=(), rollouts=()))
    return some._replace(key=key, rollouts=rollouts)


@functools.cache
def main_run():
    """Three seeds on all devices, tau = 1: states after the warm-up and after one, two and three iterations,
    metrics."""
    trainer = make([0, 1, 2], tau=1.0)
    state, episodes = start(trainer, [0, 1, 2])
    states, metrics, interval = [plain(state)], [], trainer.interval(1)
    for _ in range(3):
        state, m = interval(state)
        states.append(plain(state))
        metrics.append(plain(m))
    return trainer, states, plain(episodes), metrics


# ---- what is stored --------------------------------------------------------------------------------------------------


def transitions(seed):
    """Rows of a seed in the order of play, [rollouts * rollout_length, num_envs, row] of all that were collected."""
    _, states, _, _ = main_run()
    rollouts = []
    for before, after in itertools.pairwise(states):
        for c in range(int(before.rollouts), int(after.rollouts)):
            at = c * SCHEDULE.rollout_steps % SCHEDULE.replay_capacity
            rollouts.append(after.replay[seed, at : at + SCHEDULE.rollout_steps])
    first = states[0]
    rows = first.replay[seed, : int(first.rollouts) * SCHEDULE.rollout_steps]
    return np.concatenate([rows, *rollouts]).reshape(-1, SCHEDULE.num_envs, rows.shape[-1])


@pytest.mark.parametrize("seed", range(SEEDS))
def test_transitions_are_exact(seed):
    """Each stored transition is what the environment does with the stored action: reward, the TRUE final observation
    as x' at an episode's end, discount 0 only where it terminated. Play continues from x', or from a fresh episode."""
    rows = transitions(seed)
    assert rows.shape == (8 * 4, 3, 7 + 4 + 2 + 7 + 1)  # two rollouts of warm-up, three iterations of two each
    ends = {"terminated": 0, "truncated": 0}
    numbers = set()
    for e in range(SCHEDULE.num_envs):
        fresh, went_on = True, None
        for row in rows[:, e]:
            x, action, reward, next_x, discount = np.split(row, [7, 11, 13, 20])
            if fresh:
                assert x[1] == 0 and not x[[2, 5]].any()
                assert x[0] not in numbers
                numbers.add(x[0])
            else:
                np.testing.assert_array_equal(x, went_on)
            np.testing.assert_allclose(action.reshape(2, 2).sum(axis=1), 1, atol=1e-6)  # float32 softmax
            want_reward, want_x, terminated, truncated = by_hand(x, action)
            np.testing.assert_allclose(reward, want_reward, rtol=1e-6)  # float32, one addition
            np.testing.assert_allclose(next_x, want_x, rtol=1e-6)
            assert discount == (0 if terminated else 1)
            ends["terminated"] += terminated
            ends["truncated"] += truncated
            fresh, went_on = terminated or truncated, next_x
    assert min(ends.values()) >= 3
    assert len(np.unique(rows[..., 7])) == rows[..., 7].size, "every action has noise of its own"


def test_episode_sums():
    """Count, length and undiscounted return of the episodes that ended, from the stored rewards by hand."""
    _, states, warm_up, metrics = main_run()
    for seed in range(SEEDS):
        count, length, returns = 0, 0, np.zeros(2)
        for e in range(SCHEDULE.num_envs):
            running = np.zeros(2)
            for row in transitions(seed)[:, e]:
                running += row[11:13]
                if row[14] == LIMIT or row[14] == ENDS and row[13] < 0.5:
                    count, length, returns = count + 1, length + row[14], returns + running
                    running = np.zeros(2)
        parts = [warm_up, *(m.episodes for m in metrics)]
        total = jax.tree.map(lambda *e, s=seed: sum(x[s].sum(axis=0) for x in e), *parts)
        assert (total.count, total.length) == (count, length)
        np.testing.assert_allclose(total.episode_return, returns, rtol=1e-5)  # float32 sums of a hundred rewards


# ---- when updates come -----------------------------------------------------------------------------------------------


def test_counts_of_the_real_learner():
    """No update before `learning_starts` transitions, then one for each rollout; MATD3 (d = 2) moves actor and targets
    with every second, MADDPG with each; with tau = 1 the targets equal the online networks right after they moved, as
    the last update of an iteration must move them."""
    trainer, states, _, metrics = main_run()
    assert trainer.schedule.warmup_rollouts == 2 and trainer.rollouts_per_iteration == 2
    for iterations, state in enumerate(states):
        assert state.rollouts == 2 + 2 * iterations
        assert trainer.updates(int(state.rollouts)) == 2 * iterations
        written = (state.replay != 0).any(axis=-1).sum(axis=1)
        assert (written == min(24 + 24 * iterations, 60)).all()
        for group, delay in zip(state.groups, (2, 1), strict=True):
            assert (group.critic_optimizer.count == 2 * iterations).all()
            assert (group.actor_optimizer.count == 2 * iterations // delay).all()
            for online, target in ((group.actor, group.actor_target), (group.critic, group.critic_target)):
                # float32: 1 * online + 0 * target, perhaps written target + 1 * (online - target).
                jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-7), online, target)
    for before, after in itertools.pairwise(states):
        for old, new in zip(before.groups, after.groups, strict=True):
            for name in ("actor", "critic"):
                kernels = [
                    np.abs(a - b).max()
                    for a, b in zip(*map(jax.tree.leaves, (getattr(old, name), getattr(new, name))), strict=True)
                ]  # noqa: E501
                assert min(kernels) > 0
    assert all(np.isfinite(leaf).all() for m in metrics for leaf in jax.tree.leaves(m))


def stub(log):
    """In `update.update`'s place: writes into the actors a binary number of the moves so far (first bit a 1), and the
    number of different transitions and of empty rows in the minibatches into the metrics."""

    def replaced(layout, state, hyper, rows, key, move, *args, **kwargs):
        log.append(rows.shape)
        state = tuple(
            s._replace(actor=jax.tree.map(lambda leaf, m=m: 2 * leaf + m, s.actor))
            for s, m in zip(state, move, strict=True)
        )
        name = jnp.sort((rows[..., 0] + rows[..., 1]).ravel())  # number of the episode + step
        different, empty = 1.0 + (jnp.diff(name) > 0).sum(), (rows[..., 0] == 0).sum()
        own = jnp.mean(rows[0] != rows[-1])
        return state, update.UpdateMetrics(*(jnp.full(layout.num_agents, v) for v in (different, empty, own)))

    return replaced


def stubbed_run(monkeypatch, trainer, state, iterations):
    """(moves of each group so far as a string of bits, metrics of each iteration, shapes of the rows)."""
    log = []
    monkeypatch.setattr(update, "update", stub(log))
    ones = jax.tree.map(lambda leaf: jnp.ones_like(leaf), [g.actor for g in state.groups])
    state = state._replace(groups=tuple(g._replace(actor=a) for g, a in zip(state.groups, ones, strict=True)))
    state, metrics = trainer.interval(iterations)(state)
    numbers = [np.unique(np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(g.actor)])) for g in state.groups]
    return [f"{int(n.item()):b}"[1:] for n in numbers], plain(metrics), log


def moves(monkeypatch, delays, updates):
    """(bits of two iterations, expected bits): nothing is played, only the schedule counts."""

    def stay(env, layout, policy, env_state, key, length, **options):
        rows = jnp.zeros((length * env_state.episode_step.shape[0], layout.row_size))
        return env_state, rows, rollout.Episodes(jnp.int32(0), jnp.zeros(layout.num_agents), jnp.int32(0)), None

    begin = back(main_run()[1][0], slice(0, 1))  # before anything is replaced: what it gives is kept for other tests
    monkeypatch.setattr(rollout, "collect", stay)
    trainer = make([0], dataclasses.replace(SCHEDULE, updates_per_collect=updates), delays)
    bits, _, _ = stubbed_run(monkeypatch, trainer, begin, iterations=2)
    total = 2 * trainer.rollouts_per_iteration * updates
    assert total % np.lcm(*delays) == 0
    return bits, ["".join("1" if u % d == 0 else "0" for u in range(1, total + 1)) for d in delays]


@pytest.mark.parametrize(
    "delays, updates",
    [((1, 2), 1), ((3, 3), 1), ((2, 3), 1), ((2, 2), 2), ((1, 2), 4), ((3, 1), 6), ((4, 2), 2)],
)
def test_moves(monkeypatch, delays, updates):
    """Actors and targets move with exactly every d-th update of the learner (the d-th first), counted in updates and
    not in env steps, for teams of different delays and one or many updates a rollout."""
    got, want = moves(monkeypatch, delays, updates)
    assert got == want


@pytest.mark.parametrize("delays, updates, delay", [((2, 2), 3, 2), ((3, 1), 2, 3), ((1, 4), 6, 4)])
def test_delay_and_updates_that_do_not_fit_are_refused(delays, updates, delay):
    """Where neither of delay and updates_per_collect divides the other, for any of the teams."""
    message = f"updates_per_collect={updates} and policy_delay={delay}: one must divide the other"
    with pytest.raises(ValueError, match=message):
        make([0], dataclasses.replace(SCHEDULE, updates_per_collect=updates), delays)


@pytest.mark.parametrize("shared", [False, True])
def test_minibatches(monkeypatch, shared):
    """The first update comes with exactly `learning_starts` transitions, which can all be drawn, the newest too; later
    updates see all that the ring holds; nobody draws an empty row. 4,000 draws miss one of 60 rows once in 10^27."""
    schedule = dataclasses.replace(SCHEDULE, batch_size=4000, shared_minibatch=shared)
    trainer = make([0], schedule, delays=(1, 1), devices_per_seed=1)
    _, metrics, log = stubbed_run(monkeypatch, trainer, back(main_run()[1][0], slice(0, 1)), iterations=4)
    assert {shape[:2] for shape in log} == {(1 if shared else 2, 4000)}
    np.testing.assert_array_equal(metrics.update.critic_loss[0, :, 0], [36, 48, 60, 60])
    assert not metrics.update.q_value.any()
    assert (metrics.update.actor_loss[0] == 0).all() if shared else (metrics.update.actor_loss[0] > 0.3).all()


# ---- what does not matter --------------------------------------------------------------------------------------------


def same(one, other, seeds_one, seeds_other):
    """Assert that the seeds of two states are alike in everything but `rollouts`.

    Tolerance: float32; the same sums in another order or width of vectors, over six updates.
    """
    leaves = [jax.tree.leaves(state._replace(rollouts=())) for state in (one, other)]
    for a, b in zip(*leaves, strict=True):
        a, b = a[seeds_one], b[seeds_other]
        if np.issubdtype(a.dtype, np.floating):
            np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5)
        else:
            np.testing.assert_array_equal(a, b)
    assert one.rollouts == other.rollouts


def test_seed_alone():
    """Seed 1 with its own hyper-parameters by itself gives what it gives among three."""
    trainer = make([1], tau=1.0)
    state, _ = start(trainer, [1])
    state, _ = trainer.interval(3)(state)
    same(plain(state), main_run()[1][3], [0], [1])
    first, second = (jax.tree.leaves(main_run()[1][3].groups[0].critic)[-1][i] for i in (0, 1))
    assert np.abs(first - second).max() > 1e-3, "the seeds themselves differ"


@pytest.mark.skipif(len(jax.devices()) < 2, reason="one device")
def test_devices_and_pieces_and_chunks_and_unrolling():
    """An odd number of seeds on one device, updated together, in one long interval whose loops hold several iterations
    and steps in an iteration: as on two devices, in three intervals."""
    several, states, _, metrics = main_run()
    assert several.mesh.size == 2 and several.sharding.padded_seeds == 4
    trainer = make([0, 1, 2], tau=1.0, devices=jax.devices()[:1], seeds_together=3, unroll=2, unroll_steps=3)
    state, long = trainer.interval(3)(back(states[0], slice(0, 3)))
    same(plain(state), states[3], slice(0, 3), slice(0, 3))
    short = jax.tree.map(lambda *m: np.concatenate(m, axis=1)[:3], *metrics)
    # float32 as in `same`; returns are sums of some hundred.
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-4), plain(long), short)


def test_seeds_apart(monkeypatch):
    """Networks of each seed in arrays of their own inside the program, as for large ones: the same numbers, in the same
    form."""
    together, states, _, metrics = main_run()
    monkeypatch.setattr(sharding, "APART_BYTES", 0)
    trainer = make([0, 1, 2], tau=1.0)
    assert trainer.seeds_apart and not together.seeds_apart and trainer.sharding.local_seeds == 2
    assert not make([0, 1, 2], devices=jax.devices()[:1], seeds_together=3).seeds_apart  # updated in one batch
    state, long = trainer.interval(3)(start(trainer, [0, 1, 2])[0])
    same(plain(state), states[3], slice(None), slice(None))
    short = jax.tree.map(lambda *m: np.concatenate(m, axis=1), *metrics)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-4), plain(long), short)


def test_devices_that_share_a_seed():
    """One seed on two devices, half of each minibatch on each: as on one, and the same on both devices."""
    trainer = make([1], dataclasses.replace(SCHEDULE, batch_size=6), tau=1.0)
    assert (
        make([0, 1, 2]).sharding.devices_per_seed == 1
        and make([1], dataclasses.replace(SCHEDULE, batch_size=5)).sharding.devices_per_seed == 1
    )
    assert trainer.sharding.devices_per_seed == trainer.mesh.size == 2 and trainer.sharding.device_seeds()[1][1] == [0]
    alone = make([1], trainer.schedule, tau=1.0, devices_per_seed=1)
    ends = []
    for t in (trainer, alone):
        state, m = t.interval(3)(t.warm_up(t.init(jax.vmap(jax.random.key)(jnp.array([1]))))[0])
        ends.append((state, plain(state), plain(m)))
    same(ends[0][1], ends[1][1], slice(None), slice(None))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-4), ends[0][2], ends[1][2])
    for leaf in jax.tree.leaves(ends[0][0].groups):
        one, other = (np.asarray(shard.data) for shard in leaf.addressable_shards)
        np.testing.assert_array_equal(one, other)
    with pytest.raises(ValueError, match="2 of 2 devices cannot share 5 rows"):
        make([1], dataclasses.replace(SCHEDULE, batch_size=5), devices_per_seed=2)


def test_evaluate():
    """Whole episodes, each counted once and to its end: lengths are those of the environment, the returns those of the
    recorded totals; deterministic play of one policy repeats itself but for the start."""
    trainer, _, _, _ = main_run()
    state, _ = start(trainer, [0, 1, 2])
    keys = jax.vmap(jax.random.key)(jnp.arange(3))
    returns, lengths, _ = map(np.asarray, Evaluator(trainer).evaluate(state, keys, 40, deterministic=True))
    assert returns.shape == (3, 40, 2) and lengths.shape == (3, 40)
    assert set(np.unique(lengths)) == {ENDS, LIMIT}
    # Reward at step t is total + 10 i; totals grow by the action's first entry, between 0 and 1.
    most = lengths * (lengths + 1) / 2
    assert (returns[..., 0] > 0).all() and (returns[..., 0] < most).all()
    assert (returns[..., 1] > 10 * lengths).all() and (returns[..., 1] < 10 * lengths + most).all()


class Rivals(PointReach):
    """Two agents alike in two teams."""

    @property
    def teams(self):
        return ("agents", "adversaries")


def test_teams_that_are_alike_learn_with_their_own_numbers():
    """Same sizes, spaces and algorithm, but one of them has a learning rate of 0."""
    still = HYPER._replace(actor_lr=0.0, critic_lr=0.0)
    layout = JointLayout.of(Rivals(), {"agents": MATD3, "adversaries": MATD3})
    hyper = {"agents": HYPER._replace(actor_lr=0.1, critic_lr=0.1), "adversaries": still}
    trainer = TrainLoop(Rivals(), layout, SCHEDULE, hyper, 1)
    before, _ = start(trainer, [0])
    before = plain(before.groups)
    state, _ = start(trainer, [0])
    state, _ = trainer.interval(2)(state)
    (g, k), (h, m) = (layout.place(i) for i in range(2))
    for part in ("actor", "critic"):
        mine, rival = (
            [getattr(groups[one], part)["kernel_0"][0, member] for groups in (before, plain(state.groups))]
            for one, member in ((g, k), (h, m))
        )
        assert (mine[0] != mine[1]).any() and (rival[0] == rival[1]).all()
