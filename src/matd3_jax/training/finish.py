"""What a run leaves at its end, made from its metrics table: it can be made again at any time."""

from collections.abc import Mapping
from typing import Any

from matd3_jax.core.agents import JointLayout
from matd3_jax.figures import learning_curves, q_bias
from matd3_jax.runs import overestimation, summary
from matd3_jax.runs.directory import RunDirectory


def draw(run: RunDirectory, layout: JointLayout, title: str, with_q_bias: bool) -> None:
    """Draw the figures of a run as far as it has come.

    Raises UserError where it has no metrics yet.
    """
    metrics = run.read_metrics()
    learning_curves.learning_curve(run.curve, metrics, title)
    if with_q_bias:
        q_bias.draw(run.q_bias, metrics, layout.by_team(), title)


def finish(
    run: RunDirectory, layout: JointLayout, title: str, with_q_bias: bool, facts: Mapping[str, Any]
) -> dict[str, Any]:
    """Draw the figures of a run that has come to its end, and write its summary, which is returned.

    Args:
        facts: times and rates, which only the process that trained knows.

    Raises UserError where it has no metrics.
    """
    draw(run, layout, title, with_q_bias)
    metrics = run.read_metrics()
    last = metrics["step"] == metrics["step"].max()
    found = summary.summary(metrics, {name: column[last] for name, column in metrics.items()}, **facts)
    if with_q_bias:
        found["overestimation"] = overestimation.summary(metrics, layout.agents)
    run.write_summary(found)
    return found
