"""What the device can do at most, measured, and the work of an update, counted: how long a cycle must take."""

import copy

import jax
import jax.numpy as jnp

from benchmarks import throughput
from benchmarks.gpu import seeds, stretch
from benchmarks.gpu.checks import PRECISIONS
from benchmarks.gpu.report import Report, Row
from matd3_jax import config
from matd3_jax.training import Training

BATCH, WIDTH, CRITICS = 1024, 64, 6
"""The products of simple_spread: rows, width of a layer, critics of a seed (three agents, two each)."""


def run(report: Report, scale: float, seconds: float) -> None:
    report.case("floor", "bandwidth", lambda: bandwidth(round(2**28 * min(1.0, scale)), seconds))
    for count in (20, 1024) if scale >= 1 else (2,):
        for name in ("default", "float32"):
            report.case("floor", f"products, {count} seeds, {name}", lambda c=count, n=name: products(c, n, seconds))
    report.case("floor", "update of simple_spread", update_work)


def bandwidth(numbers: int, seconds: float) -> Row:
    """Bytes read and written a second by x + 1 on an array far larger than caches."""
    repeats = 10
    program = jax.jit(lambda x: jax.lax.fori_loop(0, repeats, lambda _, y: y + 1, x), donate_argnums=0)
    rate = stretch.rate(program, jnp.zeros(numbers), seconds)
    return {"bytes_per_second": 8 * numbers * repeats * rate}


def products(count: int, precision: str, seconds: float) -> Row:
    """Floating point operations a second of products [1024, 64] x [64, 64], for each critic of each seed at once."""
    repeats, key = 50, jax.random.key(0)
    with jax.default_matmul_precision(PRECISIONS[precision]):
        weights = jax.random.normal(key, (count * CRITICS, WIDTH, WIDTH)) / WIDTH**0.5
        program = jax.jit(lambda x: jax.lax.fori_loop(0, repeats, lambda _, y: y @ weights, x))
        start = jax.random.normal(key, (count * CRITICS, BATCH, WIDTH))
        rate = stretch.rate(program, start, seconds)
    return {"flops_per_second": 2 * count * CRITICS * BATCH * WIDTH**2 * repeats * rate}


def update_work() -> Row:
    """Operations and bytes of the updates of one cycle of one seed, counted by XLA in the program as written, before it
    fuses anything: the bytes are an upper bound."""
    trainer = copy.copy(Training(config.load(seeds.settings(1, 100_000))).trainer)
    trainer.on_cpu, trainer.piece = False, trainer.rows  # loops over seeds and agents would be counted once only
    state = trainer.abstract_state()
    shape = (trainer.rows, trainer.schedule.replay_capacity, trainer.spec.row_size)
    state = state._replace(replay=jax.ShapeDtypeStruct(shape, jnp.float32))
    program = trainer.program(throughput.parts(trainer)["update"], 1)
    cost = program.jitted.lower(state, trainer.hyper).cost_analysis()
    return {"flops": cost["flops"], "bytes": cost.get("bytes accessed")}
