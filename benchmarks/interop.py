"""`python -m benchmarks.interop`: env steps/s of other libraries' environments in our loop and in their own, in turns.

Ours is the compiled rollout of a run, its actions random, its transitions written to the replay, without updates:
`num_envs` environments of each of `seeds` seeds, which are spread over the devices. The library's own is the loop of
its documentation: random actions, reset where an episode ends, one environment in Python, or 32 in one program where
the library is in JAX. In each turn both are measured for `seconds` (compilation left out), the order reversed from turn
to turn; the ratio is that of the same turn. The cases are lines of `benchmarks/interop_cases.py`, each in a process of
its own. One that fails stands there with its error.
"""

import dataclasses
import multiprocessing
import sys
import time
from collections.abc import Sequence
from concurrent.futures import Executor, ProcessPoolExecutor
from functools import partial
from importlib import metadata
from typing import Any

import jax
import numpy as np

from benchmarks.commit import commit
from benchmarks.interop_cases import CASES, Block, Case
from benchmarks.options import Reported
from benchmarks.peers import spread
from matd3_jax import config
from matd3_jax.cli import command
from matd3_jax.cli.options import Command, option
from matd3_jax.runtime import devices
from matd3_jax.runtime.terminal import say
from matd3_jax.training.session import TrainingSession

STEPS = 200
"""Env steps of a block of a library's own loop, and rollouts' length in ours."""


@dataclasses.dataclass(frozen=True)
class Options(Reported):
    """Options of this benchmark."""

    turns: int = option("in each of which both loops are measured", default=3, least=1)
    seconds: float = option("for each measurement", default=2.0, unit="seconds", above=0)
    num_envs: int = option("environments of a seed in our loop", default=16, least=1)
    seeds: int | None = option("in our loop", default=None, least=1, otherwise="one for each device")
    only: str = option("cases whose name has this in it", default="", metavar="TEXT")


COMMAND = Command(
    "python -m benchmarks.interop", Options, __doc__, examples=("python -m benchmarks.interop only=mpe2",)
)


def main(argv: Sequence[str]) -> int:
    options = COMMAND.parse(argv)
    devices.prepare()
    seeds = options.seeds or len(jax.devices())
    report: dict[str, Any] = {
        "machine": devices.description(),
        "versions": devices.versions(),
        "commit": commit(),
        "settings": [word for word in argv if not word.startswith("out=")],
        "cases": [],
    }
    for key in ("machine", "versions", "commit"):
        say(f"{key}: {report[key]}")
    say(f"{'case':<26} {'ours':>22} {'their own loop':>22} {'ours / own':>18}")
    with process_for_each() as process:
        for case in CASES:
            if options.only.lower() in case.name.lower():
                chosen = (case, options.turns, options.seconds, options.num_envs, seeds)
                report["cases"].append(process.submit(measure, *chosen).result())
                say(line(report["cases"][-1]))
    options.write(report)
    return 0


def process_for_each() -> Executor:
    """One process after the other: XLA's threads, of which a case may need more, are fixed once one has computed."""
    spawn = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(1, spawn, devices.prepare, max_tasks_per_child=1)


def measure(case: Case, turns: int, seconds: float, num_envs: int, seeds: int) -> dict[str, Any]:
    """Env steps/s of both loops of a case, one for each turn, and their ratio; or the error that came instead."""
    entry: dict[str, Any] = {"name": case.name, "env": list(case.settings), "num_envs": num_envs, "seeds": seeds}
    try:
        entry["packages"] = {name: metadata.version(name) for name in case.packages}
        blocks = {"ours": ours(case, num_envs, seeds), "own": case.own(STEPS)}
        rates: dict[str, list[float]] = {"ours": [], "own": []}
        for block in blocks.values():
            for _ in range(2):  # compiles, and again for the types that a library's state has after its first step
                block()
        for turn in range(turns):
            for side in ("ours", "own") if turn % 2 == 0 else ("own", "ours"):
                rates[side].append(rate(blocks[side], seconds))
    except Exception as error:  # whatever a library's own code raises
        return {**entry, "error": f"{type(error).__name__}: {' '.join(str(error).split())}"}
    return {**entry, **rates, "ratio": spread(np.divide(rates["ours"], rates["own"]))}


def ours(case: Case, num_envs: int, seeds: int) -> Block:
    """Rollouts of random play in a run's own program."""
    steps = num_envs * STEPS
    schedule = [
        f"num_envs={num_envs}",
        f"rollout_length={STEPS}",
        f"replay_capacity={steps}",
        f"learning_starts={steps}",
    ]
    settings = [*case.settings, *schedule, f"total_steps={10 * steps}", f"seeds={seeds}", "batch_size=1", "n_step=1"]
    trainer = TrainingSession(config.load(settings)).trainer
    program = trainer.program(partial(trainer.rollout, random=True), 1)
    kept = [trainer.init(jax.vmap(jax.random.key)(np.arange(seeds)))]

    def block() -> int:
        state, _ = jax.block_until_ready(program(kept.pop()))
        kept.append(state)
        return seeds * steps

    return block


def rate(block: Block, seconds: float) -> float:
    """Env steps/s of blocks for some `seconds`."""
    done, begun = 0, time.perf_counter()
    while time.perf_counter() - begun < seconds:
        done += block()
    return done / (time.perf_counter() - begun)


def line(entry: dict[str, Any]) -> str:
    """A case in the table: medians over the turns."""
    if "error" in entry:
        return f"{entry['name']:<26} failed: {entry['error']}"
    medians = [float(np.median(entry[side])) for side in ("ours", "own")]
    ratio = entry["ratio"]
    between = f"({ratio['lowest']:.2f} to {ratio['highest']:.2f})"
    return f"{entry['name']:<26} {medians[0]:>22,.0f} {medians[1]:>22,.0f} {ratio['median']:>6.2f} {between}"


if __name__ == "__main__":
    sys.argv[0] = "interop"
    command.run(main, COMMAND)
