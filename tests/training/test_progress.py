"""What the progress line says of given rows and times, and where a run's time is counted."""

import time
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import matd3_jax
from matd3_jax.runs.divergence import Divergence
from matd3_jax.training import clock, progress
from matd3_jax.training.clock import Clock
from matd3_jax.training.program import Program
from matd3_jax.training.session import TrainingSession

NAN = np.full(2, np.nan)


@pytest.fixture
def now(monkeypatch):
    """The time [1] on the clock of a run, which stands still."""
    seconds = [100.0]
    monkeypatch.setattr(clock, "time", SimpleNamespace(monotonic=lambda: seconds[0]))
    return seconds


@pytest.fixture
def begin(monkeypatch):
    """`begin(row)`: a bar of two seeds and 1,000 env steps, two evaluations of 8 s to come, in which time stands still
    but for `bar.spend(seconds, ...)`."""
    now = SimpleNamespace(seconds=100.0, compiled=7.0)
    monkeypatch.setattr(progress.time, "monotonic", lambda: now.seconds)
    monkeypatch.setattr(progress, "compiling", lambda: now.compiled)

    def begin(row):
        clock = Clock()
        clock.evaluation, clock.evaluations = 8.0, 1  # before the bar, on the untrained policies
        training = SimpleNamespace(
            total_steps=1000, share=SimpleNamespace(total=2), clock=clock, evaluations_after=lambda step: 2
        )
        bar = progress.ProgressBar(training, row)

        def spend(training=0.0, evaluation=0.0, compiling=0.0, other=0.0):
            clock.training += training
            clock.evaluation += evaluation
            clock.evaluations += evaluation > 0
            now.compiled += compiling
            now.seconds += training + evaluation + compiling + other

        bar.spend = spend
        return bar

    return begin


def row(step, **columns):
    return {"step": np.array([step] * 2), "updates": np.array([step // 10] * 2), **columns}


def shown(bar, capsys, given):
    bar.printed = 0.0
    bar.log(given)
    return capsys.readouterr().out.strip()


def test_before_an_episode_has_ended(begin, capsys):
    """The evaluation alone, with the robot's speed; then the return, kept for the intervals in which none ends."""
    first = {"eval_return_agents": np.array([10.0, 14]), "eval_forward_velocity": np.array([1.2, 1.22])}
    bar = begin(row(100, return_agents=NAN, **first))
    missing = {"return_agents": NAN, "eval_return_agents": NAN, "eval_forward_velocity": NAN}
    bar.spend(training=10)
    assert shown(bar, capsys, row(200, **missing)).endswith("| agents: evaluation 12.0 ± 2.8, 1.21 m/s")
    bar.spend(training=10)
    text = shown(bar, capsys, row(300, **missing | {"return_agents": np.array([5.0, 7])}))
    assert text.endswith("| agents 6.0 ± 1.4 (evaluation 12.0 ± 2.8, 1.21 m/s)")
    bar.spend(training=10)
    text = shown(bar, capsys, row(400, **missing))
    assert text.endswith("| agents 6.0 ± 1.4 at 300 (evaluation 12.0 ± 2.8, 1.21 m/s)")
    bar.spend(training=10)
    text = shown(bar, capsys, row(500, return_agents=np.array([np.nan, 8]), eval_return_agents=np.array([1.0, 1]),
                                  eval_forward_velocity=np.array([-2.0, 0])))  # fmt: skip
    assert text.endswith("| agents 8.0, 1 of 2 seeds (evaluation 1.0 ± 0.0, -1.00 m/s)")


def test_seeds_that_diverged_are_left_out_and_named(begin, capsys):
    """Of what was known of them before they diverged, too."""
    bar = begin(row(0))
    bar.spend(training=10)
    both = {"seed": np.array([5, 6]), "return_agents": np.array([1.0, 3]), "eval_return_agents": np.array([5.0, 9])}
    assert shown(bar, capsys, row(100, **both)).endswith("| agents 2.0 ± 1.4 (evaluation 7.0 ± 2.8)")
    bar.diverged = {1: Divergence(200, "agent_0_critic_loss is nan")}
    bar.spend(training=10)
    missing = {"seed": np.array([5, 6]), "return_agents": NAN, "eval_return_agents": NAN}
    text = shown(bar, capsys, row(200, **missing))
    assert text.endswith("| agents 1.0 at 100 (evaluation 5.0) | 1 of 2 seeds, seed 6 diverged at 200")
    bar.diverged = {0: Divergence(300, "x is inf"), **bar.diverged}
    bar.spend(training=10)
    text = shown(bar, capsys, row(300, **both))
    assert text.endswith("left | none of 2 seeds, seed 5 diverged at 300, seed 6 diverged at 200")


def test_without_evaluations_and_without_measures(begin, capsys):
    bar = begin(row(0))  # as a run that is resumed
    bar.spend(training=10)
    text = shown(bar, capsys, row(100, return_agents=NAN))
    assert text.endswith("left | no episode has ended since env step 0")
    bar.spend(training=10)
    returns = {"return_agents": np.array([1.0, 2]), "return_adversaries": np.array([3.0, 3])}
    assert shown(bar, capsys, row(200, **returns)).endswith("left | agents 1.5 ± 0.7 | adversaries 3.0 ± 0.0")
    evaluated = {"eval_return_agents": np.array([5.0, 5]), "eval_return_adversaries": np.array([6.0, 6])}
    text = shown(bar, capsys, row(300, **returns, **evaluated))
    assert text.endswith("agents 1.5 ± 0.7 (evaluation 5.0 ± 0.0) | adversaries 3.0 ± 0.0 (evaluation 6.0 ± 0.0)")


def test_rates_are_the_trainings(begin, capsys):
    """Neither compiling nor evaluations slow them down; the share of evaluations is shown, and is in the time left."""
    bar = begin(row(0))
    assert bar.rates() == {}
    bar.spend(training=10, compiling=60)
    text = shown(bar, capsys, row(100, return_agents=np.ones(2)))
    # 200 env steps in 10 s; 900 to go at 10 s a hundred, and two evaluations of 8 s.
    assert text.startswith("10% 100/1,000 env steps | 20 env steps/s, 2 updates/s | 1:46 left | agents")
    bar.spend(training=10, evaluation=4, other=1, compiling=5)
    text = shown(bar, capsys, row(200, return_agents=np.ones(2)))
    # (20 + 1) s for 200 steps, without the evaluation; two more at (8 + 4) / 2 s. 4 of 25 s are evaluations.
    assert text.startswith("20% 200/1,000 env steps | 20 env steps/s, 2 updates/s | evaluations 16 % | 1:36 left")
    assert bar.rates() == {
        "env_steps_per_second": pytest.approx(400 / 25),
        "updates_per_second": pytest.approx(40 / 25),
        "training_env_steps_per_second": pytest.approx(20),
        "evaluation_share": pytest.approx(4 / 25),
    }


def test_compiling_is_noticed():
    """By JAX's own reports; a part is not counted besides the whole that it belongs to."""
    before, begun = clock.compiling(), time.monotonic()
    program = jax.jit(lambda x: jnp.where(x > 0, jax.nn.softmax(x @ x), jnp.sin(x)).sum())
    program(np.ones((17, 17), np.float32))
    compiled = clock.compiling()
    assert 0 < compiled - before <= time.monotonic() - begun
    program(np.zeros((17, 17), np.float32))
    assert clock.compiling() == compiled


def test_compiling_is_left_out(now, monkeypatch):
    """Of what training and evaluations take; together they are what was spent in the run."""
    monkeypatch.setattr(clock, "_compiled", [])
    counted = Clock()
    with counted.train():
        now[0] += 5
        clock._note("/jax/core/compile/any", 3)
        now[0] += 0.5
    with counted.evaluate():
        now[0] += 7
        clock._note("/jax/core/compile/any", 1)
    now[0] += 100
    assert (counted.training, counted.evaluation, counted.evaluations) == (2.5, 6, 1)


def test_nested_reports_count_once(monkeypatch):
    monkeypatch.setattr(clock, "_compiled", [])
    for now, seconds in ((10, 2), (13, 1), (14, 6), (20, 3)):  # the third holds the first two
        monkeypatch.setattr(clock.time, "monotonic", lambda now=now: now)
        clock._note("/jax/core/compile/any", seconds)
        clock._note("/jax/another", 100)
    assert clock.compiling() == 6 + 3


@pytest.mark.slow
def test_a_run_counts_its_evaluations(now, monkeypatch):
    """As many as have numbers in the table and as were expected; what an evaluation takes is no training."""
    monkeypatch.setattr(clock, "compiling", lambda: 0.0)

    def takes(seconds, function):
        def slow(*args, **options):
            now[0] += seconds
            return function(*args, **options)

        return slow

    monkeypatch.setattr(TrainingSession, "evaluate", takes(8, TrainingSession.evaluate))
    monkeypatch.setattr(Program, "__call__", takes(3, Program.__call__))
    left = []
    result = matd3_jax.train(
        "algo.hidden=[8]", env="simple", seeds=2, num_envs=2, batch_size=8, learning_starts=100, total_steps=1000,
        log_every=100, eval_every=250, replay_capacity=500, callback=lambda row: left.append(int(row["step"][0])),
    )  # fmt: skip
    training = result.training
    evaluated = np.isfinite(result.metrics["eval_return_agents"][0])
    assert evaluated.sum() == training.clock.evaluations >= 5
    for interval, step in enumerate(left):
        assert training.evaluations_after(step) == evaluated[interval + 1 :].sum()
    assert training.clock.evaluation == 8 * training.clock.evaluations
    assert training.clock.training == 3 * len(left[1:])


def test_seconds_as_people_read_them():
    assert [progress._duration(s) for s in (5, 65, 3661)] == ["0:05", "1:05", "1:01:01"]
