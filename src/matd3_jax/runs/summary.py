"""The summary of a run: the last tenth of it, over its seeds."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from matd3_jax.runs import divergence
from matd3_jax.runs.divergence import Divergence
from matd3_jax.stats.intervals import mean_interval
from matd3_jax.stats.text import plus_minus


def finals(metrics: dict[str, np.ndarray], done: int) -> dict[str, tuple[float, float | None]]:
    """For each team `final` of the mean training return in the last tenth of the run, if all seeds ended episodes.

    Args:
        metrics: columns [rows] of the metrics table, without seeds that diverged.
        done: env step of the run's end.
    """
    late = metrics["step"] > 0.9 * done
    finals = {}
    for name in (name for name in metrics if name.startswith("return_")):
        there = late & ~np.isnan(metrics[name])  # long episodes need not end within an interval
        seeds = [metrics[name][there & (metrics["seed"] == s)] for s in np.unique(metrics["seed"])]
        if seeds and all(values.size for values in seeds):
            finals[name.removeprefix("return_")] = final(np.array([values.mean() for values in seeds]))
    return finals


def summary(
    metrics: dict[str, np.ndarray], done: int, diverged: Mapping[int, Divergence], **facts: Any
) -> dict[str, Any]:
    """What a run leaves in summary.json at its end: means over the seeds that did not diverge; no means without any.

    Args:
        metrics: columns [rows] of its metrics table.
        done: env step of the run's end.
    """
    sound = divergence.without(metrics, diverged)
    found = {**without_metrics(done, diverged, **facts), "last_tenth": finals(sound, done)}
    evaluated = [name for name in metrics if name.startswith("eval_") or name.endswith("_eval_return")]
    last = sound["step"] == done
    if evaluated and last.any():
        found["last_evaluation"] = {name.replace("eval_", "", 1): final(sound[name][last]) for name in evaluated}
    return found


def without_metrics(done: int, diverged: Mapping[int, Divergence], **facts: Any) -> dict[str, Any]:
    """The summary of a run whose metrics table was lost: it has no means."""
    steps = {str(seed): found.step for seed, found in diverged.items()}
    return {"total_steps": done, **facts, "diverged": steps, "last_tenth": {}}


def final(values: np.ndarray) -> tuple[float, float | None]:
    """Mean and 95 % half width over seeds; None with one seed."""
    mean, half = mean_interval(values)
    return float(mean), float(half) if len(values) > 1 else None


def text(final: tuple[float, float | None], over: str) -> str:
    """Write a mean with its half width, and what that is `over`."""
    return plus_minus(*final) + ("" if final[1] is None else f" {over}")
