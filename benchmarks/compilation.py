"""`python -m benchmarks.compilation`: how long train's programs take to compile, as JSON.

The programs of `python -m matd3_jax.train` with these settings, in the order in which it needs them: start (networks,
environments and an empty replay, run once), warm-up, evaluation, interval. Of each: seconds to trace it, to lower it to
XLA's input, and to compile it or to read it from the compilation cache; "cpu" is the processor time of all three. The
replay has `learning_starts` rows, their number does not change the work; nothing is trained.
`benchmarks.compile_times` calls this once for each environment and state of the cache.
"""

import dataclasses
import json
import sys
import time

BEGUN = time.perf_counter()

from collections.abc import Sequence  # noqa: E402  (the imports below are measured, too)
from typing import Any  # noqa: E402

import jax  # noqa: E402

from matd3_jax import config  # noqa: E402
from matd3_jax.cli import command  # noqa: E402
from matd3_jax.cli.options import Command, others  # noqa: E402
from matd3_jax.runtime import devices  # noqa: E402
from matd3_jax.runtime.terminal import say  # noqa: E402
from matd3_jax.training.session import TrainingSession  # noqa: E402

EVENTS = {
    "/jax/core/compile/jaxpr_trace_duration": "trace",
    "/jax/core/compile/jaxpr_to_mlir_module_duration": "lower",
    "/jax/core/compile/backend_compile_duration": "compile",
}


@dataclasses.dataclass(frozen=True)
class Options:
    """Options of this benchmark."""

    overrides: tuple[str, ...] = others("a setting of the run, as matd3_jax.train takes it")


COMMAND = Command("python -m benchmarks.compilation", Options, __doc__, usage=("env=NAME [key=value ...]",))


def main(argv: Sequence[str]) -> int:
    overrides = COMMAND.parse(argv).overrides
    devices.prepare()
    settings = config.load(overrides, COMMAND.keys)
    settings = config.load([f"replay_capacity={settings.learning_starts}", *overrides])
    imported = time.perf_counter() - BEGUN
    programs = {}
    begun = time.perf_counter(), time.process_time()
    training = TrainingSession(settings)
    trainer = training.trainer
    found = dict.fromkeys(EVENTS.values(), 0.0)

    def listen(event: str, duration_secs: float, **_: Any) -> None:
        if event in EVENTS:
            found[EVENTS[event]] += duration_secs

    jax.monitoring.register_event_duration_secs_listener(listen)
    state = jax.block_until_ready(trainer.init(training.keys()))
    programs["start"] = {**found, **_passed(begun)}

    def evaluate(state, keys):
        return training.evaluator.evaluate(state, keys, settings.eval_episodes, True)

    for name, jitted, arguments in (
        ("warm-up", trainer.warm_up.jitted, (state, trainer.hyper)),
        ("evaluation", jax.jit(evaluate), (state, training.keys())),
        ("interval", training.interval.jitted, (state, trainer.hyper)),
    ):
        begun = time.perf_counter(), time.process_time()
        traced = jitted.trace(*arguments)
        first = time.perf_counter()
        lowered = traced.lower()
        second = time.perf_counter()
        lowered.compile()
        stages = {"trace": first - begun[0], "lower": second - first, "compile": time.perf_counter() - second}
        programs[name] = {**stages, **_passed(begun)}
    report = {
        "import": imported,
        "programs": programs,
        "total": time.perf_counter() - BEGUN,
        "machine": devices.description(),
    }
    say(json.dumps(report))
    return 0


def _passed(begun: tuple[float, float]) -> dict[str, float]:
    """Seconds since, by the clock and of processor time."""
    return {"seconds": time.perf_counter() - begun[0], "cpu": time.process_time() - begun[1]}


if __name__ == "__main__":
    sys.argv[0] = "compilation"
    command.run(main, COMMAND)
