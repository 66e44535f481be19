"""`python -m benchmarks.gpu out=DIR`: what a machine with an accelerator should run first: checks, then measurements.

    python -m benchmarks.gpu out=DIR [parts=[check,...]] [minutes=60] [scale=1.0]

Parts, in this order; docs/performance.md says what each takes:
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

import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from benchmarks.gpu import ant, ant_wide, checks, figure, launches, roofline, seeds, targets, variants, wall_clock
from benchmarks.gpu.report import Report
from benchmarks.gpu.timing import Length
from matd3_jax import config
from matd3_jax.cli import command
from matd3_jax.errors import UserError
from matd3_jax.runtime import devices

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
DEFAULTS = {"out": None, "parts": list(PARTS), "minutes": 60, "scale": 1.0}


def main(argv: Sequence[str]) -> int:
    if {"-h", "--help"} & set(argv):
        print(str(__doc__).strip())
        return 0
    out, parts, minutes, scale = options(argv)
    devices.prepare()
    report = Report(out, minutes)
    for key, value in report.facts.items():
        print(f"{key}: {value}", flush=True)
    length = Length() if scale >= 1 else Length(iterations=2, seconds=max(0.02, scale), repeats=2)
    for part in PARTS:
        if part in parts:
            PARTS[part](report, scale, length)
    figure.draw(report)
    print("\n".join(targets.lines(report)))
    if report.left:
        print(f"no time was left for: {'; '.join(report.left)}")
    return 1 if report.wrong else 0


def options(argv: Sequence[str]) -> tuple[Path, list[str], float, float]:
    """out, parts, minutes, scale. Raises UserError."""
    taken, rest = config.take(argv, tuple(DEFAULTS))
    chosen = {**DEFAULTS, **taken}
    if rest:
        raise UserError(f"there is no key {rest[0].split('=')[0]!r}; the keys are {', '.join(DEFAULTS)}")
    if chosen["out"] is None:
        raise UserError("out= is missing: where the report goes, for instance out=gpu")
    parts = chosen["parts"] if isinstance(chosen["parts"], list) else [chosen["parts"]]
    unknown = [part for part in parts if part not in PARTS]
    if unknown:
        raise UserError(f"parts={unknown[0]}: must be some of {', '.join(PARTS)}")
    for key in ("minutes", "scale"):
        if type(chosen[key]) not in (int, float) or not chosen[key] > 0:
            raise UserError(f"{key}={chosen[key]}: must be a number above 0")
    return Path(str(chosen["out"])), parts, float(chosen["minutes"]), float(chosen["scale"])


if __name__ == "__main__":
    sys.argv[0] = "gpu"
    command.run(main)
