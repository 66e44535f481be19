"""Env steps/s over numbers of seeds, at the paper's schedule."""

from benchmarks.gpu import timing
from benchmarks.gpu.report import Report, Row
from benchmarks.gpu.timing import Length
from matd3_jax import config
from matd3_jax.runtime import devices
from matd3_jax.training import memory
from matd3_jax.training.loop import TrainLoop
from matd3_jax.training.session import TrainingSession

REPLAY = 1_000_000
"""The paper's."""
SHARE = 0.85
"""Of the free memory that the plan may fill: what updates take besides the state is estimated."""


def run(report: Report, scale: float, length: Length) -> None:
    some, more = ([1, 20, 256, 1024], [4, 64]) if scale >= 1 else ([1, 2], [])
    # The whole loop first: what a run that is cut off should have.
    for part, counts in {"loop": sorted(some + more), "update": some, "rollout": some}.items():
        for seeds in counts:
            report.case("seeds", f"{seeds}, {part}", lambda s=seeds, p=part: measure(s, p, scale, length))


def measure(seeds: int, part: str, scale: float, length: Length) -> Row:
    capacity = plan(seeds, devices.free_memory(), round(REPLAY * min(1.0, scale)))
    return {"replay_capacity": capacity, **timing.measure(settings(seeds, capacity), part, length)}


def settings(seeds: int, capacity: int) -> list[str]:
    starts = min(25_600, capacity)
    return [
        "env=simple_spread",
        "algo=matd3",
        f"seeds={seeds}",
        f"total_steps={2 * capacity}",
        f"replay_capacity={capacity}",
        f"learning_starts={starts}",
    ]


def plan(seeds: int, free: int, most: int = REPLAY) -> int:
    """Transitions a seed that fit into `free` bytes with everything else, at most `most`; in whole rollouts.

    Row by row the work is the same with a smaller replay, so it is made as small as the memory asks for, and reported.
    """
    trainer = TrainingSession(config.load(settings(seeds, 100_000))).trainer
    return fitting(trainer, SHARE * free, most)


def fitting(trainer: TrainLoop, budget: float, most: int) -> int:
    """Rows of each seed's replay that fit into `budget` bytes: what all seeds' states and one update of those that are
    updated together leave. Raises ValueError where not even a minibatch fits."""
    together = trainer.mesh.size if trainer.on_cpu else trainer.sharding.padded_seeds
    rest = trainer.sharding.padded_seeds * memory.seed_bytes(trainer) + together * memory.update_bytes(trainer)
    rows = int((budget - rest) // (4 * trainer.sharding.padded_seeds * trainer.layout.row_size))
    collect = trainer.schedule.rollout_steps
    capacity = min(rows, most) // collect * collect
    if capacity < trainer.schedule.batch_size:
        raise ValueError(
            f"{trainer.sharding.padded_seeds} seeds need {rest / 1e9:.1f} GB without their replays, "
            f"{budget / 1e9:.1f} GB may be used"
        )
    return capacity
