"""What a run begins with from other runs: networks to train on (init=), and policies of teams that do not learn.

It is gathered before anything is written, and kept in the run directory (`FILE`): the run then needs the others no
more.
"""

import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from matd3_jax import config as configuration
from matd3_jax.config import Config
from matd3_jax.config.diff import differing, text
from matd3_jax.errors import UserError
from matd3_jax.runs.directory import START, RunDirectory
from matd3_jax.runtime import files
from matd3_jax.runtime.multihost import Share
from matd3_jax.training.state import TrainState

if TYPE_CHECKING:
    from matd3_jax.training.loop import TrainLoop
    from matd3_jax.training.session import TrainingSession

FILE = START

Leaves = dict[str, np.ndarray]
"""Leaves of the state by path, leading axis [seeds] (of all processes)."""


def needed(settings: Config) -> bool:
    """Whether a run begins with anything of others."""
    return settings.init is not None or any(team.frozen for team in settings.teams().values())


def lines(settings: Config) -> list[str]:
    """What is said of it before a run trains."""
    found = []
    if settings.hands_over:
        found.append(
            "first the agents learn, each with its own networks, then one agent in their place goes on with "
            + ("networks that have learned from these" if _distills(settings) else "these")
        )
    if settings.init is not None:
        found.append(
            f"begins with the networks and statistics of {settings.init} "
            f"({_which(settings.init_checkpoint)}{_elsewhere(settings, settings.init)}); optimizers and replay are "
            "fresh"
        )
    for team, algo in settings.teams().items():
        if algo.frozen:
            which = f"{_which(algo.policy_checkpoint)}{_elsewhere(settings, str(algo.policy))}"
            found.append(f"{team} play the policy of {algo.policy} ({which}) and do not learn")
    return found


def _elsewhere(settings: Config, path: str) -> str:
    """In what environment another run learned, where it is not this one's."""
    try:
        there = RunDirectory.open(Path(path))[1].env
    except UserError:  # resumed, a run needs the other no more
        return ""
    if there["name"] != settings.env["name"]:
        return f"; learned in {there['name']}"
    other = [key for key in differing([there, settings.env]) if key in there and key in settings.env]
    return f"; learned with {', '.join(f'env.{key}={text(there[key])}' for key in other)}" if other else ""


def _distills(settings: Config) -> bool:
    return any(team.handover == "distill" for team in settings.teams().values())


def _which(given: str | None) -> str:
    return {None: "last checkpoint", "last": "last checkpoint", "best": "best evaluations"}.get(
        given, f"env step {given}"
    )


def gather(training: "TrainingSession") -> Leaves:
    """What the seeds of all members of a session begin with; nothing where the settings want nothing.

    Raises UserError where another run is not there, or something of it does not fit: it names the first thing.
    """
    if not any(map(needed, training.members)):
        return {}
    from matd3_jax.training import source  # which plans runs itself

    return joined([source.of(member, training) for member in training.members])


def joined(parts: Sequence[Leaves]) -> Leaves:
    """What several runs begin with, side by side."""
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]} if parts else {}


def put(trainer: "TrainLoop", state: TrainState, given: Mapping[str, np.ndarray], share: Share) -> TrainState:
    """A fresh state with what is given in it, of this process's seeds."""
    if not given:
        return state
    paths, structure = jax.tree_util.tree_flatten_with_path(state)
    names = [jax.tree_util.keystr(path) for path, _ in paths]
    if unknown := sorted(set(given) - set(names)):
        raise UserError(f"{FILE}: {unknown[0]} does not fit these settings")
    leaves: list[Any] = []
    for name, (_, leaf) in zip(names, paths, strict=True):
        if name in given:
            own = np.asarray(trainer.sharding.pad(np.asarray(given[name][share.seeds], leaf.dtype)))
            if own.shape != leaf.shape:
                raise UserError(f"{FILE}: {name} does not fit these settings")
            leaf = jax.device_put(own, leaf.sharding)
        leaves.append(leaf)
    return jax.tree.unflatten(structure, leaves)


# ---- in a run directory ----------------------------------------------------------------------------------------------


def write(folder: Path, leaves: Leaves) -> None:
    """Leave it in a run directory."""
    with files.replacing(folder / FILE) as new:
        np.savez(new, **leaves)  # type: ignore[arg-type]


def read(folder: Path) -> Leaves:
    """What a run directory has of it. Raises UserError where that is missing or damaged."""
    try:
        with np.load(folder / FILE) as file:  # whose parts have checksums
            return {name: file[name] for name in file.files}
    except FileNotFoundError:
        raise UserError(f"{folder / FILE} is missing: the run cannot be started anew") from None
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise UserError(f"{folder / FILE} is damaged: the run cannot be started anew") from error


def of_directory(folder: Path) -> Leaves:
    """What the run in a directory begins with; nothing where it wants nothing."""
    return read(folder) if needed(configuration.read(folder / "config.yaml")) else {}
