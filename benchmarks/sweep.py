"""`python -m benchmarks.sweep`: what a sweep costs compared with as many seeds of one setting.

Takes settings as `python -m matd3_jax.sweep` does (default: the 18 of its documentation) and times, in turns, a block
of `steps` env steps of every seed of each program that the sweep consists of, and of one program with as many seeds of
the setting without the swept values. The cost is the time of all the sweep's programs over that of the one; compilation
is distinguished. Where a swept value changes what is computed (policy_delay=1 updates actors twice as often as the
default), that is in the cost.
"""

import dataclasses
import sys
import time
from collections.abc import Sequence

import jax
import numpy as np

from benchmarks.commit import commit
from benchmarks.options import OfARun
from matd3_jax import config
from matd3_jax.cli import command, sweep
from matd3_jax.cli.options import Command, option
from matd3_jax.config import Config
from matd3_jax.runtime import devices
from matd3_jax.runtime.terminal import say
from matd3_jax.sweep import batching
from matd3_jax.sweep.search_space import SearchSpace
from matd3_jax.training.session import TrainingSession


@dataclasses.dataclass(frozen=True)
class Options(OfARun):
    """Options of this benchmark."""

    seeds: int = option("of each setting", default=4, least=1)
    repeats: int = option("measurements", default=5, least=1)
    steps: int = option("length of a measurement", default=1200, unit="env steps", least=1)


COMMAND = Command("python -m benchmarks.sweep", Options, __doc__)

SWEPT = ("algo.lr=0.01,0.003,0.001", "algo.tau=0.01,0.005", "algo.policy_delay=1,2,3")
SHORT = ("learning_starts=2000", "replay_capacity=10000", "total_steps=10000")
"""A small replay, so that the sweep fits into one batch for each program; rows are drawn at random all the same."""


def main(argv: Sequence[str]) -> int:
    options = COMMAND.parse(argv)
    devices.prepare()
    overrides = [*SHORT, *options.overrides, f"seeds={options.seeds}"]
    if not SearchSpace.parse(overrides).axes:
        overrides += SWEPT
    _, settings = sweep.read(overrides, None, 0, COMMAND.keys)
    groups: dict[str, list[Config]] = {}
    for setting in settings.values():
        groups.setdefault(batching.program(setting), []).append(setting)
    base = config.load(SearchSpace.parse(overrides).fixed)
    alone = [config.load([*SearchSpace.parse(overrides).fixed, f"seeds={len(settings) * base.seeds}"])]
    programs = [_Program(members, options.steps) for members in [alone, *groups.values()]]
    seconds = np.array([[program.block() for program in programs] for _ in range(options.repeats)])
    cost = seconds[:, 1:].sum(axis=1) / seconds[:, 0]
    rates = len(settings) * base.seeds * programs[0].steps / seconds[:, 0]
    compiled = [program.compile_seconds for program in programs]
    report = {
        "machine": devices.description(),
        "versions": devices.versions(),
        "commit": commit(),
        "settings": list(argv),
        "sweep": f"{len(settings)} settings x {base.seeds} seeds in {len(groups)} programs",
        "cost": {"median": float(np.median(cost)), "lowest": float(cost.min()), "highest": float(cost.max())},
        "env_steps_per_second_of_one_setting": float(np.median(rates)),
        "compile_seconds": {"one setting": compiled[0], "programs of the sweep": compiled[1:]},
    }
    say(f"{report['sweep']} against {len(settings) * base.seeds} seeds of one setting: cost "
          f"{np.median(cost):.3f} ({cost.min():.3f} to {cost.max():.3f}); {np.median(rates):,.0f} env steps/s; "
          f"compiled in {compiled[0]:.0f} s against {' + '.join(f'{s:.0f}' for s in compiled[1:])} s")  # fmt: skip
    options.write(report)
    return 0


class _Program:
    """The interval of runs that share a program, compiled and warm."""

    def __init__(self, members: list[Config], steps: int):
        training = TrainingSession(members[0], members=members)
        trainer = training.trainer
        self.state, _ = trainer.warm_up(trainer.init(training.keys()))
        iterations = max(1, round(steps / trainer.iteration_steps))
        self.steps = iterations * trainer.iteration_steps
        self.scale = steps / self.steps
        begun = time.monotonic()
        self.interval = trainer.interval(iterations)
        self.state, _ = jax.block_until_ready(self.interval(self.state))
        self.compile_seconds = round(time.monotonic() - begun, 1)

    def block(self) -> float:
        """Seconds for `steps` env steps of every seed."""
        begun = time.monotonic()
        self.state, _ = jax.block_until_ready(self.interval(self.state))
        return (time.monotonic() - begun) * self.scale


if __name__ == "__main__":
    sys.argv[0] = "sweep"
    command.run(main, COMMAND)
