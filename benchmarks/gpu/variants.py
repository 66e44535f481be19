"""The same loop computed otherwise: precision of the products, longer loop bodies, XLA's options, random numbers."""

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from benchmarks.gpu import seeds, timing, wall_clock
from benchmarks.gpu.checks import PRECISIONS
from benchmarks.gpu.report import Report, Row
from benchmarks.gpu.timing import Length
from matd3_jax import config
from matd3_jax.training.session import TrainingSession

COMMANDS = "FUSION,CUBLAS,CUBLASLT,CUSTOM_CALL,CUDNN,DYNAMIC_SLICE_FUSION"
"""What XLA puts into command buffers (CUDA graphs) by default, where at least five of them follow each other."""
LOOPS = {"xla_gpu_enable_command_buffer": f"{COMMANDS},WHILE", "xla_gpu_graph_min_graph_size": 1}

OPTIONS: dict[str, dict[str, Any]] = {
    "as it is": {},
    "no command buffers": {"xla_gpu_enable_command_buffer": ""},
    "command buffers of one command, too": {"xla_gpu_graph_min_graph_size": 1},
    "no autotuning": {"xla_gpu_autotune_level": 0},
    # New in XLA and off by default, hence last: should one end the process, all else is measured.
    "loops in command buffers": LOOPS,
    "loops unrolled in command buffers": LOOPS | {"xla_gpu_command_buffer_unroll_loops": True},
}
"""What adds to the process's own flags; as a flag of a run: XLA_FLAGS=--NAME=VALUE."""

UNROLL: dict[str, dict[str, int]] = {
    "as it is": {},
    "2 iterations": {"unroll": 2},
    "5 steps": {"unroll_steps": 5},
    "25 steps": {"unroll_steps": 25},
}
GENERATORS = ("threefry2x32", "rbg", "unsafe_rbg")
"""Values of `jax_default_prng_impl`; the first is JAX's default. The others give a seed other numbers when other seeds
run for comparison, so they show what random numbers cost and are no option."""


def line(scale: float, count: int = 20) -> list[str]:
    return seeds.settings(count, 100_000) if scale >= 1 else seeds.settings(2, 10_000)


def precision(report: Report, scale: float, length: Length) -> None:
    for count in (20, 256) if scale >= 1 else (2,):
        for name in ("default", "float32"):
            context = partial(jax.default_matmul_precision, PRECISIONS[name])
            _case(report, "precision", f"{count} seeds, {name}", line(scale, count), length, context)
    wall_clock.case(report, scale, "float32")  # does it learn otherwise?


def unroll(report: Report, scale: float, length: Length) -> None:
    for name, how in UNROLL.items():
        _case(report, "unroll", name, line(scale), length, **how)


def options(report: Report, scale: float, length: Length) -> None:
    for name, values in OPTIONS.items():
        _case(report, "options", name, line(scale), length, options=values)


def draws(report: Report, scale: float, length: Length) -> None:
    for name in GENERATORS:
        context = partial(jax.default_prng_impl, name)
        _case(report, "draws", f"loop, {name}", line(scale), length, context)
        for large in (False, True):
            case = f"random numbers alone, {name}, {'one draw an iteration' if large else 'as in the loop'}"
            report.case("draws", case, lambda c=context, b=large: draw(line(scale), b, length.seconds, c))


def _case(
    report: Report,
    part: str,
    name: str,
    overrides: list[str],
    length: Length,
    context: Callable[[], AbstractContextManager] = nullcontext,
    **how: Any,
) -> None:
    def measure() -> Row:
        with context():
            return timing.measure(overrides, "loop", length, **how)

    report.case(part, name, measure)


def draw(overrides: list[str], large: bool, seconds: float, context: Callable[[], AbstractContextManager]) -> Row:
    """Seconds for as many Gumbel numbers as an iteration of all seeds takes: in a draw for each use of each update and
    collect, or in one for each seed."""
    with context():
        training = TrainingSession(config.load(overrides))
        sizes = drawn(training)
        repeats, sizes = 20, [sum(sizes)] if large else sizes

        def one(key):
            keys = jax.random.split(key, len(sizes) + 1)
            return keys[0], sum(jax.random.gumbel(k, (n,)).max() for k, n in zip(keys[1:], sizes, strict=True))

        def iterations(keys, sums):
            def iteration(carry, _):
                keys, new = jax.vmap(one)(carry[0])
                return (keys, carry[1] + new), None

            return jax.lax.scan(iteration, (keys, sums), length=repeats)[0]

        program = jax.jit(iterations)
        keys = training.keys()
        rate = timing.rate(lambda carry: program(*carry), (keys, jnp.zeros(len(keys))), seconds)
    return {"seeds": len(keys), "numbers_per_cycle": len(keys) * sum(sizes), "cycle_seconds": 1 / (rate * repeats)}


def drawn(training: TrainingSession) -> Sequence[int]:
    """How many numbers each draw of one seed's iteration holds: those of each update (minibatches, target actions for
    every agent, own actions) and of each rollout."""
    layout, schedule, trainer = training.layout, training.trainer.schedule, training.trainer
    batch, agents = schedule.batch_size, layout.num_agents
    update = [agents * batch, agents * batch * layout.action_size, batch * layout.action_size]
    return trainer.rollouts_per_iteration * [
        *schedule.updates_per_collect * update,
        schedule.rollout_steps * layout.action_size,
    ]
