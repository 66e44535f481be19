"""`python -m benchmarks.gpu`: what a machine with an accelerator should run first: checks, then measurements.

Parts, in this order; docs/performance_notes.md says what each takes:
    check       one update against the CPU's, single Ant steps against C MuJoCo, no copy of the replay in the loop
    wall_clock  20 seeds x 60,000 episodes of simple_spread, and their returns compared with the CPU's
    floor       the least time of an iteration: its products and bytes at the device's own rates
    launches    kernels of an iteration, and the share of the time in which none runs
    seeds       env steps/s over 1 to 1,024 seeds: whole loop, update, rollout
    precision   float32 products compared with the device's own (TF32), wall_clock too
    ant         whole loop of six seeds over environments, its launches, the physics alone, mjx and mjx_fast
    ant_wide    six seeds x 1M env steps of the Ant with recipe=wide, and what they learn
    unroll      longer bodies of the loops
    draws       random number generators, one draw an iteration
    options     command buffers, autotuning
Everything is kept in DIR/report.json after each case, and what is there is not measured again: a run that was cut off
resumes where it stopped, and parts can be run one by one. No case begins after `minutes`. A check that fails stops
nothing, but is said before the table, and the exit code is 1. `scale=0.01` tries the whole on a small machine.
"""

import dataclasses
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from benchmarks.gpu import ant, ant_wide, checks, figure, launches, roofline, seeds, targets, variants, wall_clock
from benchmarks.gpu.report import Report
from benchmarks.gpu.timing import Length
from matd3_jax.cli import command
from matd3_jax.cli.options import Command, option
from matd3_jax.runs.paths import check_directory
from matd3_jax.runtime import devices
from matd3_jax.runtime.terminal import say

PARTS: dict[str, Callable[[Report, float, Length], None]] = {
    "check": lambda report, scale, length: checks.run(report),
    "wall_clock": lambda report, scale, length: wall_clock.run(report, scale),
    "floor": lambda report, scale, length: roofline.run(report, scale),
    "launches": launches.run,
    "seeds": seeds.run,
    "precision": variants.precision,
    "ant": ant.run,
    "ant_wide": ant_wide.run,
    "unroll": variants.unroll,
    "draws": variants.draws,
    "options": variants.options,
}


@dataclasses.dataclass(frozen=True)
class Options:
    """Options of this benchmark."""

    out: Path = option("where the report goes, for instance out=gpu")
    parts: tuple[str, ...] = option("which to run", default=tuple(PARTS), choices=tuple(PARTS), metavar="[PART,...]")
    minutes: float = option("after which no case begins", default=60.0, unit="minutes", above=0)
    scale: float = option("of the work; 0.01 tries the whole on a small machine", default=1.0, above=0)


COMMAND = Command(
    "python -m benchmarks.gpu",
    Options,
    __doc__,
    examples=("python -m benchmarks.gpu out=gpu parts=check,wall_clock",),
)


def main(argv: Sequence[str]) -> int:
    options = COMMAND.parse(argv)
    scale = options.scale
    check_directory(options.out, "out")
    devices.prepare()
    report = Report(options.out, options.minutes)
    for key, value in report.facts.items():
        say(f"{key}: {value}")
    length = Length() if scale >= 1 else Length(iterations=2, seconds=max(0.02, scale), repeats=2)
    for part in PARTS:
        if part in options.parts:
            PARTS[part](report, scale, length)
    figure.draw(report)
    say("\n".join(targets.lines(report)))
    if report.left:
        say(f"no time was left for: {'; '.join(report.left)}")
    return 1 if report.wrong else 0


if __name__ == "__main__":
    sys.argv[0] = "gpu"
    command.run(main, COMMAND)
