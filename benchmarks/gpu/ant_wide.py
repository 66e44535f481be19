"""The Ant by the clock with `recipe=wide`: six seeds x 1M env steps, evaluated on the way, for several divisions of the
same replayed transitions into updates."""

import time

import jax
import numpy as np

from benchmarks.gpu.report import Report, Row
from benchmarks.gpu.timing import Length
from experiments import evaluations, figures, tidy
from experiments.tidy import Table
from matd3_jax import config
from matd3_jax.figures.style import SERIES
from matd3_jax.training.session import TrainingSession

SEEDS, STEPS = 6, 1_000_000
COLUMNS = ("seed", "step", "updates", *evaluations.COLUMNS)
UPDATES = {"128 of 512": (128, 512), "64 of 1,024": (64, 1024), "wide": (16, 4096)}
"""Updates after every 1,024 env steps, and transitions in each: 64 replayed transitions an env step in all of them. The
first has recipe=fast's minibatches. In this order, as time may not suffice for all."""


def run(report: Report, scale: float, length: Length) -> None:
    """The whole trainings, a case each; `length` is of measurements that repeat."""
    del length
    for name in UPDATES:
        report.case("ant_wide", name, lambda n=name: measure(report, n, scale))
    draw(report)


def settings(name: str, scale: float) -> list[str]:
    line = ["env=ant", "algo=matd3", "recipe=wide", "env.physics=mjx", "eval_episodes=10"]
    updates, batch = UPDATES[name]
    if scale >= 1:
        # An evaluation is 1,000 env steps one after another, as many as train six seeds for 1M.
        sizes = [f"updates_per_collect={updates}", f"batch_size={batch}", "eval_every=500000", "log_every=20000"]
        return [*line, *sizes, f"seeds={SEEDS}", f"total_steps={STEPS}"]
    small = ["num_envs=8", f"updates_per_collect={updates // 16}", "batch_size=32", "replay_capacity=2000"]
    small += ["learning_starts=64", "eval_episodes=1", "seeds=1", "env.episode_length=20"]
    return [*line, *small, f"total_steps={max(200, round(STEPS * scale / 50))}"]


def measure(report: Report, name: str, scale: float) -> Row:
    """Seconds of the whole training, compilation among them; it stops early where the report's time is over. The
    evaluations go to ant_wide_NAME.csv."""
    training = TrainingSession(config.load(settings(name, scale)))
    begun = time.perf_counter()
    state, row = training.start()
    rows = [row]
    started = time.perf_counter() - begun
    first = None
    for _ in range(training.num_intervals):
        if time.monotonic() > report.end:
            break
        before = training.clock.training
        state, row = training.advance(state)
        first = training.clock.training - before if first is None else first
        rows.append(row)
    jax.block_until_ready(state)
    seconds = time.perf_counter() - begun
    table = Table({key: np.concatenate([row[key] for row in rows]) for key in COLUMNS})
    table = table.take(~np.isnan(table[evaluations.RETURN]))
    tidy.write(table, report.out / file(name))
    final = table.by_seed(evaluations.RETURN)[:, -1]
    return {
        "seeds": len(training.seeds),
        "env_steps": training.step(state),
        "num_envs": training.config.num_envs,
        "updates": int(row["updates"][0]),
        "seconds": seconds,
        "start_seconds": started,
        "first_interval_seconds": first,
        "intervals": len(rows) - 1,
        "training_seconds": training.clock.training,
        "evaluation_seconds": training.clock.evaluation,
        "last_return": float(final.mean()),
        "last_returns": [float(value) for value in final],
    }


def file(name: str) -> str:
    return f"ant_wide_{name.replace(' ', '_').replace(',', '')}.csv"


def draw(report: Report) -> None:
    """Learning curves of all trainings so far, into ant_wide.png."""
    figure, axes = figures.canvas(len(evaluations.COLUMNS), width=5.0, height=4.0)
    found = [name for name in UPDATES if (report.out / file(name)).exists()]
    for axis, column in zip(axes, evaluations.COLUMNS, strict=True):
        for name, color in zip(found, SERIES, strict=False):
            table = tidy.read(report.out / file(name))
            label = name if name == "wide" else f"wide with {name}"
            evaluations.draw(axis, table, column, color, label)
    if found:
        axes[0].legend(frameon=False)
        figures.save(figure, report.out / "ant_wide.png")
