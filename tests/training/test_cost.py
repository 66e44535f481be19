"""What a run is expected to take: products counted against `benchmarks.limits`, rates, and what is said of them."""

import re
from types import SimpleNamespace

import jax
import numpy as np
import pytest

from benchmarks import limits
from matd3_jax import config
from matd3_jax.training import cost
from matd3_jax.training.session import TrainingSession

pytestmark = pytest.mark.slow

SMALL = ("total_steps=2000", "replay_capacity=200", "learning_starts=100", "batch_size=16", "seeds=2")
ANT = ("env=ant", "num_envs=1", "rollout_length=1", "updates_per_collect=1", "algo.hidden=[400,300]")
WIDE = ("num_envs=20", "rollout_length=1", "updates_per_collect=2", "algo.hidden=[128,128]")


def training(*settings, **options):
    return TrainingSession(config.load([*SMALL, *settings]), **options)


@pytest.mark.parametrize(
    "settings",
    [
        ("env=simple_spread",),
        ("env=simple_spread", "shared_minibatch=true", "algo.hidden=[7,5]"),
        ("env=simple_tag", "algo=matd3", "adversary=iddpg", "adversary.hidden=[30]", "updates_per_collect=4"),
        ("env=simple_tag", "algo=maddpg", "adversary=iltd3", "shared_minibatch=true", "algo.policy_delay=2"),
        ("env=simple_tag", "algo=m3matd3", "adversary=m3ddpg"),
        ("env=simple_tag", "algo=matd3", "adversary=iltd3", "update_order=random_sequential"),
        ("env=simple_tag", "algo=m3ddpg", "algo.critic_head=categorical", "algo.critic_range=[-9,9]"),
        (*ANT, "env.split=halves"),
        ("env=ant", "env.split=4x2", *WIDE),
        (*ANT, "algo=td3"),
        ("env=simple_spread", "algo.num_critics=5", "algo.target_critics=2", "algo.actor_critics=all"),
        ("env=simple_spread", "algo.share_parameters=kind"),
        ("env=simple_world_comm", "algo.critic=shared", "adversary=matd3", "adversary.share_parameters=kind"),
        ("env=simple_tag", "algo.critic=shared", "update_order=random_sequential"),
        ("env=simple_tag", "algo=m3matd3", "algo.critic_head=quantile", "algo.num_critics=3", "algo.actor_critics=all"),
        (*ANT, "algo.critic_head=categorical", "algo.critic_range=[-50,500]", "algo.critic_atoms=21"),
        ("env=hopper", "env.split=[[thigh_joint],[leg_joint],[foot_joint]]", *WIDE, "algo.policy_delay=4"),
    ],
    ids=" ".join,
)
def test_products_are_those_of_the_limits(settings):
    """Counted for one env step of one seed; there, product by product for a whole iteration of a device."""
    found = training(*settings)
    trainer, layout, schedule = found.trainer, found.layout, found.trainer.schedule
    by_part = {
        part: sum(n * product.flops for product, n in limits.products(trainer, part).items())
        / (trainer.sharding.local_seeds * trainer.iteration_steps)
        for part in ("rollout", "loop")
    }
    assert trainer.sharding.devices_per_seed == 1
    assert cost.acting_flops(layout) == pytest.approx(by_part["rollout"], rel=1e-12)
    assert cost.step_flops(layout, schedule) == pytest.approx(by_part["loop"], rel=1e-12)


def test_one_after_another_each_agent_runs_the_target_actors():
    """A minibatch for all saves target actors only where all agents learn at once."""
    once, each, own = (
        training("env=simple_spread", f"shared_minibatch={shared}", f"update_order={order}")
        for shared, order in (("true", "simultaneous"), ("true", "sequential"), ("false", "simultaneous"))
    )
    flops = [cost.update_flops(t.layout, t.trainer.schedule) for t in (once, each, own)]
    assert flops[0] < flops[1] == flops[2]


@pytest.fixture
def timed(monkeypatch):
    """What is timed is run three times and then said to have taken half a second; the programs, and what they gave."""
    ran = []

    def repeated(program, wanted):
        ran.append((program, np.asarray(program(3))))
        return 3, 0.5

    monkeypatch.setattr(cost, "_repeated", repeated)
    return ran


def test_the_rate_of_products(timed):
    """Each repetition is a product with the batch and one with its transpose, on each device: as many operations as
    are divided by the time, and none left out by the compiler."""
    devices, (batch, inputs, outputs) = tuple(jax.local_devices()), (7, 5, 3)
    rate = cost.product_rate(devices, batch, inputs, outputs)
    assert rate == 3 * len(devices) * (2 * 2 * batch * inputs * outputs) / 0.5
    ((_, kernels),) = timed
    x, kernel = (np.full(shape, 0.01) for shape in ((batch, inputs), (inputs, outputs)))
    for _ in range(3):
        kernel = kernel - 1e-3 * (x.T @ (x @ kernel))
    np.testing.assert_allclose(kernels, [kernel] * len(devices), rtol=1e-6)
    assert not np.allclose(kernels, 0.01, rtol=1e-6, atol=0)


@pytest.mark.parametrize("name", ["ant", "hopper"])
def test_the_rate_of_c_physics(name, timed):
    """Env steps of all robots of one device, also behind a joint team; each was really stepped, and differently."""
    found = training(*ANT, f"env={name}", "env.physics=c", "algo=td3")
    devices = tuple(jax.local_devices())
    assert cost.physics_rate(found.env, devices, 4) == 3 * 4 / 0.5
    ((program, thrice),) = timed
    once = np.asarray(program(1))
    robot = cost.innermost(found.env)
    assert thrice.shape == (len(devices), 4, robot.mj_model.nq)
    for before, after in ((robot.mj_model.qpos0, once), (once, thrice)):
        assert (np.abs(after - before).max(axis=-1) > 0).all()
    assert len(np.unique(thrice[0], axis=0)) == 4


@pytest.mark.parametrize("physics", ["mjx_fast", "mjx"])
def test_the_rate_of_other_physics_is_known(physics, timed):
    devices = tuple(jax.local_devices())
    env = training(*ANT, f"env.physics={physics}", "algo=td3").env
    assert cost.physics_rate(env, devices, 4) == cost.MJX_STEPS[physics]
    assert cost.physics_rate(training("env=simple_spread").env, devices, 4) is None
    assert not timed


def test_what_is_timed(monkeypatch):
    """Repetitions and seconds of whole calls, long enough each to be timed, and without the first, which compiles."""
    now, calls = [0.0], []
    monkeypatch.setattr(cost, "time", SimpleNamespace(perf_counter=lambda: now[0]))

    def program(count):
        now[0] += 2**-10 * count + (0 if calls else 60)
        calls.append(count)

    count, taken = cost._repeated(program, 1.0)
    timed = [n for n in calls if n == calls[-1]]
    # Calls of 1, 4, 16 and 64 repetitions take less than a tenth of a second.
    assert calls[:5] == [1, 1, 4, 16, 64] and calls[-1] == 256
    assert count == sum(timed[1:]) == 1024 and taken == 2**-10 * count


def test_the_expectation_by_hand(monkeypatch):
    monkeypatch.setattr(cost, "product_rate", lambda *_: 2e9)
    monkeypatch.setattr(cost, "physics_rate", lambda *_: 5678.0)
    settings = (*ANT, "total_steps=20000", "learning_starts=10000", "replay_capacity=20000")
    found = training(*settings, "eval_every=1000", "eval_episodes=3")
    layout, schedule, total = found.layout, found.trainer.schedule, found.total_steps
    warm_up = found.trainer.schedule.warmup_steps
    assert warm_up < 10000 and 20000 <= total < 21000
    played = total + 12 * 3 * 1000  # evaluations after the warm-up and at 10,000, 11,000 ... 20,000
    flops = played * cost.acting_flops(layout) + (total - warm_up) * cost.update_flops(layout, schedule)
    seconds = 2 * flops / (0.6 * 2e9) + played / 5678  # each of two devices steps one seed
    assert cost.expectation(found) == (
        f"expected: about {seconds / 60:.0f} minutes, compiling apart "
        "(products at 2 GFLOP/s measured on these devices, physics 5,700 env steps/s a core)"
    )
    assert 2 < seconds / 60 < 60
    # Of a run that continues, what is left.
    rest = cost.expectation(found, done=warm_up + (total - warm_up) // 2)
    minutes = int(re.search(r"about (\d+) minutes", rest)[1])
    assert minutes < seconds / 60 / 1.5


def test_what_is_not_known_is_not_guessed(monkeypatch):
    found = training("env=simple_spread")
    assert "own time is not counted" in cost.expectation(found)
    monkeypatch.setattr(found, "processes", SimpleNamespace(size=2))
    assert "not estimated for several processes" in cost.expectation(found)
    monkeypatch.undo()
    monkeypatch.setattr(found.trainer, "on_cpu", False)
    assert "not estimated for an accelerator" in cost.expectation(found)


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(5, "under a minute"), (61, "about 1 minute"), (1500, "about 25 minutes"), (3300, "about 55 minutes"),
     (3600, "about 1.0 hours"), (54000, "about 15 hours")],
)  # fmt: skip
def test_durations(seconds, text):
    assert cost.duration(seconds) == text


@pytest.mark.parametrize(
    "more",
    [
        ["sequence_length=4", "burn_in=2"],
        ["sequence_length=4", "burn_in=0", "algo.critic=own", "algo.num_critics=1"],
        ["sequence_length=8", "burn_in=2", "env=simple_tag", "adversary=iltd3", "algo.num_critics=3"],
    ],
    ids=" ".join,
)
def test_products_of_recurrent_networks_are_those_of_the_compiled_program(more):
    found = training("env=simple_spread", "algo.actor=gru", "algo.gru_units=5", *more)
    trainer = found.trainer
    flops = cost.step_flops(found.layout, trainer.schedule) * trainer.iteration_steps * trainer.sharding.padded_seeds
    assert limits.compiled_flops(trainer) == pytest.approx(flops, rel=1e-12)
