"""The Ant by the clock with `recipe=wide`: six seeds x 1M env steps, evaluated on the way."""

import time

import jax
import numpy as np

from benchmarks.gpu.report import Report, Row
from benchmarks.gpu.stretch import Length
from experiments import evaluations, figures, tidy
from experiments.tidy import Table
from matd3_jax import config
from matd3_jax.training.session import TrainingSession

SEEDS, STEPS = 6, 1_000_000
COLUMNS = ("seed", "step", "updates", *evaluations.COLUMNS)


def run(report: Report, scale: float, length: Length) -> None:
    """The whole training, as one case; `length` is of measurements that repeat."""
    del length
    report.case("ant_wide", "training", lambda: measure(report, scale))


def settings(scale: float) -> list[str]:
    line = ["env=ant", "algo=matd3", "recipe=wide", "env.physics=mjx", "eval_episodes=10"]
    if scale >= 1:
        return [*line, f"seeds={SEEDS}", f"total_steps={STEPS}"]
    small = ["num_envs=8", "batch_size=32", "replay_capacity=2000", "learning_starts=64", "eval_episodes=1"]
    return [*line, *small, "seeds=1", f"total_steps={max(200, round(STEPS * scale / 50))}", "env.episode_length=20"]


def measure(report: Report, scale: float) -> Row:
    """Seconds of the whole training, compilation apart. The evaluations go to ant_wide.csv and ant_wide.png."""
    training = TrainingSession(config.load(settings(scale)))
    begun = time.perf_counter()
    state, row = training.start()
    rows = [row]
    for _ in range(training.num_intervals):
        state, row = training.advance(state)
        rows.append(row)
    jax.block_until_ready(state)
    seconds = time.perf_counter() - begun
    table = Table({key: np.concatenate([row[key] for row in rows]) for key in COLUMNS})
    table = table.take(~np.isnan(table[evaluations.RETURN]))
    tidy.write(table, report.out / "ant_wide.csv")
    figure, axes = figures.canvas(len(evaluations.COLUMNS), width=5.0, height=4.0)
    for axis, column in zip(axes, evaluations.COLUMNS, strict=True):
        evaluations.draw(axis, table, column, figures.COLORS["matd3"], "MATD3, recipe=wide")
    axes[0].legend(frameon=False)
    figures.save(figure, report.out / "ant_wide.png")
    final = table.by_seed(evaluations.RETURN)[:, -1]
    clock = training.clock
    return {
        "seeds": len(training.seeds),
        "env_steps": training.total_steps,
        "num_envs": training.config.num_envs,
        "seconds": seconds,
        "training_seconds": clock.training,
        "evaluation_seconds": clock.evaluation,
        "last_return": float(final.mean()),
        "last_returns": [float(value) for value in final],
    }
