"""`python -m benchmarks.recording`: what the files of a run cost: rows, the watch for divergence, checkpoints.

Two measurements, of settings as `python -m matd3_jax.train` takes them:
    the time of some logging intervals with everything that a run directory gets after each, over the time without, in
    turns (checkpoints apart);
    the seconds and bytes of a checkpoint with full replays, and the seconds to read it back. A run writes one every
    `checkpoint_minutes`, and waits longer where they would take over a twentieth of its time.
The files go to a temporary directory in `folder`, and are deleted.
"""

import dataclasses
import functools
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.commit import commit
from benchmarks.options import OfARun
from matd3_jax import config
from matd3_jax.cli import command
from matd3_jax.cli.options import Command, option
from matd3_jax.runs import lock
from matd3_jax.runs.directory import RunDirectory
from matd3_jax.runtime import devices
from matd3_jax.runtime.terminal import say
from matd3_jax.training import checkpoint
from matd3_jax.training.loggers import DivergenceLogger, TableLogger
from matd3_jax.training.run import SHARE
from matd3_jax.training.session import TrainingSession
from matd3_jax.training.state import TrainState


@dataclasses.dataclass(frozen=True)
class Options(OfARun):
    """Options of this benchmark."""

    repeats: int = option("of each measurement", default=5, least=1)
    intervals: int = option("logging intervals in a turn", default=10, least=1)
    folder: Path = option("where the files go", default=Path(tempfile.gettempdir()))


COMMAND = Command("python -m benchmarks.recording", Options, __doc__)


def main(argv: Sequence[str]) -> int:
    options = COMMAND.parse(argv)
    devices.prepare()
    settings = config.load(options.overrides, COMMAND.keys)
    training = TrainingSession(settings)
    training.check_memory()
    with tempfile.TemporaryDirectory(dir=options.folder, prefix="recording-") as folder:
        path = Path(folder)
        state, row = training.start()
        state, rows = _rows(training, state, row, path, options)
        checkpoints = _checkpoints(training, state, path, options.repeats)
    minutes = max(settings.checkpoint_minutes, SHARE * checkpoints["seconds"] / 60)
    report = {
        "machine": devices.description(),
        "versions": devices.versions(),
        "commit": commit(),
        "settings": [*options.overrides],
        "rows": rows,
        "checkpoint": {
            **checkpoints,
            "share_of_time": checkpoints["seconds"] / (60 * minutes + checkpoints["seconds"]),
        },
    }
    say(f"rows and watch: {rows['median']:.4f} times the time without ({rows['lowest']:.4f} to {rows['highest']:.4f})")
    say(f"a checkpoint: {checkpoints['bytes'] / 1e9:.2f} GB in {checkpoints['seconds']:.1f} s, read in "
        f"{checkpoints['restore_seconds']:.1f} s; one every {minutes:.0f} minutes takes "
        f"{100 * report['checkpoint']['share_of_time']:.1f} % of the time")  # fmt: skip
    options.write(report)
    return 0


def _rows(
    training: TrainingSession, state: TrainState, row: Any, path: Path, options: Options
) -> tuple[TrainState, dict[str, float]]:
    """(state, times with recording over those without)."""
    run = RunDirectory.create(path / "run", training.config, {})
    loggers = [TableLogger([run]), DivergenceLogger(training, say)]
    for logger in loggers:
        logger.log(row)

    def turn(state: TrainState, recorded: bool) -> tuple[TrainState, float]:
        begun = time.monotonic()
        for _ in range(options.intervals):
            state, row = training.advance(state)
            for logger in loggers if recorded else ():
                logger.log(row)
        jax.block_until_ready(state)
        return state, time.monotonic() - begun

    ratios = []
    with lock.held(run.path):
        state, _ = turn(state, True)  # compiled
        for _ in range(options.repeats):
            state, without = turn(state, False)
            state, within = turn(state, True)
            ratios.append(within / without)
    return state, {"median": float(np.median(ratios)), "lowest": min(ratios), "highest": max(ratios)}


def _checkpoints(training: TrainingSession, state: TrainState, path: Path, repeats: int) -> dict[str, float]:
    """Seconds (median) and bytes of a checkpoint whose replays are full, of random numbers as real rows compress no
    better."""
    trainer = training.trainer
    shape, sharding = state.replay.shape, state.replay.sharding
    state.replay.delete()  # a second one beside it need not fit
    shards = []
    for device, seeds in trainer.sharding.device_seeds():
        rows = jax.device_put(jnp.zeros((len(seeds), *shape[1:]), jnp.float32, device=device), device)
        for place, seed in enumerate(seeds):
            rows = _fill(rows, jax.device_put(jax.random.key(seed), device), place)
        shards.append(rows)
    rollouts = trainer.schedule.replay_capacity // trainer.schedule.rollout_steps
    state = state._replace(
        replay=jax.make_array_from_single_device_arrays(shape, sharding, shards),
        rollouts=jax.device_put(jnp.int32(max(rollouts, int(state.rollouts))), state.rollouts.sharding),
    )
    del rows, shards
    seconds = []
    for number in range(repeats):
        begun = time.monotonic()
        saved = checkpoint.save(path / "checkpoints", number, trainer, state, keep=1)
        seconds.append(time.monotonic() - begun)
    size = sum(file.stat().st_size for file in saved.rglob("*") if file.is_file())
    state.replay.delete()
    begun = time.monotonic()
    jax.block_until_ready(checkpoint.restore(checkpoint.verify(path / "checkpoints"), trainer))
    return {
        "seconds": float(np.median(seconds)),
        "seconds_lowest": min(seconds),
        "seconds_highest": max(seconds),
        "bytes": size,
        "rows_of_a_seed": trainer.schedule.filled_rows(rollouts),
        "restore_seconds": time.monotonic() - begun,
    }


@functools.partial(jax.jit, donate_argnums=0, static_argnums=2)
def _fill(rows: jax.Array, key: jax.Array, place: int) -> jax.Array:
    """Random numbers for the seed at a place of rows [seeds, capacity, row size]."""
    return rows.at[place].set(jax.random.uniform(key, rows.shape[1:]))


if __name__ == "__main__":
    sys.argv[0] = "recording"
    command.run(main, COMMAND)
