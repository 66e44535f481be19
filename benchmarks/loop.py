"""`python -m benchmarks.loop`: the whole loop of one setting, as JSON.

Time of an iteration, counted products, and memory: what XLA says that the compiled interval takes, and what the process
took at most. `learning_starts` transitions are played first, so that with learning_starts=replay_capacity the replay is
full. Other keys are settings of the run. `benchmarks.growth` calls this once for each point.
"""

import dataclasses
import json
import math
import re
import resource
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from matd3_jax import config
from matd3_jax.cli import command
from matd3_jax.cli.options import Command, option, others
from matd3_jax.config import Config
from matd3_jax.runtime import devices
from matd3_jax.runtime.terminal import say
from matd3_jax.thread_pool import programs_in
from matd3_jax.training.loop import TrainLoop
from matd3_jax.training.session import TrainingSession

ITERATIONS = 2
"""Of one call of the compiled interval: how many does not change the program but for a number."""


@dataclasses.dataclass(frozen=True)
class Options:
    """Options of this benchmark."""

    repeats: int = option("measurements", default=5, least=1)
    seconds: float = option("length of a measurement", default=1.0, unit="seconds", above=0)
    overrides: tuple[str, ...] = others("any other setting of the run, as matd3_jax.train takes it")


COMMAND = Command("python -m benchmarks.loop", Options, __doc__)


def main(argv: Sequence[str]) -> int:
    options = COMMAND.parse(argv)
    devices.prepare()
    loop = Loop(config.load(options.overrides, COMMAND.keys))
    calls = loop.calls(options.seconds)
    times = [loop.iteration_seconds(calls) for _ in range(options.repeats)]
    trainer = loop.trainer
    steps = trainer.num_seeds * trainer.iteration_steps
    report = {
        "cycle_seconds": float(np.median(times)),
        "fastest": min(times),
        "slowest": max(times),
        "env_steps_per_second": steps / float(np.median(times)),
        "env_steps_of_a_cycle": steps,
        "updates_of_a_cycle": trainer.rollouts_per_iteration * trainer.schedule.updates_per_collect,
        "product_flops_of_a_cycle": loop.iteration_flops,
        "compile_seconds": round(loop.compile_seconds, 1),
        "devices": trainer.mesh.size,
        "row_numbers": trainer.layout.row_size,
        "memory": {**loop.memory(), **process_memory()},
        "machine": devices.description(),
    }
    say(json.dumps(report))
    return 0


class Loop:
    """The interval of a run, compiled, with a state to call it with."""

    def __init__(self, settings: Config):
        training = TrainingSession(settings)
        training.check_memory()
        self.trainer = training.trainer
        self.state, _ = jax.block_until_ready(self.trainer.warm_up(self.trainer.init(training.keys())))
        begun = time.perf_counter()
        interval = self.trainer.interval(ITERATIONS)
        traced = interval.jitted.trace(self.state, interval.hyper)
        self.compiled = traced.lower().compile()
        self.compile_seconds = time.perf_counter() - begun
        self.iteration_flops = product_flops(traced.jaxpr.jaxpr) / ITERATIONS
        """Floating point operations of the matrix products of an iteration of all seeds."""

    def iteration_seconds(self, calls: int) -> float:
        """Seconds of an iteration of all seeds, mean over `calls` of the interval."""
        begun = time.perf_counter()
        for _ in range(calls):
            self.state, _ = self.compiled(self.state, self.trainer.hyper)
        jax.block_until_ready(self.state)
        return (time.perf_counter() - begun) / (calls * ITERATIONS)

    def calls(self, seconds: float) -> int:
        """How many calls of the interval take about `seconds`, at least one; tried, so the interval is warm after
        it."""
        self.iteration_seconds(1)
        return max(1, round(seconds / (ITERATIONS * self.iteration_seconds(1))))

    def memory(self) -> dict[str, int]:
        """Bytes, over all devices: XLA's count for the compiled interval (`arguments` hold the replay; what it gives
        out is written over them) and the replay as computed."""
        found, count = self.compiled.memory_analysis(), self.trainer.mesh.size
        arguments, temporaries = count * found.argument_size_in_bytes, count * found.temp_size_in_bytes
        outputs = count * (found.output_size_in_bytes - found.alias_size_in_bytes)
        return {
            "arguments": arguments,
            "temporaries": temporaries,
            "xla": arguments + temporaries + outputs,
            "replay": self.trainer.replay_bytes,
        }


def copies_in(text: str, trainer: TrainLoop) -> int:
    """Copies of a device's whole replay in a compiled program (HLO text, as `Compiled.as_text` gives it)."""
    schedule, layout = trainer.schedule, trainer.layout
    local = f"{trainer.sharding.local_seeds},{schedule.replay_capacity},{layout.row_size}"
    return len(re.findall(rf"f32\[{local}\]\S* copy(-start)?\(", text))


def process_memory() -> dict[str, int]:
    """Bytes that this process took at most: `process`, compiler included, and on accelerators `device`."""
    try:
        # Not getrusage first: there a process starts with the peak of the one that started it.
        lines = Path("/proc/self/status").read_text().splitlines()
        found = {"process": 1024 * int(next(line.split()[1] for line in lines if line.startswith("VmHWM")))}
    except (OSError, StopIteration):
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        found = {"process": peak if sys.platform == "darwin" else 1024 * peak}
    stats = [device.memory_stats() or {} for device in jax.local_devices()]
    peaks = [s["peak_bytes_in_use"] for s in stats if "peak_bytes_in_use" in s]
    return {**found, "device": sum(peaks)} if peaks else found


def product_flops(jaxpr: Any) -> float:
    """Floating point operations of the matrix products in a traced program, two for each multiplication.

    Loops count as often as they run; XLA's own count (`cost_analysis`) takes the body of a loop once. Of a condition
    every branch counts. Raises ValueError for products in a loop of unknown length.
    """
    total = 0.0
    for equation in jaxpr.eqns:
        if equation.primitive.name == "dot_general":
            (contracted, _), _ = equation.params["dimension_numbers"]
            shape = equation.invars[0].aval.shape
            total += 2 * math.prod(shape[i] for i in contracted) * math.prod(equation.outvars[0].aval.shape)
            continue
        inner = sum(product_flops(part) for value in equation.params.values() for part in programs_in(value))
        if equation.primitive.name == "scan":
            inner *= equation.params["length"]
        elif equation.primitive.name == "shard_map":  # what each device does
            inner *= equation.params["mesh"].size
        elif equation.primitive.name == "while" and inner:
            raise ValueError("products in a loop of unknown length")
        total += inner
    return total


if __name__ == "__main__":
    sys.argv[0] = "loop"
    command.run(main, COMMAND)
