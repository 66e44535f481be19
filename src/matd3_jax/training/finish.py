"""What a run leaves at its end, made from its metrics table: it can be made again at any time."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from matd3_jax.core.agents import JointLayout
from matd3_jax.errors import UserError
from matd3_jax.figures import learning_curves, q_bias
from matd3_jax.runs import divergence, overestimation, summary
from matd3_jax.runs.directory import RunDirectory
from matd3_jax.runs.divergence import Divergence


def draw(
    run: RunDirectory, layout: JointLayout, title: str, with_q_bias: bool, diverged: Mapping[int, Divergence]
) -> None:
    """Draw the figures of a run as far as it has come; means without the seeds that diverged."""
    metrics = _metrics(run)
    if metrics:
        _draw(run, metrics, layout, title, with_q_bias, diverged)


def _metrics(run: RunDirectory) -> dict[str, np.ndarray]:
    """The columns of a run's metrics table; none where it was lost."""
    try:
        return run.read_metrics()
    except UserError:
        return {}


def _draw(
    run: RunDirectory,
    metrics: Mapping[str, np.ndarray],
    layout: JointLayout,
    title: str,
    with_q_bias: bool,
    diverged: Mapping[int, Divergence],
) -> Mapping[str, np.ndarray]:
    """Draw the figures of a metrics table: its rows without the seeds that diverged."""
    learning_curves.learning_curve(run.curve, metrics, title, diverged)
    sound = divergence.without(metrics, diverged)
    if with_q_bias and sound["step"].size:
        q_bias.draw(run.q_bias, sound, layout.by_team(), title)
    return sound


def finish(
    run: RunDirectory,
    layout: JointLayout,
    title: str,
    with_q_bias: bool,
    done: int,
    facts: Mapping[str, Any],
    diverged: Mapping[int, Divergence],
) -> dict[str, Any]:
    """Draw the figures of a run that has come to its end, and write its summary, which is returned.

    Where its metrics table was lost there are no figures, and no means in the summary.

    Args:
        done: env step of its end.
        facts: times and rates, which only the process that trained knows.
        diverged: what that process found; the table's own are found again.
    """
    metrics = _metrics(run)
    if not metrics:
        lost = summary.without_metrics(done, diverged, **facts)
        run.write_summary(lost)
        return lost
    diverged = divergence.earliest(divergence.of_table(metrics), diverged)
    sound = _draw(run, metrics, layout, title, with_q_bias, diverged)
    found = summary.summary(metrics, done, diverged, **facts)
    if with_q_bias and sound["step"].size:
        found["overestimation"] = overestimation.summary(sound, layout.learning_agents)
    run.write_summary(found)
    return found
