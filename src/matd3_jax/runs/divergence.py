"""Seeds that diverged: whose losses, values, returns or networks are not finite.

nan stands for "missing", too: before the first update, where no episode ended, between evaluations, where an update
left the actor alone. None of these counts.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from matd3_jax.errors import UserError
from matd3_jax.runs.directory import RunDirectory

NETWORKS = "its networks are not finite"
"""Where no column of the metrics table says so first."""


class Divergence(NamedTuple):
    """When a seed was first seen to have diverged, and by what."""

    step: int
    """Env steps of the seed."""
    what: str
    """Of which column of the metrics table, or `NETWORKS`."""


def not_finite(metrics: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """For each column of losses, values and returns, whether an entry is a number that is not finite.

    Args:
        metrics: columns of the metrics table, of any one shape.
    """
    updates, episodes = metrics["updates"], metrics["episodes"]
    # An episode's length is a count: finite wherever an evaluation was made.
    evaluated = np.isfinite(metrics.get("eval_episode_length", np.full(np.shape(updates), np.nan)))
    found = {}
    for name, values in metrics.items():
        if name.endswith(("_critic_loss", "_q_value")):
            found[name] = ~np.isfinite(values) & (updates > 0)
        elif name.endswith("_actor_loss"):
            found[name] = np.isinf(values)
        elif name.startswith("eval_return_") or name.endswith("_eval_return"):
            found[name] = ~np.isfinite(values) & evaluated
        elif name.startswith("return_") or name.endswith("_return"):
            found[name] = ~np.isfinite(values) & (episodes > 0)
    return found


def of_table(metrics: Mapping[str, np.ndarray], after: Mapping[int, int] | None = None) -> dict[int, Divergence]:
    """The seeds that diverged, by their numbers, ascending.

    Args:
        metrics: columns [rows] of the metrics table, each seed's rows ascending.
        after: env steps by seed, up to which its rows do not count: it has had other networks since.
    """
    wrong = not_finite(metrics)
    found: dict[int, Divergence] = {}
    if not wrong:
        return found
    for row in np.flatnonzero(np.any(list(wrong.values()), axis=0)).tolist():
        name = next(name for name, there in wrong.items() if there[row])
        seed, step = int(metrics["seed"][row]), int(metrics["step"][row])
        if after is None or step > after.get(seed, -1):
            found.setdefault(seed, Divergence(step, is_not(metrics, name, row)))
    return dict(sorted(found.items()))


def is_not(metrics: Mapping[str, np.ndarray], name: str, index: int) -> str:
    """What a `Divergence` says of an entry."""
    return f"{name} is {metrics[name][index]}"


def of_networks(finite: np.ndarray, numbers: Iterable[int], step: int) -> dict[int, Divergence]:
    """The seeds whose networks are not finite at env step `step`; finite: [seeds]."""
    return {int(seed): Divergence(step, NETWORKS) for seed, sound in zip(numbers, finite, strict=True) if not sound}


def earliest(*found: Mapping[int, Divergence]) -> dict[int, Divergence]:
    """All seeds that diverged, each with what was seen first."""
    merged: dict[int, Divergence] = {}
    for seed, one in (pair for part in found for pair in part.items()):
        if seed not in merged or one.step < merged[seed].step:
            merged[seed] = one
    return dict(sorted(merged.items()))


def of_run(run: RunDirectory, step: int, after: Mapping[int, int] | None = None) -> dict[int, Divergence]:
    """The seeds of a run that had diverged by env step `step`, as far as its metrics say; `after`: as in
    `of_table`."""
    try:
        metrics = run.read_metrics()
    except UserError:
        return {}
    there = metrics["step"] <= step
    return of_table({name: column[there] for name, column in metrics.items()}, after)


def without(metrics: Mapping[str, np.ndarray], diverged: Sequence[int] | Mapping[int, object]) -> dict[str, np.ndarray]:
    """The rows [rows] of the other seeds."""
    sound = ~np.isin(metrics["seed"], list(diverged))
    return {name: column[sound] for name, column in metrics.items()}


def cut(metrics: Mapping[str, np.ndarray], diverged: Mapping[int, Divergence]) -> dict[str, np.ndarray]:
    """The metrics [rows] with nan for all that seeds have after they diverged, but for their counts."""
    after = np.zeros(len(metrics["step"]), bool)
    for seed, found in diverged.items():
        after |= (metrics["seed"] == seed) & (metrics["step"] >= found.step)
    counts = ("step", "seed", "updates", "episodes")
    return {name: column if name in counts else np.where(after, np.nan, column) for name, column in metrics.items()}


# ---- in words --------------------------------------------------------------------------------------------------------


def which(diverged: Mapping[int, Divergence], most: int = 3) -> str:
    """Write which seeds diverged, and when: "seed 2 diverged at 4,500"."""
    shown = [f"seed {seed} diverged at {found.step:,}" for seed, found in list(diverged.items())[:most]]
    more = len(diverged) - len(shown)
    return ", ".join(shown) + (f", and {more} more" if more else "")


def of_seeds(total: int, diverged: Mapping[int, Divergence]) -> str:
    """Write of which seeds means are: "4 seeds", or "3 of 4 seeds, seed 2 diverged at 4,500"."""
    plural = "s" if total > 1 else ""
    if not diverged:
        return f"{total} seed{plural}"
    left = total - len(diverged)
    return f"{left if left else 'none'} of {total} seed{plural}, {which(diverged)}"
