"""Seeds that take over others' networks: what is copied, what stays, and hyper-parameters that are changed between."""

import dataclasses

import jax
import numpy as np
import pytest

from matd3_jax import config
from matd3_jax.training.copying import Copier
from matd3_jax.training.session import TrainingSession

TINY = [
    "env=simple_push", "algo.hidden=[4]", "batch_size=8", "num_envs=2", "learning_starts=100", "replay_capacity=200",
    "total_steps=400", "log_every=100", "eval_every=400", "eval_episodes=1", "seeds=5", "normalize_observations=true",
    "diagnostics.q_bias=true", "diagnostics.q_bias_rollouts=3", "diagnostics.q_bias_steps=2",
    "on_divergence=stop_seed", "algo.policy_delay=1",
]  # fmt: skip


@pytest.fixture(scope="module")
def session():
    """Five seeds on two devices: the sixth row is a copy of the fifth."""
    return TrainingSession(config.load(TINY))


@pytest.fixture(scope="module")
def trained(session):
    """The state after an interval, on the host."""
    state, _ = session.start()
    state, _ = session.advance(state)
    return host(state)


def host(state):
    return jax.tree.map(np.array, state._replace(key=jax.random.key_data(state.key)))


def device(session, state):
    state = state._replace(key=jax.random.wrap_key_data(jax.numpy.asarray(state.key)))
    return jax.device_put(state, session.trainer.shardings)


def rows(tree, places):
    return [np.asarray(leaf)[places] for leaf in jax.tree.leaves(tree)]


def same(one, other):
    return all(np.array_equal(a, b, equal_nan=True) for a, b in zip(one, other, strict=True))


@pytest.mark.slow
def test_networks_are_copied_and_what_a_seed_lives_in_stays(session, trained):
    sources = {1: 3, 4: 0}  # to the other device and back; 4 is the last one, which has a copy
    found = host(Copier(session.trainer).copy(device(session, trained), sources))
    from_rows = [0, 3, 2, 3, 0, 0]
    assert len(found.key) == 6
    for part in ("groups", "statistics", "stopped"):
        assert same(rows(getattr(found, part), slice(None)), rows(getattr(trained, part), from_rows)), part
    assert same(rows(found.reservoir.pairs, slice(None)), rows(trained.reservoir.pairs, from_rows))
    assert not same(rows(trained.groups, [1]), rows(trained.groups, [3]))
    for part in ("env", "replay", "key", "rollouts"):
        assert same(jax.tree.leaves(getattr(found, part)), jax.tree.leaves(getattr(trained, part))), part


def test_replay_and_environments_are_copied_where_it_is_said(session, trained):
    sources = {1: 3, 4: 0, 2: 0}
    copier = Copier(session.trainer)
    found = host(copier.copy(device(session, trained), sources, replay=[1, 4], environments=[2]))
    np.testing.assert_array_equal(found.replay, trained.replay[[0, 3, 2, 3, 0, 0]])
    assert not np.array_equal(trained.replay[1], trained.replay[3]) and found.replay.shape[0] == 6
    assert same(rows(found.env, slice(None)), rows(trained.env, [0, 1, 0, 3, 4, 5]))
    np.testing.assert_array_equal(found.key, trained.key)
    assert found.rollouts == trained.rollouts


def test_a_replay_is_copied_in_place(session, trained):
    state = device(session, trained)
    # Memory of the device's own: what came from NumPy may be shared with it, and would not be written to.
    state = state._replace(replay=jax.jit(lambda rows: rows + 0)(state.replay))
    before = {shard.device: shard.data.unsafe_buffer_pointer() for shard in state.replay.addressable_shards}
    copied = Copier(session.trainer).copy(state, {1: 3, 0: 4}, replay=[1, 0])
    after = {shard.device: shard.data.unsafe_buffer_pointer() for shard in copied.replay.addressable_shards}
    assert before == after and copied.replay.sharding == session.trainer.shardings.replay


def test_a_copy_is_trained_on_like_any_state(session, trained):
    """The same program takes it: nothing is compiled again."""
    size = session.interval.jitted._cache_size()
    state = Copier(session.trainer).copy(device(session, trained), {1: 3, 4: 0}, replay=[1], environments=[4])
    state, row = session.advance(state)
    assert session.interval.jitted._cache_size() == size and np.isfinite(row["agent_0_critic_loss"]).all()


def test_changed_hyper_parameters_are_those_of_the_next_updates(session, trained):
    """tau 0: targets stay where they are, tau 1: they are the online networks; and the others learn as before."""
    base = session.config
    before, _ = session.advance(device(session, trained))
    before = host(before)

    def with_tau(tau):
        return dataclasses.replace(base, algo=dataclasses.replace(base.algo, tau=tau))

    original = session.trainer.hyper
    session.change_hyper([base, with_tau(0.0), base, with_tau(1.0), base])
    assert all(len(leaf) == 6 for leaf in jax.tree.leaves(session.trainer.hyper))
    size = session.interval.jitted._cache_size()
    found, _ = session.advance(device(session, trained))
    found = host(found)
    assert session.interval.jitted._cache_size() == size
    for group, old in zip(found.groups, trained.groups, strict=True):
        assert same(rows(group.critic_target, [1]), rows(old.critic_target, [1]))
        assert same(rows(group.actor_target, [3]), rows(group.actor, [3]))
        assert not same(rows(group.critic, [1]), rows(group.critic_target, [1]))
    assert same(rows(found.groups, [0, 2, 4]), rows(before.groups, [0, 2, 4]))
    session.change_hyper([base] * 5)
    assert same(jax.tree.leaves(session.trainer.hyper), jax.tree.leaves(original))
    again, _ = session.advance(device(session, trained))
    assert same(jax.tree.leaves(host(again).groups), jax.tree.leaves(before.groups))
