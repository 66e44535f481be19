"""Time for a number of iterations of the loop or of a part of it, one compilation a case."""

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import throughput
from benchmarks.gpu.report import Row
from matd3_jax import config
from matd3_jax.training.loop import TrainLoop
from matd3_jax.training.session import TrainingSession
from matd3_jax.training.state import TrainState


class Length(NamedTuple):
    """How long to measure."""

    iterations: int = 10
    """Of one call of the program."""
    seconds: float = 1.0
    """Of one timed block of calls."""
    repeats: int = 3


class Setting(NamedTuple):
    """A trainer with a state to measure on."""

    trainer: TrainLoop
    state: TrainState
    """Taken over by what is measured."""


def setting(overrides: list[str], unroll: int = 1, unroll_steps: int = 1) -> Setting:
    """What `matd3_jax.train` would run, its replay full as for most of a long run: of random numbers, as playing that
    many rows would take too long."""
    training = TrainingSession(config.load([*overrides, "eval_every=0"]))
    training.check_memory()
    trainer = training.trainer
    trainer.unroll, trainer.unroll_steps = unroll, unroll_steps
    return Setting(trainer, fill(trainer, trainer.init(training.keys())))


def fill(trainer: TrainLoop, state: TrainState) -> TrainState:
    """The state with every row of the replay uniform on [0, 1), written block by block: no second replay is needed."""
    schedule = trainer.schedule
    block = schedule.rollout_steps

    def write(i, rows):
        new = jax.random.uniform(jax.random.fold_in(jax.random.key(0), i), (rows.shape[0], block, rows.shape[2]))
        return jax.lax.dynamic_update_slice(rows, new, (0, i * block, 0))

    count = schedule.replay_capacity // block
    program = jax.jit(
        lambda rows: jax.lax.fori_loop(0, count, write, rows),
        donate_argnums=0,
        in_shardings=trainer.shardings.replay,
        out_shardings=trainer.shardings.replay,
    )
    rollouts = jax.device_put(jnp.int32(count), trainer.shardings.rollouts)
    return state._replace(replay=program(state.replay), rollouts=rollouts)


class Compiled(NamedTuple):
    """A program of some iterations."""

    run: Any
    """As JAX compiles it ahead of time."""
    part: str
    trainer: TrainLoop
    iterations: int
    compile_seconds: float

    def __call__(self, state: TrainState) -> TrainState:
        return self.run(state, self.trainer.hyper)[0]


def compiled(at: Setting, part: str, iterations: int, options: dict[str, Any] | None = None) -> Compiled:
    """The program that repeats a part of `throughput.parts`, compiled with XLA's `options` in addition to the flags of
    the process."""
    trainer = at.trainer
    program = trainer.program(throughput.parts(trainer)[part], iterations)
    begun = time.perf_counter()
    run = program.jitted.lower(at.state, trainer.hyper).compile(compiler_options=options)
    return Compiled(run, part, trainer, iterations, time.perf_counter() - begun)


def timed(program: Compiled, state: TrainState, length: Length) -> tuple[TrainState, Row]:
    """The state after the calls, and rates over all seeds: median, slowest and fastest of the blocks."""
    trainer, calls = program.trainer, 1

    def block(state: TrainState) -> tuple[TrainState, float]:
        begun = time.perf_counter()
        for _ in range(calls):
            state = program(state)
        jax.block_until_ready(state)
        return state, (time.perf_counter() - begun) / (calls * program.iterations)

    state, _ = block(state)  # the first call loads kernels
    state, iteration = block(state)
    calls = max(1, round(length.seconds / (iteration * program.iterations)))
    times = []
    for _ in range(length.repeats):
        state, iteration = block(state)
        times.append(iteration)
    steps = trainer.num_seeds * trainer.iteration_steps
    updates = trainer.num_seeds * trainer.rollouts_per_iteration * trainer.schedule.updates_per_collect
    memory = program.run.memory_analysis()
    row = {
        "seeds": trainer.num_seeds,
        "env_steps_per_second": steps / float(np.median(times)),
        "slowest": steps / max(times),
        "fastest": steps / min(times),
        "updates_per_second": updates / float(np.median(times)) if program.part in ("update", "loop") else 0.0,
        "cycle_seconds": float(np.median(times)),
        "compile_seconds": program.compile_seconds,
        "temporary_bytes": getattr(memory, "temp_size_in_bytes", None),
        "state_bytes": getattr(memory, "argument_size_in_bytes", None),
    }
    return state, row


def measure(
    overrides: list[str], part: str, length: Length, options: dict[str, Any] | None = None, **unroll: int
) -> Row:
    """One row: a part of the loop at some settings."""
    at = setting(overrides, **unroll)
    program = compiled(at, part, length.iterations, options)
    return timed(program, at.state, length)[1]


def rate(run: Callable[[Any], Any], start: Any, seconds: float) -> float:
    """Calls a second of `run`, each given what the one before gave, at least three; the first call is not counted."""
    state = jax.block_until_ready(run(start))
    begun, calls = time.perf_counter(), 0
    while calls < 3 or time.perf_counter() - begun < seconds:
        state = jax.block_until_ready(run(state))
        calls += 1
    return calls / (time.perf_counter() - begun)
