"""How much memory training takes, computed before anything is allocated."""

import math
from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import chex
import jax

from matd3_jax.core import rollout
from matd3_jax.core.agents import JointLayout
from matd3_jax.envs.environment import Environment
from matd3_jax.errors import UserError
from matd3_jax.runtime.multihost import Processes
from matd3_jax.training import best
from matd3_jax.training.loop import TrainLoop
from matd3_jax.training.sharding import idle_devices

PROCESS = 1_300_000_000
"""Bytes of the process itself: interpreter, libraries, compiler, programs (docs/performance.md)."""


class Part(NamedTuple):
    """Some of the memory, what it is for, and what it grows with."""

    size: int
    """Bytes."""
    what: str
    setting: str
    value: int | None = None
    """Of the setting, where the bytes are proportional to it."""


def parts(trainer: TrainLoop, seeds: int, episodes: int = 0) -> dict[str, Part]:
    """What training `seeds` seeds takes at most besides the process itself.

    Args:
        trainer: of any number of seeds; its schedule, environment and algorithms count.
        episodes: of an evaluation.
    """
    devices = len(jax.local_devices())
    shared = trainer.on_cpu and not trainer.env.on_host
    each = idle_devices(devices, seeds, trainer.schedule.batch_size) if shared else 1
    shares = min(seeds, devices // each)
    rows = math.ceil(seeds / shares) * shares
    copies = each * rows  # a seed's state is on all the devices that work on it
    replay = trainer.replay_bytes // (trainer.sharding.padded_seeds * trainer.sharding.devices_per_seed)
    together = shares if trainer.on_cpu else rows  # seeds updated at the same time
    schedule, state = trainer.schedule, trainer.abstract_state()
    one = size(state.groups) // trainer.sharding.padded_seeds
    others = seed_bytes(trainer) - 2 * one
    networks = (3 if trainer.stop_seeds else 2) * one  # while they change; those that a stopped seed would keep
    capacity, most = (
        schedule.replay_capacity,
        max(group.algorithm.num_critics for group in trainer.layout.learning_groups),
    )
    many = most > 2
    # Kept on the host, and all of them once more while those of the better seeds are taken over.
    kept = 2 * rows * size(best.kept(state)) // trainer.sharding.padded_seeds if trainer.on_cpu else 0
    return {
        "replay": Part(copies * replay, "the replay", "replay_capacity", capacity),
        # A checkpoint is written seed by seed: one seed's replay on its way out, and once more in the writer's hands.
        "checkpoint": Part(2 * replay, "a checkpoint on its way out", "replay_capacity", capacity),
        "networks": Part(
            copies * networks,
            "networks and optimizers",
            "algo.num_critics" if many else "algo.hidden",
            most if many else None,
        ),
        "best": Part(kept, "the policies of the best evaluations", "algo.hidden"),
        "environments": Part(copies * others, "environments and a rollout", "num_envs", schedule.num_envs),
        "updates": Part(together * update_bytes(trainer), "an update", "batch_size", schedule.batch_size),
        "evaluation": Part(
            copies * episodes * playing_bytes(trainer.env, trainer.layout), "an evaluation", "eval_episodes", episodes
        ),
    }


def needed(trainer: TrainLoop, seeds: int) -> int:
    """Bytes that training `seeds` seeds takes at most, the process and its checkpoints included.

    Args:
        trainer: of any number of seeds; its schedule, environment and algorithms count.
    """
    return PROCESS + sum(part.size for part in parts(trainer, seeds).values())


def check(parts: Sequence[Part], free: int, otherwise: str = "") -> None:
    """Raise UserError, with what takes the most and which setting would fit, where all parts do not fit into `free`
    bytes. otherwise: what else would help."""
    total = sum(part.size for part in parts)
    if total <= free:
        return
    most = max(parts, key=lambda part: part.size)
    alike = sum(part.size for part in parts if part.setting == most.setting)
    advice = f"a smaller {most.setting}"
    if most.value is not None:
        fits = int(most.value * max(0, free - (total - alike)) / alike)
        advice = f"{most.setting} at most {fits:,}" if fits else f"a much smaller {most.setting}"
    raise UserError(
        f"{total / 1e9:,.2f} GB are needed, but only {free / 1e9:,.2f} GB are free; {most.size / 1e9:,.2f} GB for "
        f"{most.what}: {advice}{otherwise}"
    )


def of_replay(trainer: TrainLoop, processes: Processes) -> str:
    """The arithmetic of the replay's memory."""
    s = trainer.layout
    copies = f"{trainer.sharding.devices_per_seed} copies x " if trainer.sharding.devices_per_seed > 1 else ""
    whose = f" of process {processes.index}" if processes.size > 1 else ""
    return (
        f"replay{whose}: {trainer.sharding.padded_seeds} seeds x {copies}{trainer.schedule.replay_capacity:,} "
        f"transitions x {s.row_size} numbers x 4 bytes = {trainer.replay_bytes / 1e9:.2f} GB "
        f"(x {s.observation_size}, actions {s.action_size}, rewards "
        f"{s.num_agents}, {'more 1, ' if s.n_step > 1 or s.recurrent else ''}"
        f"{f'states {s.state_size}, ' if s.recurrent else ''}x' {s.observation_size}, discount 1)"
    )


def check_playing(env: Environment, layout: JointLayout, episodes: int, together: int, free: int) -> None:
    """Raise UserError where `together` times `episodes` episodes cannot be played side by side with `free` bytes."""
    what = f"{together} x {episodes:,} episodes side by side" if together > 1 else f"{episodes:,} episodes side by side"
    check([Part(together * episodes * playing_bytes(env, layout), what, "episodes", episodes)], free)


def playing_bytes(env: Environment, layout: JointLayout) -> int:
    """Bytes of an episode that is played besides others: the environment before and after a step, a fresh start, and
    what the actors compute."""
    started = jax.eval_shape(partial(rollout.start, env, num_envs=1), jax.eval_shape(jax.random.key, 0))
    widest = max(max((0, *group.algorithm.hidden)) for group in layout.groups)
    states = 4 * layout.state_size  # before and after, and the gates
    computed = layout.observation_size + 2 * layout.action_size + 2 * widest * layout.num_agents + states
    return 3 * size(started) + 4 * computed


def seed_bytes(trainer: TrainLoop) -> int:
    """Bytes of one seed without its replay: its state, twice while it changes, and a rollout with its fresh starts."""
    schedule, layout = trainer.schedule, trainer.layout
    state = trainer.abstract_state()
    whole = size(state._replace(replay=None, rollouts=None)) // trainer.sharding.padded_seeds  # type: ignore[arg-type]
    one_env = size(state.env) // (trainer.sharding.padded_seeds * schedule.num_envs)
    # Each transition of a rollout: its row, what it is packed from, and a fresh start.
    return 2 * whole + schedule.rollout_steps * (2 * 4 * layout.row_size + 2 * one_env)


def update_bytes(trainer: TrainLoop) -> int:
    """Bytes that one seed's update takes besides its state: minibatches, noise, activations and their gradients."""
    layout, schedule = trainer.layout, trainer.schedule
    agents = 1 if trainer.on_cpu else layout.num_agents  # agents updated at the same time
    widest = max(
        group.algorithm.num_critics * (sum(group.algorithm.hidden) + group.critic.num_outputs)
        + layout.observation_size
        + layout.action_size
        for group in layout.learning_groups
    )
    steps = (layout.burn_in + layout.sequence_length) / layout.sequence_length
    rows = steps * layout.num_minibatches * layout.row_size  # gathered for all agents at once
    # The gates of one agent's critics and of everybody's actors, and what their gradients need of each step.
    gates = 16 * steps * max(g.algorithm.num_critics * g.state_size for g in layout.learning_groups)
    gates += 16 * steps * layout.state_size
    noise = layout.num_agents * 3 * layout.action_size
    return int(4 * schedule.batch_size * (2 * rows + noise + agents * (4 * widest + gates)))


def most_seeds(trainer: TrainLoop, budget: int) -> int:
    """The largest number of seeds, a multiple of the devices where it can be, that `needed` says fit into `budget`
    bytes. Raises UserError, with the arithmetic, where not even one does."""
    if needed(trainer, 1) > budget:
        capacity, replay = trainer.schedule.replay_capacity, trainer.replay_bytes / trainer.sharding.padded_seeds
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


def size(tree: chex.ArrayTree) -> int:
    """Bytes of all leaves, arrays or their shapes."""

    def one(leaf) -> int:
        if jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            leaf = jax.eval_shape(jax.random.key_data, leaf)
        return leaf.size * leaf.dtype.itemsize

    return sum(map(one, jax.tree.leaves(tree)))
