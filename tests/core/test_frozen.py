"""Teams that do not learn: what they play, and that the others learn from it what they should."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from ledger import HYPER

from matd3_jax.core import acting, frozen, rollout, update
from matd3_jax.core.agents import JointLayout
from matd3_jax.core.algorithm import Algorithm
from matd3_jax.core.frozen import Scale
from matd3_jax.envs import make
from matd3_jax.training.loop import TrainLoop
from matd3_jax.training.schedule import Schedule

LEARNER = Algorithm(hidden=(6,), smoothing=True)
STILL = HYPER._replace(actor_lr=0.0, tau=0.0, exploration_noise=0.0, target_noise=0.0)


def loop(env, adversary: Algorithm, hyper=STILL, **more):
    layout = JointLayout.of(env, {"agents": LEARNER, "adversaries": adversary}, n_step=2)
    how = {"num_envs": 3, "rollout_length": 4, "batch_size": 8, "replay_capacity": 240, "updates_per_collect": 2}
    schedule = Schedule(**{**how, "learning_starts": 24, **more})
    hypers = {"agents": HYPER._replace(target_noise=0.0), "adversaries": hyper}
    return TrainLoop(env, layout, schedule, hypers, 2, devices=jax.devices()[:1], normalize_observations=True)


def trained(trainer, change=lambda state: state):
    state = change(trainer.init(jax.vmap(jax.random.key)(jnp.arange(2))))
    before = jax.tree.map(np.asarray, [group.actor for group in state.groups])
    state, _ = trainer.warm_up(state)
    state, metrics = trainer.interval(3)(state)
    return before, state, metrics


@pytest.mark.slow
@pytest.mark.parametrize("how", [{}, {"shared_minibatch": True}, {"sequential": True}], ids=str)
def test_its_networks_stay_the_same_to_the_bit(how):
    """While the others learn from their minibatches, in any order."""
    env = make("simple_adversary")
    before, state, metrics = trained(loop(env, Algorithm(hidden=(5,), frozen=True, policy_delay=3), **how))
    g = next(g for g, group in enumerate(state.groups) if group.critic is None)
    for a, b in zip(jax.tree.leaves(state.groups[g].actor), jax.tree.leaves(before[g]), strict=True):
        np.testing.assert_array_equal(a, b)
    moved = [
        (np.asarray(a) != b).any()
        for a, b in zip(*map(jax.tree.leaves, (state.groups[1 - g].actor, before[1 - g])), strict=True)
    ]
    assert all(moved) and len(jax.tree.leaves(state.groups[g])) == 4 + 3  # actor and scale: no critics, no optimizers
    assert np.isnan(np.asarray(metrics.update.critic_loss)).all(axis=(0, 1)).tolist() == [True, False, False]


@pytest.mark.slow
@pytest.mark.parametrize("adversarial", [False, True])
def test_learners_updates_are_those_against_opponents_that_stand_still(adversarial):
    """One update from the same rows: the same networks, optimizers and losses, to rounding; adversarial: what opponents
    do is moved against the learners, whether they learn or not."""
    env = make("simple_adversary", actions="continuous")
    learner = dataclasses.replace(LEARNER, adversarial=adversarial)
    teams = {"agents": learner, "adversaries": Algorithm(hidden=(5,))}
    steps = {"adversarial_step": 0.3, "adversarial_step_team": 0.1} if adversarial else {}
    plain = JointLayout.of(env, teams)
    other = JointLayout.of(env, {**teams, "adversaries": Algorithm(hidden=(5,), frozen=True)})
    key, rng = jax.random.key(3), np.random.default_rng(0)
    state = update.init(plain, key)
    g = next(g for g, group in enumerate(other.groups) if group.frozen)
    # A policy that sees observations its own way. Standing still, it sees what all networks see: so that is undone.
    scale = Scale(*(np.float32(rng.uniform(0.5, 2, (1, 8))) for _ in range(2)), np.full(1, 1.5, np.float32))
    still = list(update.init(other, key))
    still[g] = still[g]._replace(scale=jax.tree.map(jnp.asarray, scale))
    assert jax.tree.all(jax.tree.map(lambda a, b: bool((a == b).all()), still[g].actor, state[g].actor))
    rows = np.float32(rng.normal(size=(3, 16, plain.row_size)))
    rows[..., -1] = rng.integers(0, 2, (3, 16))
    others = frozen.next_actions(other, still, jnp.asarray(rows))
    # By hand: clip((o' - mean) / deviation), one hidden layer, sigmoid to [-1, 1].
    seen = np.clip((rows[..., plain.observation_columns[1]][..., :8] - scale.mean) / scale.deviation, -1.5, 1.5)
    p = {name: np.asarray(leaf[0]) for name, leaf in still[g].actor.items()}
    u = np.maximum(seen @ p["kernel_0"] + p["bias_0"], 0) @ p["kernel_1"] + p["bias_1"]
    by_hand = -1 + 2 / (1 + np.exp(-u))
    np.testing.assert_allclose(others[g][:, 0], by_hand, atol=1e-6)
    assert [one is None for one in others] == [k != g for k in range(len(others))]

    def learners(layout, state, frozen_next):
        hyper = [HYPER._replace(target_noise=0.0, **steps) for _ in layout.groups]
        return jax.jit(
            lambda rows: update.update(layout, state, hyper, rows, key, [True] * 2, frozen_next=frozen_next)
        )(rows)

    # The opponent that stands still has to see o' so that it does the same: its actor with the scale in its first
    # layer, where nothing is clipped.
    wide = Scale(scale.mean, scale.deviation, np.full(1, 1e6, np.float32))
    still[g] = still[g]._replace(scale=jax.tree.map(jnp.asarray, wide))
    others = frozen.next_actions(other, still, jnp.asarray(rows))
    kernel = state[g].actor["kernel_0"] / wide.deviation[0][None, :, None]
    bias = state[g].actor["bias_0"] - (wide.mean[0] @ kernel[0])[None]
    folded = {**state[g].actor, "kernel_0": kernel, "bias_0": bias}
    plain_state = tuple(
        group._replace(actor=folded, actor_target=folded) if k == g else group for k, group in enumerate(state)
    )
    wanted, wanted_metrics = learners(plain, plain_state, ())
    found, metrics = learners(other, tuple(still), others)
    for a, b in zip(jax.tree.leaves(found[1 - g]), jax.tree.leaves(wanted[1 - g]), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(metrics.critic_loss[1:], wanted_metrics.critic_loss[1:], rtol=1e-5)
    np.testing.assert_allclose(metrics.actor_loss[1:], wanted_metrics.actor_loss[1:], rtol=1e-4)
    assert np.isnan(metrics.critic_loss[0]) and np.isnan(metrics.actor_loss[0])


@pytest.mark.slow
def test_it_plays_without_noise_whatever_the_others_do():
    """While collecting, in a random warm-up, and in sampled episodes."""
    env = make("simple_adversary")
    layout = JointLayout.of(env, {"agents": LEARNER, "adversaries": Algorithm(hidden=(5,), frozen=True)})
    groups = update.init(layout, jax.random.key(0))
    policy = acting.PolicyParams(
        tuple(g.actor for g in groups), (HYPER,) * 2, None, tuple(group.scale for group in groups)
    )
    observation = [jnp.ones((4, size)) for size in env.observation_sizes]
    sampled = [acting.decide(layout, policy, observation, jax.random.key(k))[0] for k in range(2)]
    still, _ = acting.decide(layout, policy, observation, None)
    assert (sampled[0][0] == sampled[1][0]).all() and (sampled[0][0] == still[0]).all()
    assert not (sampled[0][1] == sampled[1][1]).any()
    start = rollout.start(env, jax.random.key(1), 4)
    for random in (False, True):
        _, rows, _, _ = rollout.collect(env, layout, policy, start, jax.random.key(2), 3, random=random)
        parts = layout.row_parts(rows)
        seen = [layout.observation_part(parts.x, i) for i in range(3)]
        done, _ = acting.decide(layout, policy, seen, None)
        np.testing.assert_allclose(layout.action_part(parts.action, 0), done[0], atol=1e-6)
        assert np.abs(layout.action_part(parts.action, 1) - done[1]).max() > 0.01
