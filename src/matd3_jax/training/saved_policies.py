"""The policies of a run that a command plays: those of a checkpoint, or of each seed's best evaluation."""

from typing import NamedTuple

import numpy as np

from matd3_jax.runs import divergence
from matd3_jax.runs.directory import RunDirectory
from matd3_jax.runs.divergence import Divergence
from matd3_jax.training import best, checkpoint
from matd3_jax.training.best import Best
from matd3_jax.training.session import TrainingSession
from matd3_jax.training.state import TrainState

BEST, LAST = "best", "last"
"""What `checkpoint=` may name instead of an env step."""


class SavedPolicies(NamedTuple):
    """Of all seeds of a run."""

    state: TrainState
    """Enough to act; leading axis [seeds]."""
    steps: np.ndarray
    """[seeds] env step at which each seed's were kept."""
    finite: np.ndarray
    """[seeds] whether the seed's networks have finite numbers only."""
    diverged: dict[int, Divergence]
    """Seeds that had diverged by then, by their numbers."""
    evaluations: tuple[Best | None, ...] | None = None
    """[seeds] the best evaluations that they are of; None: they are a checkpoint's own."""

    @property
    def best(self) -> bool:
        """Whether they are those of the best evaluations."""
        return self.evaluations is not None

    @property
    def when(self) -> str:
        """Which they are, in words."""
        first, last = int(self.steps.min()), int(self.steps.max())
        if not self.best:
            return f"env step {last:,}"
        return f"best evaluations, env step {last:,}" + (f" back to {first:,}" if first < last else "")


def load(run: RunDirectory, training: TrainingSession, which: int | str | None) -> SavedPolicies:
    """The policies of the checkpoint of an env step, of the last one (None, "last"), or of the best evaluations that
    the last one has ("best").

    Raises UserError where there are none, or the checkpoint is damaged.
    """
    path = checkpoint.verify(run.checkpoints, which if isinstance(which, int) else None)
    state, seeds = checkpoint.restore_actors(path, training.trainer), training.config.seeds
    steps, evaluations = np.full(seeds, int(path.name)), None
    if which == BEST:
        state, found = best.played(path, state, seeds)
        steps, evaluations = np.array([0 if one is None else one.step for one in found]), tuple(found)
    numbers = training.config.seed_numbers
    finite = training.finite(state)
    by_seed = dict(zip(numbers, steps.tolist(), strict=True))
    networks = {
        seed: divergence.Divergence(by_seed[seed], divergence.NETWORKS)
        for seed, sound in zip(numbers, finite, strict=True)
        if not sound
    }
    table = {seed: one for seed, one in divergence.of_run(run, max(steps)).items() if one.step <= by_seed[seed]}
    return SavedPolicies(state, steps, finite, divergence.earliest(table, networks), evaluations)
