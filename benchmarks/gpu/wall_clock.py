"""The paper's simple_spread experiment by the clock: 20 seeds x 60,000 episodes, and whether they learn the same."""

import time
from pathlib import Path

import jax
import numpy as np

from benchmarks.gpu.checks import PRECISIONS
from benchmarks.gpu.report import Report, Row
from experiments import figures, tidy
from experiments.tidy import Table
from matd3_jax import config
from matd3_jax.figures.style import SERIES
from matd3_jax.stats import intervals
from matd3_jax.training.session import TrainingSession

RECORDED = Path(__file__).parents[2] / "experiments" / "results" / "cooperative" / "data.csv"
"""Ten seeds of the same, trained on a CPU."""

SEEDS, STEPS, LOG_EVERY = 20, 1_500_000, 12_500
RETURN = "return_agents"
POINTS = (5_000, 10_000, 20_000, 40_000, 60_000)
"""Episodes at which returns are compared with the CPU's."""


def run(report: Report, scale: float) -> None:
    case(report, scale, "default")


def case(report: Report, scale: float, precision: str) -> None:
    """One of `checks.PRECISIONS`, and the picture of all so far."""
    report.case("wall_clock", precision, lambda: measure(precision, PRECISIONS[precision], scale, report.out))
    draw(report.out)


def measure(name: str, precision: str | None, scale: float, out: Path) -> Row:
    """Seconds from the first random number to the last update, with all metrics on the host, after one run of every
    program. The curves go to simple_spread_NAME.csv."""
    seeds, steps = (SEEDS, STEPS) if scale >= 1 else (2, max(30_000, round(STEPS * scale)))
    line = ["env=simple_spread", "algo=matd3", f"seeds={seeds}", f"total_steps={steps}", f"log_every={LOG_EVERY}"]
    with jax.default_matmul_precision(precision):
        training = TrainingSession(config.load([*line, "eval_every=0"]))
        begun = time.perf_counter()
        jax.block_until_ready(training.advance(training.start()[0])[0])
        first = time.perf_counter() - begun
        begun = time.perf_counter()
        state, row = training.start()
        rows, warm_up = [row], time.perf_counter() - begun
        for _ in range(training.num_intervals):
            state, row = training.advance(state)
            rows.append(row)
        jax.block_until_ready(state)
        seconds = time.perf_counter() - begun
    columns = ("seed", "step", "updates", "episodes", RETURN)
    table = Table({key: np.concatenate([row[key] for row in rows]) for key in columns})
    tidy.write(table, out / f"simple_spread_{name}.csv")
    interval = (seconds - warm_up) / training.num_intervals
    return {
        "seeds": seeds,
        "episodes": training.total_steps // 25,
        "seconds": seconds,
        "warm_up_seconds": warm_up,
        "compile_seconds": max(0.0, first - warm_up - interval),
        "env_steps_per_second": seeds * training.total_steps / seconds,
        "returns": compared(table, recorded()),
    }


def recorded() -> Table:
    return tidy.read(RECORDED).where(env="simple_spread", algo="matd3")


def compared(ours: Table, theirs: Table) -> list[Row]:
    """Mean returns of the last 1,000 episodes at `POINTS` (of a shorter run at its end), ours minus theirs with the
    95 % interval of the difference and its p-value, of which chance alone brings one in twenty below 0.05."""
    (episodes, values), (their_episodes, their_values) = trailing(ours), trailing(theirs)
    end = min(episodes[-1], their_episodes[-1])
    found = []
    for point in [p for p in POINTS if p <= end] or [int(end)]:
        a = np.array([np.interp(point, episodes, curve) for curve in values])
        b = np.array([np.interp(point, their_episodes, curve) for curve in their_values])
        test = intervals.compare(a, b)
        row = {"ours": a.mean(), "cpu": b.mean(), "difference": test.difference, "low": test.low, "high": test.high}
        found.append({"episodes": point, **{key: float(value) for key, value in row.items()}, "p": float(test.p)})
    return found


def trailing(table: Table) -> tuple[np.ndarray, np.ndarray]:
    """(episodes [points], mean return over the last 1,000 [seeds, points])."""
    episodes = table.by_seed("episodes")
    means = tidy.trailing_mean(episodes, table.by_seed(RETURN), tidy.WINDOW)
    return np.cumsum(episodes, axis=1).mean(axis=0), means


def draw(out: Path) -> None:
    """The curves of this device over the CPU's, into simple_spread.png."""
    figure, (axis,) = figures.canvas(1, width=6.0, height=4.0)
    curves = {"CPU": recorded()}
    curves |= {f"here, {name}": tidy.read(out / f"simple_spread_{name}.csv") for name in ("default", "float32")}
    for (label, table), color in zip(curves.items(), SERIES, strict=False):
        if len(table):
            episodes, means = trailing(table)
            figures.band(axis, episodes / 1000, means, color, label)
    axis.set_xlabel("episodes (thousands)")
    axis.set_ylabel("return, mean of the last 1,000 episodes")
    axis.set_title("MATD3 on simple_spread")
    axis.legend(frameon=False, loc="lower right")
    figures.save(figure, out / "simple_spread.png")
