"""`python -m benchmarks.throughput`: env steps/s and updates/s of the whole loop, and of each of its parts alone.

To compare machines, the rate of a matrix product of the loop's kind on all devices at once is measured first and last.

Other keys are settings of the run, as `python -m matd3_jax.train` takes them. Every figure counts all seeds together
and is the median of `repeats` blocks of about a second, with the slowest and the fastest. Parts:
"environment" steps the environments with the same action again and again, "rollout" adds the policies and the write
into the replay, "replay" gathers the minibatches, "update" is all that learning does, gathering included. The env
steps/s of a part are those of a loop in which everything else is free. The roofline is the time that the matrix
products of a part alone take on these devices, measured just before and after (`benchmarks.limits`): "roofline" is
the share of a part's time that this would be.
"""

import dataclasses
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import limits
from benchmarks.commit import commit
from benchmarks.options import OfARun
from matd3_jax import config, envs
from matd3_jax.cli import command
from matd3_jax.cli.options import Command, option
from matd3_jax.core import replay
from matd3_jax.runtime import devices
from matd3_jax.runtime.terminal import say
from matd3_jax.training.loop import TrainLoop
from matd3_jax.training.session import TrainingSession
from matd3_jax.training.state import TrainState


@dataclasses.dataclass(frozen=True)
class Options(OfARun):
    """Options of this benchmark."""

    seeds: tuple[int, ...] = option("numbers of seeds", default=(1, 4, 20), least=1)
    repeats: int = option("measurements", default=5, least=1)
    seconds: float = option("length of a measurement", default=1.0, unit="seconds", above=0)


COMMAND = Command("python -m benchmarks.throughput", Options, __doc__)


def main(argv: Sequence[str]) -> int:
    options = COMMAND.parse(argv)
    devices.prepare()
    envs.make(**config.load(options.overrides, COMMAND.keys).env)  # before JAX computes: it may ask XLA for threads
    report: dict[str, Any] = {
        "machine": devices.description(),
        "versions": devices.versions(),
        "commit": commit(),
        "settings": argv,
    }
    report["gflops_before"] = matmul_gflops()
    for key in ("machine", "versions", "commit", "gflops_before"):
        say(f"{key}: {report[key]}")
    say(f"{'seeds':>5} {'part':<12} {'env steps/s':>12} {'slowest':>10} {'fastest':>10} {'updates/s':>10} "
          f"{'roofline':>9}")  # fmt: skip
    rows = []
    for seeds in options.seeds:
        for row in measure(options.overrides, seeds, options.repeats, options.seconds):
            rows.append(row)
            say(f"{row['seeds']:>5} {row['part']:<12} {row['env_steps_per_second']:>12,.0f} {row['slowest']:>10,.0f} "
                  f"{row['fastest']:>10,.0f} {row['updates_per_second']:>10,.1f} {row['of_floor']:>9.1%}"
                  f"   compiled in {row['compile_seconds']:.1f} s")  # fmt: skip
    report["rows"] = rows
    report["gflops_after"] = matmul_gflops()
    say(f"gflops_after: {report['gflops_after']}")
    options.write(report)
    return 0


def measure(
    overrides: Sequence[str], seeds: int, repeats: int, seconds: float, wanted: Sequence[str] | None = None
) -> list[dict[str, Any]]:
    """Rows of the table for one number of seeds; `wanted`: the parts to measure, default all."""
    # Replay no larger than a short run needs: its size does not change the work, only the memory.
    settings = config.load([f"seeds={seeds}", "total_steps=100000", "eval_every=0", *overrides])
    training = TrainingSession(settings)
    training.check_memory()
    trainer = training.trainer
    state, _ = training.start()
    rows = []
    for part, iteration in parts(trainer).items():
        if wanted is not None and part not in wanted:
            continue
        # Iterations in one call: first a guess, then as many as take the wanted time; where compiling is slow (robots),
        # the guess is called again and again instead.
        iterations, calls, compile_seconds = 2, 1, None
        for attempt in range(2):
            program = trainer.program(iteration, iterations)
            begun = time.perf_counter()
            state = jax.block_until_ready(program(state)[0])
            if attempt == 0:
                compile_seconds = time.perf_counter() - begun
            begun = time.perf_counter()
            state = jax.block_until_ready(program(state)[0])
            wanted_calls = seconds / (time.perf_counter() - begun)
            if attempt == 0 and compile_seconds > 10:
                calls = max(1, round(wanted_calls))
                break
            iterations = max(2, round(iterations * wanted_calls))
        least = [_roofline(trainer, part)]
        times = []
        for _ in range(repeats):
            begun = time.perf_counter()
            for _ in range(calls):
                state = program(state)[0]
            jax.block_until_ready(state)
            times.append((time.perf_counter() - begun) / calls)
        iterations = program.iterations
        least.append(_roofline(trainer, part))
        steps = seeds * iterations * trainer.iteration_steps
        updates = seeds * iterations * trainer.rollouts_per_iteration * trainer.schedule.updates_per_collect
        rows.append(
            {
                "seeds": seeds,
                "part": part,
                "env_steps_per_second": steps / float(np.median(times)),
                "slowest": steps / max(times),
                "fastest": steps / min(times),
                "updates_per_second": updates / float(np.median(times)) if part in ("update", "loop") else 0.0,
                "of_floor": float(np.mean(least)) * iterations / float(np.median(times)),
                "compile_seconds": compile_seconds,
            }
        )
    return rows


def _roofline(trainer: TrainLoop, part: str) -> float:
    """Least seconds of an iteration's part; 0 where there are no products in it."""
    return limits.roofline(trainer, 3, part)[0].seconds if part in ("rollout", "update", "loop") else 0.0


def parts(trainer: TrainLoop) -> dict[str, Callable[[TrainState, Any], Any]]:
    """What `TrainLoop.program` repeats for each part of the loop, by the part's name."""
    return {
        "environment": lambda s, h: _env_steps(trainer, s),
        "rollout": lambda s, h: _rollouts(trainer, s, h),
        "replay": lambda s, h: _gathers(trainer, s, h),
        "update": lambda s, h: _updates(trainer, s, h),
        "loop": trainer.iteration,
    }


def matmul_gflops(repeats: int = 7) -> float:
    """Giga floating point operations a second of [1024, 128] x [128, 128] products on all devices together, median."""
    count, mesh = 200, jax.sharding.Mesh(np.array(jax.devices()), ("devices",))
    layout = jax.sharding.PartitionSpec("devices")
    x = jnp.ones((jax.device_count(), 1024, 128)) / 128

    def products(x):
        w = jnp.ones((1, 128, 128)) / 128
        return jax.lax.fori_loop(0, count, lambda _, y: y @ w, x)

    program = jax.jit(jax.shard_map(products, mesh=mesh, in_specs=layout, out_specs=layout, check_vma=False))
    times = []
    for _ in range(repeats + 1):
        begun = time.perf_counter()
        jax.block_until_ready(program(x))
        times.append(time.perf_counter() - begun)
    return round(2 * jax.device_count() * count * 1024 * 128 * 128 / float(np.median(times[1:])) / 1e9, 1)


def _rollouts(trainer: TrainLoop, state: TrainState, hyper: Any) -> tuple[TrainState, Any]:
    episodes = None
    for _ in range(trainer.rollouts_per_iteration):
        state, episodes = trainer.rollout(state, hyper)
    return state, episodes


def _env_steps(trainer: TrainLoop, state: TrainState) -> tuple[TrainState, Any]:
    """The env steps of one iteration and nothing else; no episode ends."""
    chosen = [trainer.layout.policy(agent) for agent in range(trainer.layout.num_agents)]
    keys = jax.random.split(jax.random.key(0), (state.key.shape[0], trainer.schedule.num_envs))

    def one(env_state, key):
        action = tuple(policy.to_env(policy.random(key, ())) for policy in chosen)
        after = trainer.env.step(key, env_state, action)
        return after.state, after.reward.sum() + sum(part.sum() for part in after.observation)

    steps = trainer.rollouts_per_iteration * trainer.schedule.rollout_length
    inner, sums = jax.lax.scan(lambda s, _: jax.vmap(jax.vmap(one))(s, keys), state.env.state, length=steps)
    return state._replace(env=state.env._replace(state=inner)), sums.sum(axis=0)


def _gathers(trainer: TrainLoop, state: TrainState, hyper: Any) -> tuple[TrainState, Any]:
    """The minibatches of one iteration, read and summed."""
    schedule = trainer.schedule
    count = trainer.rollouts_per_iteration * schedule.updates_per_collect
    batches = 1 if schedule.shared_minibatch else trainer.layout.num_minibatches
    size = replay.filled(schedule.replay_capacity, schedule.rollout_steps, state.rollouts)
    keys = jax.vmap(lambda key: jax.random.split(key, count + 1))(state.key)

    def one(args):
        seed, keys, hyper = args

        def gather(key):
            indices = replay.sample_indices(key, size, (batches, schedule.batch_size))
            return trainer.learner.minibatches(state, hyper, seed, indices).sum()

        return jax.lax.map(gather, keys)

    sums = jax.lax.map(one, (jnp.arange(keys.shape[0]), keys[:, 1:], hyper))
    return state._replace(key=keys[:, 0]), sums.sum(axis=1)


def _updates(trainer: TrainLoop, state: TrainState, hyper: Any) -> tuple[TrainState, Any]:
    metrics = None
    for c in range(trainer.rollouts_per_iteration):
        state, metrics = trainer.learner.learn(state, hyper, first=c * trainer.schedule.updates_per_collect)
    return state, metrics


if __name__ == "__main__":
    sys.argv[0] = "throughput"
    command.run(main, COMMAND)
