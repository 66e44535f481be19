"""`python -m benchmarks.compile_times`: how long train's programs take to compile for each environment, cold and warm.

Default: every environment that has settings. For each a fresh process with an empty compilation cache and another one
with the cache that the first has filled (`benchmarks.compilation`); medians of `repeats` such pairs. `at_once`: this
many environments side by side, each on its share of the cores alone. Other keys are settings of the run. It reports,
for each program, wall-clock seconds (of which tracing and lowering, done in Python) and processor time, which other
work on the machine changes less; cold programs of more than 30 s of a core are marked.
"""

import dataclasses
import os
import sys
import tempfile
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from queue import Queue
from typing import Any

import numpy as np

from benchmarks import fresh
from benchmarks.commit import commit
from benchmarks.options import OfARun
from matd3_jax import config
from matd3_jax.cli import command
from matd3_jax.cli.options import Command, option
from matd3_jax.errors import UserError
from matd3_jax.runtime import devices
from matd3_jax.runtime.terminal import say


@dataclasses.dataclass(frozen=True)
class Options(OfARun):
    """Options of this benchmark."""

    envs: tuple[str, ...] = option(
        "environments", default=config.known_names("env"), choices=config.known_names("env"), metavar="[NAME,NAME,...]"
    )
    repeats: int = option("pairs of processes, cold and warm, of each environment", default=1, least=1)
    at_once: int = option("environments side by side, each on its share of the cores", default=1, least=1)


COMMAND = Command("python -m benchmarks.compile_times", Options, __doc__)
PROGRAMS = ("start", "warm-up", "evaluation", "interval")
LIMIT = 30.0
"""Seconds of a core for one program, cold: more is a defect to look into."""


def main(argv: Sequence[str]) -> int:
    options = COMMAND.parse(argv)
    report: dict[str, Any] = {
        "versions": devices.versions(),
        "commit": commit(),
        "settings": list(argv),
        "environments": {},
    }
    say(f"commit {report['commit']}; wall-clock seconds (seconds of a core)")
    say(f"{'environment':<24} {'cache':<5} {'import':>7} " + " ".join(f"{name:>14}" for name in PROGRAMS)
          + f" {'all':>14}  of it traced and lowered")  # fmt: skip
    shares: Queue[set[int] | None] = Queue()
    for share in cores(options.at_once):
        shares.put(share)

    def one(env: str) -> tuple[str, dict[str, Any]]:
        share = shares.get()
        try:
            if share is not None:
                os.sched_setaffinity(0, share)  # of this thread, and of the processes that it starts
            return env, measure([f"env={env}", *options.overrides], options.repeats)
        finally:
            shares.put(share)

    with ThreadPoolExecutor(options.at_once) as pool:
        for env, found in pool.map(one, options.envs):
            report.setdefault("machine", found.pop("machine"))
            found.pop("machine", None)
            report["environments"][env] = found
            for state in ("cold", "warm"):
                say(row(env, state, found[state]))
            options.write(report)
    for line in slow(report["environments"]):
        say(line)
    return 0


def measure(overrides: Sequence[str], repeats: int) -> dict[str, Any]:
    """{"cold", "warm": medians of what `benchmarks.compilation` reports, "machine"}."""
    found: dict[str, list[dict[str, Any]]] = {"cold": [], "warm": []}
    for _ in range(repeats):
        with tempfile.TemporaryDirectory() as folder:
            for reports in found.values():
                reports.append(fresh.run("benchmarks.compilation", overrides, {"JAX_COMPILATION_CACHE_DIR": folder}))
    machine = [report.pop("machine") for reports in found.values() for report in reports][0]
    return {**{state: median(reports) for state, reports in found.items()}, "machine": machine}


def median(reports: Sequence[Any]) -> Any:
    """Medians, number by number, of reports of the same form (numbers in nested mappings), to hundredths."""
    if isinstance(reports[0], Mapping):
        return {key: median([report[key] for report in reports]) for key in reports[0]}
    return round(float(np.median(reports)), 2)


def row(env: str, state: str, found: Mapping[str, Any]) -> str:
    """A line of the table."""
    programs = [found["programs"][name] for name in PROGRAMS]
    cells = [f"{p['seconds']:.1f} ({p['cpu']:.1f})" for p in programs]
    cells.append(f"{found['total']:.1f} ({sum(p['cpu'] for p in programs):.1f})")
    python = sum(p["trace"] + p["lower"] for p in programs)
    return f"{env:<24} {state:<5} {found['import']:>7.1f} " + " ".join(f"{c:>14}" for c in cells) + f" {python:>8.1f}"


def slow(environments: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """One line for each program that takes more than `LIMIT` of a core, cold."""
    return [
        f"{env}: {name} took {program['cpu']:.0f} s of a core cold, more than {LIMIT:.0f}"
        for env, found in environments.items()
        for name, program in found["cold"]["programs"].items()
        if program["cpu"] > LIMIT
    ]


def cores(at_once: int) -> list[set[int] | None]:
    """The cores that each of several processes has to itself; None: all, or where one cannot choose."""
    if at_once == 1 or not hasattr(os, "sched_getaffinity"):
        return [None] * at_once
    there = sorted(os.sched_getaffinity(0))
    if at_once > len(there):
        raise UserError(f"at_once={at_once}: there are {len(there)} cores")
    return [set(there[k::at_once]) for k in range(at_once)]


if __name__ == "__main__":
    sys.argv[0] = "compile_times"
    command.run(main, COMMAND)
