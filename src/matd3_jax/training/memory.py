"""How much memory training takes, computed before anything is allocated."""

import math

import chex
import jax

from matd3_jax.config import Config
from matd3_jax.errors import UserError
from matd3_jax.training.loop import TrainLoop, idle_devices
from matd3_jax.training.session import TrainingSession

PROCESS = 1_300_000_000
"""Bytes of the process itself: interpreter, libraries, compiler, programs (docs/performance.md)."""


def needed(trainer: TrainLoop, seeds: int) -> int:
    """Bytes that training `seeds` seeds takes at most, the process and its checkpoints included.

    Args:
        trainer: of any number of seeds; its schedule, environment and algorithms count.
    """
    devices = len(jax.local_devices())
    each = idle_devices(devices, seeds, trainer.schedule.batch_size) if trainer.on_cpu else 1
    places = min(seeds, devices // each)
    rows = math.ceil(seeds / places) * places
    copies = each * rows  # a seed's state is on all the devices that work on it
    replay = trainer.replay_bytes // (trainer.rows * trainer.devices_per_seed)
    together = places if trainer.on_cpu else rows  # seeds updated at the same time
    # A checkpoint is written seed by seed: one seed's replay on its way out, and once more in the writer's hands.
    return PROCESS + copies * (replay + seed_bytes(trainer)) + together * update_bytes(trainer) + 2 * replay


def seed_bytes(trainer: TrainLoop) -> int:
    """Bytes of one seed beside its replay: its state, twice while it changes, and a rollout with its fresh starts."""
    schedule, layout = trainer.schedule, trainer.layout
    state = trainer.abstract_state()
    whole = size(state._replace(replay=None, rollouts=None)) // trainer.rows  # type: ignore[arg-type]
    one_env = size(state.env) // (trainer.rows * schedule.num_envs)
    # Each transition of a rollout: its row, what it is packed from, and a fresh start.
    return 2 * whole + schedule.rollout_steps * (2 * 4 * layout.row_size + 2 * one_env)


def update_bytes(trainer: TrainLoop) -> int:
    """Bytes that one seed's update takes beside its state: minibatches, noise, activations and their gradients."""
    layout, schedule = trainer.layout, trainer.schedule
    agents = 1 if trainer.on_cpu else layout.num_agents  # agents updated at the same time
    widest = max(
        group.algorithm.num_critics * (sum(group.algorithm.hidden) + group.critic.num_outputs)
        + layout.observation_size
        + layout.action_size
        for group in layout.groups
    )
    rows = layout.num_agents * layout.row_size  # gathered for all agents at once
    noise = layout.num_agents * 3 * layout.action_size
    return 4 * schedule.batch_size * (2 * rows + noise + agents * 4 * widest)


def most_seeds(trainer: TrainLoop, budget: int) -> int:
    """The largest number of seeds, a multiple of the devices where it can be, that `needed` says fit into `budget`
    bytes. Raises UserError, with the arithmetic, where not even one does."""
    if needed(trainer, 1) > budget:
        capacity, replay = trainer.schedule.replay_capacity, trainer.replay_bytes / trainer.rows
        raise UserError(
            f"one seed needs {needed(trainer, 1) / 1e9:.2f} GB, {replay / 1e9:.2f} GB of it for a replay of "
            f"{capacity:,} transitions, but only {budget / 1e9:.2f} GB may be used"
        )
    low, high = 1, 2
    while needed(trainer, high) <= budget:
        low, high = high, 2 * high
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if needed(trainer, middle) <= budget else (low, middle)
    devices = len(jax.local_devices())
    return max(low // devices * devices, min(low, devices))


def fitting_seeds(config: Config, budget: int) -> int:
    """`most_seeds` of a run's settings."""
    return most_seeds(TrainingSession(config).trainer, budget)


def size(tree: chex.ArrayTree) -> int:
    """Bytes of all leaves, arrays or their shapes."""

    def one(leaf) -> int:
        if jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            leaf = jax.eval_shape(jax.random.key_data, leaf)
        return leaf.size * leaf.dtype.itemsize

    return sum(map(one, jax.tree.leaves(tree)))
