"""The policies of each seed's best evaluation so far: kept in memory while a run trains, and in every checkpoint.

A checkpoint has `best/SEED.npz`: actors and what observations are normalized by, as they were at the evaluation of that
run up to the checkpoint with the highest mean return, and how sure that mean is. Whoever resumes from a checkpoint goes
on from its best ones.
"""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from matd3_jax.core.update import GroupState
from matd3_jax.errors import UserError
from matd3_jax.runtime.multihost import Share
from matd3_jax.training.state import TrainState

FOLDER = "best"
FACTS = ("step", "mean_return", "standard_error", "episodes")


class Best(NamedTuple):
    """One seed's best evaluation."""

    step: int
    """Env steps of the seed."""
    mean_return: float
    """Undiscounted return of the team, mean over the episodes."""
    standard_error: float
    """Of that mean over the episodes; nan with one episode."""
    episodes: int
    policies: dict[str, np.ndarray]
    """Leaves of the state by path, without the axis [seeds]; empty where only the facts were read."""

    @property
    def facts(self) -> dict[str, float]:
        """All but the policies, by name."""
        return {name: getattr(self, name) for name in FACTS}

    def __str__(self) -> str:
        error = "" if math.isnan(self.standard_error) else f" ± {self.standard_error:.3g}"
        plural = "s" * (self.episodes > 1)
        return f"{self.mean_return:.4g}{error} at env step {self.step:,} ({self.episodes} episode{plural})"


class BestPolicies:
    """Keeps the policies of the seeds' best evaluations.

    Args:
        seeds: how many there are in this process.
        weights: [agents] of the agents' returns in the number that is compared.
    """

    def __init__(self, seeds: int, weights: np.ndarray):
        self.weights = weights
        self.found: list[Best | None] = [None] * seeds

    def note(self, step: int, state: TrainState, returns: np.ndarray) -> None:
        """Take over the policies of the seeds whose evaluation is better than all before.

        Args:
            state: what was evaluated, leading axis [seeds] (or more: copies behind the last).
            returns: [seeds, episodes, agents].
        """
        by_episode = returns @ self.weights
        means, episodes = by_episode.mean(axis=1), by_episode.shape[1]
        better = [k for k, one in enumerate(self.found) if means[k] > (-math.inf if one is None else one.mean_return)]
        if not better:  # nan is not better than anything
            return
        leaves = {name: np.asarray(leaf) for name, leaf in _leaves(state).items()}
        for k in better:
            error = float(by_episode[k].std(ddof=1)) / math.sqrt(episodes) if episodes > 1 else math.nan
            own = {name: leaf[k].copy() for name, leaf in leaves.items()}
            self.found[k] = Best(step, float(means[k]), error, episodes, own)

    def write(self, folder: Path, seeds: Mapping[int, int]) -> list[Path]:
        """Write what there is of some seeds into a checkpoint's folder: the files.

        Args:
            seeds: places of the seeds in this process, and the numbers of their files.
        """
        written = []
        for place, number in seeds.items():
            best = self.found[place]
            if best is not None:
                (folder / FOLDER).mkdir(exist_ok=True)
                written.append(folder / FOLDER / f"{number}.npz")
                np.savez(written[-1], **best.facts, **best.policies)  # type: ignore[arg-type]
        return written

    def restore(self, checkpoint: Path, share: Share) -> None:
        """Go on from what a checkpoint has of this process's seeds."""
        self.found = [read(checkpoint, number) for number in range(share.first, share.last)]


def read(checkpoint: Path, number: int, facts_only: bool = False) -> Best | None:
    """What a checkpoint has of its seed `number`, from 0; None where it has none."""
    path = checkpoint / FOLDER / f"{number}.npz"
    if not path.is_file():
        return None
    with np.load(path) as file:
        step, mean, error, episodes = (file[name].item() for name in FACTS)
        policies = {} if facts_only else {name: file[name] for name in file.files if name not in FACTS}
    return Best(int(step), float(mean), float(error), int(episodes), policies)


def facts(checkpoint: Path, seeds: Sequence[int]) -> dict[int, Best]:
    """The best evaluations that a checkpoint has, by the numbers of the run's `seeds`; without the policies."""
    found = {seed: read(checkpoint, place, facts_only=True) for place, seed in enumerate(seeds)}
    return {seed: best for seed, best in found.items() if best is not None}


def summary(checkpoint: Path, seeds: Sequence[int]) -> dict[str, dict[str, dict[str, float]]]:
    """What summary.json says of the best evaluations that a checkpoint has; nothing where it has none."""
    found = facts(checkpoint, seeds)
    return {"best_evaluation": {str(seed): best.facts for seed, best in found.items()}} if found else {}


def played(checkpoint: Path, state: TrainState, seeds: int) -> tuple[TrainState, list[Best | None]]:
    """A state with the policies of the best evaluations in place of a checkpoint's own, and these of each seed.

    Critics, targets and optimizers are left out; a seed that had no finite evaluation has actors of nan.

    Args:
        state: of the checkpoint, as `checkpoint.restore_actors` gives it.

    Raises UserError where the checkpoint has none, or they do not fit.
    """
    found = [read(checkpoint, number) for number in range(seeds)]
    if not any(found):
        raise UserError(
            f"{checkpoint} keeps no policies of best evaluations: the run has no evaluations (eval_every=0), or an "
            "older version trained it; leave out checkpoint=best"
        )
    leaves = _leaves(state)
    new = {}
    for name, leaf in leaves.items():
        missing = np.full(leaf.shape[1:], np.nan, leaf.dtype)
        rows = [missing if best is None else best.policies.get(name, missing[:0]) for best in found]
        if any(row.shape != missing.shape for row in rows):
            raise UserError(f"{checkpoint / FOLDER}: {name} does not fit these settings")
        rows += rows[-1:] * (leaf.shape[0] - seeds)
        new[name] = jax.device_put(np.stack(rows), leaf.sharding)
    part = kept(state)
    paths, structure = jax.tree_util.tree_flatten_with_path(part)
    part = jax.tree.unflatten(structure, [new[jax.tree_util.keystr(path)] for path, _ in paths])
    groups = tuple(
        old if old.scale is not None else one  # a team that does not learn stays as it is
        for old, one in zip(state.groups, part.groups, strict=True)
    )
    return state._replace(groups=groups, statistics=part.statistics), found


def kept(state: TrainState) -> TrainState:
    """The part of a state that is kept; all else None."""

    def actors(group: GroupState) -> GroupState:
        nothing: Any = None
        if group.scale is not None:  # of a team that does not learn
            return GroupState(*(nothing for _ in GroupState._fields))
        return GroupState(group.actor, *(nothing,) * 5, actor_average=group.actor_average)

    groups = tuple(map(actors, state.groups))
    empty: Any = TrainState(*(None for _ in TrainState._fields))  # type: ignore[arg-type]
    return empty._replace(groups=groups, statistics=state.statistics)


def _leaves(state: TrainState) -> dict[str, Any]:
    found = jax.tree_util.tree_flatten_with_path(kept(state))[0]
    return {jax.tree_util.keystr(path): leaf for path, leaf in found}
