"""The summary of a run: the last tenth of it, over its seeds."""

from typing import Any

import numpy as np

from matd3_jax.stats.intervals import mean_interval
from matd3_jax.stats.text import plus_minus


def finals(metrics: dict[str, np.ndarray]) -> dict[str, tuple[float, float | None]]:
    """For each team `final` of the mean training return in the last tenth of the run, if all seeds ended episodes."""
    late = metrics["step"] > 0.9 * metrics["step"].max()
    finals = {}
    for name in (name for name in metrics if name.startswith("return_")):
        there = late & ~np.isnan(metrics[name])  # long episodes need not end within an interval
        seeds = [metrics[name][there & (metrics["seed"] == s)] for s in np.unique(metrics["seed"])]
        if all(values.size for values in seeds):
            finals[name.removeprefix("return_")] = final(np.array([values.mean() for values in seeds]))
    return finals


def summary(metrics: dict[str, np.ndarray], row: dict[str, np.ndarray], **facts: Any) -> dict[str, Any]:
    """What a run leaves in summary.json at its end.

    Args:
        metrics: columns [rows] of its metrics table; row: the last row of it, columns [seeds].
    """
    found = {"total_steps": int(row["step"][0]), **facts, "last_tenth": finals(metrics)}
    evaluated = [name for name in row if name.startswith("eval_") or name.endswith("_eval_return")]
    if evaluated:
        found["last_evaluation"] = {name.replace("eval_", "", 1): final(row[name]) for name in evaluated}
    return found


def final(values: np.ndarray) -> tuple[float, float | None]:
    """Mean and 95 % half width over seeds; None with one seed."""
    mean, half = mean_interval(values)
    return float(mean), float(half) if len(values) > 1 else None


def text(final: tuple[float, float | None], over: str) -> str:
    """Write a mean with its half width, and what that is `over`."""
    return plus_minus(*final) + ("" if final[1] is None else f" {over}")
