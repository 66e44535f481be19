"""Environments on the host in checkpoints: pickled where that is wanted, otherwise they start new episodes."""

from pathlib import Path
from typing import Any

import jax
import numpy as np

from matd3_jax.errors import UserError, described
from matd3_jax.runtime.multihost import Share
from matd3_jax.training.loop import TrainLoop
from matd3_jax.training.state import TrainState

FOLDER, FILE = "host", "environments.pickle"
"""Where a checkpoint has the pickled environments of its seeds: FOLDER/SEED/FILE."""


def save(checkpoint: Path, trainer: TrainLoop, state: TrainState, share: Share) -> list[Path]:
    """Write the environments of a process's seeds into a checkpoint: the folders that are written, none where the
    environments are not on the host or are not to be pickled."""
    env = _on_host(trainer)
    if env is None or not env.pickle:
        return []
    numbers, written = np.asarray(state.env.state.number), []
    for seed in range(trainer.num_seeds):
        folder = checkpoint / FOLDER / str(share.first + seed)
        folder.mkdir(parents=True)
        (folder / FILE).write_bytes(env.dump(numbers[seed]))
        written.append(folder)
    return written


def restored(checkpoint: Path, trainer: TrainLoop, state: TrainState, share: Share, unpickle: bool) -> TrainState:
    """A state from a checkpoint with environments that this process has.

    Args:
        unpickle: let them go on from their pickles, where there are any; what is unpickled can run any program.

    Raises UserError where they cannot be unpickled.
    """
    env = _on_host(trainer)
    if env is None:
        return state
    if not (unpickle and _pickled(checkpoint)):
        return state._replace(env=trainer.fresh_environments(state))
    numbers = []
    for place in range(trainer.sharding.padded_seeds):
        file = checkpoint / FOLDER / str(share.first + min(place, trainer.num_seeds - 1)) / FILE
        try:
            numbers.append(env.load(file.read_bytes()))
        except Exception as error:  # whatever the environment's own code raises
            raise UserError(
                f"{file} cannot be unpickled ({described(error)}); resume without env.pickle=true: episodes start anew"
            ) from error
    everywhere = jax.device_put(np.stack(numbers), trainer.shardings.env)
    return state._replace(env=state.env._replace(state=state.env.state._replace(number=everywhere)))


def notes(checkpoint: Path, trainer: TrainLoop, unpickle: bool, sweep: bool = False) -> list[str]:
    """What is to be said of the environments when a run is resumed: a line, or none.

    Args:
        sweep: it is one of a sweep, which never unpickles.
    """
    env = _on_host(trainer)
    if env is None:
        return []
    if sweep:
        return [f"note: the episodes of {env.name} start anew"]
    if _pickled(checkpoint):
        if unpickle:
            return []
        return [
            f"note: the episodes of {env.name} start anew; to let them go on from the checkpoint's pickles, which can "
            "run any program, give env.pickle=true once more"
        ]
    return [f"note: the episodes of {env.name} start anew: the checkpoint does not hold them (env.pickle=true would)"]


def _pickled(checkpoint: Path) -> bool:
    return (checkpoint / FOLDER).is_dir()


def _on_host(trainer: TrainLoop) -> Any:
    """The environment on the host, out of all that wraps it; None: there is none."""
    env: Any = trainer.env
    if not env.on_host:
        return None
    while hasattr(env, "env"):
        env = env.env
    return env
