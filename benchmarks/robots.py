"""`python -m benchmarks.robots`: env steps/s of a robot alone and of the whole loop, over numbers of environments.

Other keys are settings of the run. Environments are counted for each seed, rates over all seeds together; the seeds are
spread over the devices (one for each CPU core), so `seeds` should be a multiple of them. Every row has the paper's
networks and replays 100 transitions for each env step, in minibatches of 100 with one environment (recipe=paper) and of
about 1,000 with more. Parts as in `benchmarks.throughput`. `loops=false`: the environment alone.
"""

import dataclasses
import sys
from collections.abc import Sequence
from typing import Any

from benchmarks import throughput
from benchmarks.commit import commit
from benchmarks.options import OfARun
from matd3_jax import config, envs
from matd3_jax.cli import command
from matd3_jax.cli.options import Command, option
from matd3_jax.runtime import devices
from matd3_jax.runtime.terminal import say


@dataclasses.dataclass(frozen=True)
class Options(OfARun):
    """Options of this benchmark."""

    env: str = option("the robot", default="ant", metavar="NAME")
    num_envs: tuple[int, ...] = option("numbers of environments", default=(1, 16, 256, 4096), least=1)
    seeds: int = option("side by side", default=2, least=1)
    repeats: int = option("measurements", default=3, least=1)
    seconds: float = option("length of a measurement", default=2.0, unit="seconds", above=0)
    loops: bool = option("false: the environment alone", default=True)


COMMAND = Command("python -m benchmarks.robots", Options, __doc__)


def main(argv: Sequence[str]) -> int:
    options = COMMAND.parse(argv)
    devices.prepare()
    settings = config.load([f"env={options.env}", *options.overrides], COMMAND.keys)
    envs.make(**settings.env)  # before JAX computes, as in `throughput`
    report: dict[str, Any] = {
        "machine": devices.description(),
        "versions": devices.versions(),
        "commit": commit(),
        "settings": list(argv),
        "gflops": throughput.matmul_gflops(),
        "rows": [],
    }
    for key in ("machine", "versions", "commit", "gflops"):
        say(f"{key}: {report[key]}")
    say(f"{'environments':>12} {'part':<12} {'env steps/s':>12} {'slowest':>10} {'fastest':>10} "
          f"{'roofline':>8}")  # fmt: skip
    for n in options.num_envs:
        parts = None if options.loops else ("environment",)
        settings = [f"env={options.env}", *schedule(n), *options.overrides]
        rows = throughput.measure(settings, options.seeds, options.repeats, options.seconds, parts)
        for row in rows:
            report["rows"].append({"num_envs": n, **row})
            say(f"{n:>12} {row['part']:<12} {row['env_steps_per_second']:>12,.0f} {row['slowest']:>10,.0f} "
                  f"{row['fastest']:>10,.0f} {row['of_floor']:>8.1%}"
                  f"   compiled in {row['compile_seconds']:.0f} s")  # fmt: skip
    options.write(report)
    return 0


def schedule(num_envs: int) -> list[str]:
    """Settings that replay 100 transitions for each env step with `num_envs` environments."""
    if num_envs == 1:
        updates, batch = 1, 100
    else:
        updates = max(2, 2 * round(num_envs / 20))
        batch = round(100 * num_envs / updates)
    steps = 1000 * num_envs  # a short run's replay: its size changes the memory, not the work
    return [
        "recipe=paper",
        f"num_envs={num_envs}",
        f"updates_per_collect={updates}",
        f"batch_size={batch}",
        f"learning_starts={min(10_000, steps)}",
        f"replay_capacity={steps}",
        f"total_steps={steps}",
    ]


if __name__ == "__main__":
    sys.argv[0] = "robots"
    command.run(main, COMMAND)
