"""How long what a study still lacks is going to take: its programs, measured here in a short run of each one's loop.

A program is measured with all the seeds that it is going to have, in the middle of learning, with a small replay.
Where the time for measuring is over, a program has the rate of a measured one, preferably of the same environment,
times the ratio of the floating point operations of their matrix products (`training.cost`).
"""

import dataclasses
import functools
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

import jax

from matd3_jax.config import Config
from matd3_jax.runtime import devices
from matd3_jax.runtime.terminal import say
from matd3_jax.sweep import batching
from matd3_jax.sweep.runner import Sweep, fitting_seeds
from matd3_jax.training import checkpoint, cost
from matd3_jax.training.memory import needed
from matd3_jax.training.session import TrainingSession

SECONDS = 60.0
"""For measuring, compiling included; the first program is measured however long it takes."""
EACH = 2.0
"""Seconds that one program is measured for, after it has been compiled."""
STEPS = 2000
"""Env steps of each seed, about, in one call of a program that is measured."""


@dataclasses.dataclass(frozen=True)
class Batch:
    """Runs that are going to be trained side by side in one program.

    Attributes:
        done: env steps of each seed that there are already.
    """

    members: Sequence[Config]
    done: int = 0

    @property
    def seeds(self) -> int:
        return sum(member.seeds for member in self.members)

    @functools.cached_property
    def training(self) -> TrainingSession:
        return TrainingSession(self.members[0], members=self.members)

    @property
    def env(self) -> str:
        return str(self.members[0].env["name"])

    @property
    def flops(self) -> float:
        """Of the matrix products of one env step of one seed."""
        return cost.step_flops(self.training.layout, self.training.trainer.schedule)


@dataclasses.dataclass(frozen=True)
class Rate:
    """Env steps/s of a program's seeds together, and what it is a rate of."""

    env: str
    flops: float
    """Of the matrix products of one env step of one seed."""
    steps: float


@dataclasses.dataclass
class Estimator:
    """Measures rates until its time is over, and keeps them.

    Attributes:
        seconds: for all that it measures.
        rates: what it has measured, by program and number of seeds.
    """

    seconds: float = SECONDS
    rates: dict[tuple[str, int], Rate] = dataclasses.field(default_factory=dict)
    _spent: float = 0.0

    def rate(self, batch: Batch) -> tuple[float, bool]:
        """(env steps/s of all seeds of a batch, whether measured) here."""
        key = batching.program(batch.members[0]), batch.seeds
        if key not in self.rates and (not self.rates or self._spent < self.seconds):
            begun = time.perf_counter()
            self.rates[key] = measure(batch)
            self._spent += time.perf_counter() - begun
        if key in self.rates:
            return self.rates[key].steps, True
        alike = [rate for rate in self.rates.values() if rate.env == batch.env] or list(self.rates.values())
        nearest = min(alike, key=lambda rate: abs(rate.flops - batch.flops))
        return nearest.steps * nearest.flops / batch.flops, False


def measure(batch: Batch) -> Rate:
    """The rate of a batch's own program, of some `STEPS` env steps a call, while it learns."""
    training = Batch([_shortened(member) for member in batch.members]).training
    trainer = training.trainer
    state, _ = trainer.warm_up(trainer.init(training.keys()))
    iterations = max(1, STEPS // trainer.iteration_steps)
    program = trainer.interval(iterations)
    state, _ = jax.block_until_ready(program(state))  # compiles
    calls, begun = 0, time.perf_counter()
    while not calls or time.perf_counter() - begun < EACH:
        state, _ = jax.block_until_ready(program(state))
        calls += 1
    taken = time.perf_counter() - begun
    steps = calls * iterations * trainer.iteration_steps * batch.seeds / taken
    return Rate(batch.env, batch.flops, steps)


def planned(missing: Mapping[str, Config], folder: Path) -> list[Batch]:
    """The batches that training `missing` settings in `folder` would go through, as `sweep.runner` plans them.

    Raises UserError where a seed does not fit the memory.
    """
    budget = devices.free_memory()
    sweep = Sweep(folder)
    existing = batching.existing_runs(sweep.runs)
    names = {name for config in missing.values() for name in batching.missing(config, existing)[0]}
    begun = [
        Batch(sweep.members(k), max(checkpoint.steps(sweep.folder_of(k) / "checkpoints"), default=0))
        for k, batch in enumerate(sweep.batches)
        if names & set(batch) and not sweep.finished(k)
    ]
    new = batching.batches(missing, existing, sweep.runs, lambda config: fitting_seeds(config, budget))
    return begun + [Batch(batch) for batch in new]


def report(batches: Sequence[Batch], estimator: Estimator) -> tuple[int, float]:
    """Print what each batch takes, and the total: (env steps of all seeds, seconds)."""
    steps, seconds, most = 0, 0.0, 0
    order = sorted(batches, key=lambda batch: -_work(batch))
    # Measured first is what counts most of each environment; what counts least has to do without.
    largest: dict[str, Batch] = {}
    for batch in order:
        largest.setdefault(batch.env, batch)
    for batch in largest.values():
        estimator.rate(batch)
    for number, batch in enumerate(order, start=1):
        training = batch.training
        rate, measured = estimator.rate(batch)
        left = training.total_steps - batch.done
        memory = needed(training.trainer, batch.seeds)
        speed = f"{float(f'{rate:.2g}'):,.0f} env steps/s"
        how = "measured" if measured else "scaled from a measured program"
        names = [f"{member.name} ({member.seeds} seeds)" for member in batch.members]
        begun = f", {batch.done:,} env steps of each done" if batch.done else ""
        say(f"program {number}: {', '.join(names)}{begun}")
        say(
            f"    {batch.seeds} seeds x {left:,} env steps at {speed} of all seeds ({how}): "
            f"{cost.duration(batch.seeds * left / rate)}, {memory / 1e9:.2f} GB"
        )
        steps, seconds, most = steps + batch.seeds * left, seconds + batch.seeds * left / rate, max(most, memory)
    if batches:
        say(
            f"total: {steps:,} env steps in {len(batches)} program{'s' * (len(batches) > 1)}, {cost.duration(seconds)} "
            f"(compiling and evaluations apart); at most {most / 1e9:.2f} GB at a time, "
            f"{devices.free_memory() / 1e9:.2f} GB are free"
        )
    else:
        say("total: nothing is missing")
    return steps, seconds


def _work(batch: Batch) -> float:
    return batch.seeds * (batch.training.total_steps - batch.done) * batch.flops


def _shortened(config: Config) -> Config:
    """The settings with as few env steps before learning as there can be, and a small replay."""
    rollout = config.num_envs * config.rollout_length
    start = max(2, config.n_step + 1) * rollout
    capacity = min(config.replay_capacity, max(50_000 // rollout, config.n_step + 4) * rollout)
    return dataclasses.replace(config, learning_starts=start, replay_capacity=capacity)
