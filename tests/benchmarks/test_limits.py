"""The least time of an iteration: products counted by hand against those of the compiled program, and how they are
timed."""

import math

import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks import limits
from matd3_jax import config
from matd3_jax.errors import UserError
from matd3_jax.training.session import TrainingSession

pytestmark = pytest.mark.slow

SMALL = ("total_steps=100", "replay_capacity=100", "learning_starts=100", "batch_size=16", "algo.hidden=[8,6]")


@pytest.mark.parametrize(
    "settings",
    [
        ("seeds=3",),
        ("seeds=1",),  # shared by both devices
        ("seeds=2", "shared_minibatch=true", "algo.policy_delay=1"),
        (
            "seeds=2",
            "env=simple_tag",
            "algo=maddpg",
            "adversary=iltd3",
            "adversary.hidden=[5]",
            "updates_per_collect=4",
        ),
        ("seeds=2", "env=simple_speaker_listener", "algo=td3", "algo.hidden=[8,6,4]"),
        ("seeds=2", "update_order=random_sequential", "algo.policy_delay=1"),
        ("seeds=2", "env=simple_tag", "algo=m3matd3", "adversary=m3ddpg", "adversary.hidden=[5]"),
        (
            "seeds=2",
            "algo.critic_norm=layer",
            "algo.critic_head=categorical",
            "algo.critic_range=[-50,0]",
            "algo.policy_delay=1",
        ),
        ("seeds=2", "algo.num_critics=5", "algo.target_critics=2", "algo.actor_critics=all"),
        ("seeds=2", "env=simple_tag", "algo.share_parameters=kind", "algo.policy_delay=1"),
        ("seeds=2", "env=simple_speaker_listener", "algo.critic=shared"),
        ("seeds=2", "algo.critic=shared", "algo.share_parameters=kind", "shared_minibatch=true"),
        (
            "seeds=2",
            "algo=m3matd3",
            "algo.policy_delay=1",
            "algo.critic_head=quantile",
            "algo.critic_quantiles=6",
            "algo.num_critics=3",
            "algo.target_critics=2",
            "algo.actor_critics=all",
        ),
    ],
    ids=str,
)
def test_products_by_hand_are_those_of_the_compiled_program(settings):
    trainer = TrainingSession(config.load([*SMALL, *settings])).trainer
    by_hand = trainer.mesh.size * sum(n * product.flops for product, n in limits.products(trainer).items())
    parts = [sum(n * p.flops for p, n in limits.products(trainer, part).items()) for part in ("rollout", "update")]
    assert trainer.mesh.size * sum(parts) == pytest.approx(by_hand, rel=1e-12) and min(parts) > 0
    assert limits.compiled_flops(trainer) == pytest.approx(by_hand, rel=1e-12)


def test_loops_count_as_often_as_they_run():
    text = """HloModule m

%inner (p: (f32[4,8], f32[8,2])) -> f32[4,2] {
  %a = f32[4,8]{1,0} get-tuple-element(%p), index=0
  %b = f32[8,2]{1,0} get-tuple-element(%p), index=1
  ROOT %d = f32[4,2]{1,0} dot(%a, %b), lhs_contracting_dims={1}, rhs_contracting_dims={0}
}

ENTRY %main (x: f32[4,8]) -> f32[4,2] {
  %f = f32[4,2]{1,0} fusion(%x), kind=kCustom, calls=%inner
  %w = (f32[4,8]) while(%f), condition=%none, body=%inner, backend_config={"known_trip_count":{"n":"5"}}
}

%none (p: f32[]) -> pred[] {
  ROOT %c = pred[] constant(true)
}
"""
    assert limits.counted_flops(text) == 6 * 2 * 4 * 8 * 2
    with pytest.raises(ValueError, match="no known count"):
        limits.counted_flops(text.replace("known_trip_count", "unknown"))


def test_a_product_is_timed_by_itself():
    """Flops of an equation, and a time that grows with the work (sixty times as much here)."""
    small, large = (limits.Product("sbi,sio->sbo", (2, n, 64), (2, 64, 64)) for n in (32, 2048))
    assert small.flops == 2 * 2 * 32 * 64 * 64
    x, w = (np.random.default_rng(0).normal(size=shape) for shape in (small.left, small.right))
    np.testing.assert_allclose(jnp.einsum(small.equation, x, w), x @ w, rtol=1e-4, atol=1e-4)
    assert limits.seconds(large, 1, 3) > 8 * limits.seconds(small, 1, 3)
    assert math.isfinite(limits.seconds(small, 2, 1))


def test_recurrent_networks_are_not_counted_product_by_product():
    trainer = TrainingSession(config.load([*SMALL, "seeds=2", "algo.actor=gru"])).trainer
    with pytest.raises(UserError, match=r"^actor=gru: the products of perceptrons alone"):
        limits.products(trainer)
