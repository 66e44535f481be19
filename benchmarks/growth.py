"""`python -m benchmarks.growth`: how time and memory of the whole loop grow with seeds, agents, replay and batch.

simple_spread, each axis alone (an empty list leaves it out); the others stay at the paper's settings with `few_seeds`
seeds and a replay of 25,600 transitions, where learning starts in the paper. Replays are full. Other keys are settings
of the run. Each point is a process of its own (`benchmarks.loop`): time of an iteration of all seeds (200 env steps of
each and, for MATD3, two updates), median of `repeats` blocks of `seconds`; memory as XLA counts it for the compiled
interval, and at most of the whole process. The exponent k of time ~ value^k is the slope of a least-squares line
through the logarithms: over all points, and over the upper half of them. A figure is drawn next to `out`.
"""

import dataclasses
import sys
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from benchmarks import fresh, growth_figure
from benchmarks.commit import commit
from benchmarks.options import OfARun
from matd3_jax.cli import command
from matd3_jax.cli.options import Command, option
from matd3_jax.errors import UserError
from matd3_jax.runtime import devices
from matd3_jax.runtime.terminal import say

AXES: dict[str, list[int]] = {
    "seeds": [1, 2, 4, 8, 16, 32, 64],
    "agents": [3, 6, 12, 24],
    "replay": [10_000, 32_000, 100_000, 320_000, 1_000_000],
    "batch": [128, 512, 1024, 2048, 8192],
}
BASE = {"agents": 3, "replay": 25_600, "batch": 1024}


@dataclasses.dataclass(frozen=True)
class Options(OfARun):
    """Options of this benchmark: the values of each axis, an empty list leaves it out."""

    seeds: tuple[int, ...] = option("numbers of seeds", default=tuple(AXES["seeds"]), least=1)
    agents: tuple[int, ...] = option("numbers of agents", default=tuple(AXES["agents"]), least=1)
    replay: tuple[int, ...] = option("transitions that a replay keeps", default=tuple(AXES["replay"]), least=1)
    batch: tuple[int, ...] = option("transitions of a minibatch", default=tuple(AXES["batch"]), least=1)
    few_seeds: int = option("seeds of the other axes", default=2, least=1)
    repeats: int = option("measurements", default=5, least=1)
    seconds: float = option("length of a measurement", default=1.0, unit="seconds", above=0)


COMMAND = Command("python -m benchmarks.growth", Options, __doc__)


QUANTITIES = {
    "time": lambda point: point["cycle_seconds"],
    "products": lambda point: point["product_flops_of_a_cycle"],
    "memory": lambda point: point["memory"]["xla"],
    "process": lambda point: point["memory"]["process"],
}
"""What exponents are fitted to."""


def main(argv: Sequence[str]) -> int:
    options = COMMAND.parse(argv)
    report: dict[str, Any] = {
        "versions": devices.versions(),
        "commit": commit(),
        "settings": list(argv),
        "others": {"seeds": options.few_seeds, **BASE},
    }
    say(f"commit {report['commit']}; settings of the other axes {report['others']}")
    say(f"{'axis':<7} {'value':>9} {'ms/iter':>11} {'env steps/s':>12} {'GFLOP':>8} {'XLA, MB':>9} "
          f"{'of it replay':>12} {'temporaries':>11} {'process':>8} {'compiled in':>11}")  # fmt: skip
    axes: dict[str, list[dict[str, Any]]] = {}
    report["axes"] = axes
    measured: dict[tuple, dict[str, Any]] = {}
    for axis in AXES:
        for value in getattr(options, axis):
            point = {"seeds": options.few_seeds, **BASE, axis: value}
            key = tuple(point.values())
            if key not in measured:
                measured[key] = _measure([*settings(point), *options.overrides], options)
            axes.setdefault(axis, []).append({"value": value, **measured[key]})
            _show(axis, axes[axis][-1])
    report["machine"] = next((m.pop("machine") for m in measured.values() if "machine" in m), None)
    for points in axes.values():
        for point in points:
            point.pop("machine", None)
    report["exponents"] = exponents(axes)
    for axis, found in report["exponents"].items():
        say(f"{axis}: " + "; ".join(f"{name} ~ {axis}^{k['all']:.2f} (upper half {k['upper']:.2f})"
                                      for name, k in found.items()))  # fmt: skip
    options.write(report)
    if options.out is not None:
        growth_figure.draw(options.out.with_suffix(".png"), axes)
        say(f"figure: {options.out.with_suffix('.png')}")
    return 0


def settings(point: Mapping[str, int]) -> list[str]:
    """Settings of a run at a point {"seeds", "agents", "replay", "batch"}: the replay is full when learning starts."""
    return [
        "env=simple_spread",
        f"env.num_agents={point['agents']}",
        f"seeds={point['seeds']}",
        f"batch_size={point['batch']}",
        f"replay_capacity={point['replay']}",
        f"learning_starts={point['replay']}",
        f"total_steps={2 * point['replay']}",
        "eval_every=0",
    ]


def exponents(axes: Mapping[str, Sequence[Mapping[str, Any]]]) -> dict[str, dict[str, dict[str, float]]]:
    """{axis: {quantity: {"all", "upper"}}}: exponents of growth over all points that were measured, and over the upper
    half (at least two). Axes with fewer than two points are left out."""
    found: dict[str, dict[str, dict[str, float]]] = {}
    for axis, points in axes.items():
        there = [point for point in points if "error" not in point]
        if len(there) < 2:
            continue
        x = np.array([point["value"] for point in there], float)
        upper = slice(min(len(x) // 2, len(x) - 2), None)
        for name, of in QUANTITIES.items():
            y = np.array([of(point) for point in there], float)
            fits = {"all": exponent(x, y), "upper": exponent(x[upper], y[upper])}
            found.setdefault(axis, {})[name] = {key: round(k, 3) for key, k in fits.items()}
    return found


def exponent(x: np.ndarray, y: np.ndarray) -> float:
    """k of y ~ x^k, least squares in logarithms; x, y: [points]."""
    return float(np.polyfit(np.log(x), np.log(y), 1)[0])


def _measure(overrides: Sequence[str], options: Options) -> dict[str, Any]:
    arguments = [f"repeats={options.repeats}", f"seconds={options.seconds}", *overrides]
    try:
        return fresh.run("benchmarks.loop", arguments)
    except UserError as error:  # too large for this machine: the others still count
        return {"error": str(error)}


def _show(axis: str, point: Mapping[str, Any]) -> None:
    if "error" in point:
        say(f"{axis:<7} {point['value']:>9,} {point['error']}")
        return
    mb = {name: value / 1e6 for name, value in point["memory"].items()}
    say(f"{axis:<7} {point['value']:>9,} {1000 * point['cycle_seconds']:>11,.1f} "
          f"{point['env_steps_per_second']:>12,.0f} {point['product_flops_of_a_cycle'] / 1e9:>8.2f} "
          f"{mb['xla']:>9,.0f} {mb['replay']:>12,.0f} {mb['temporaries']:>11,.0f} {mb['process']:>8,.0f} "
          f"{point['compile_seconds']:>9.1f} s")  # fmt: skip


if __name__ == "__main__":
    sys.argv[0] = "growth"
    command.run(main, COMMAND)
