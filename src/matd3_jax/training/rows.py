"""Rows of the metrics table: what an interval of training says of each seed."""

from collections.abc import Callable, Sequence

import numpy as np

from matd3_jax.core.agents import JointLayout
from matd3_jax.core.rollout import Episodes
from matd3_jax.training.state import Metrics

Row = dict[str, np.ndarray]
"""Columns of the metrics table for one interval: each [seeds]; "step" and "seed" among them."""

LEARNING_COLUMNS = ("critic_loss", "q_value", "actor_loss")
"""Of each agent that learns; means over the updates of an interval."""


def of_interval(
    layout: JointLayout,
    seeds: np.ndarray,
    step: int,
    updates: int,
    metrics: Metrics,
    team_weights: Callable[[str], np.ndarray],
) -> Row:
    """The interval's row for each seed, without evaluations.

    Args:
        seeds: [seeds] their numbers.
        step, updates: of each seed so far.
        metrics: leading axes [seeds or more, iterations]; `update` is None where there were no updates.
        team_weights: gives the weights [agents] of the agents' returns in the number reported for a team.
    """
    count = len(seeds)
    row: Row = {"step": np.full(count, step), "seed": seeds, "updates": np.full(count, updates)}
    episodes = Episodes(*(np.asarray(e, np.float64)[:count].sum(axis=1) for e in metrics.episodes))
    with np.errstate(invalid="ignore", divide="ignore"):
        returns = episodes.episode_return / episodes.count[:, None]
        length = episodes.length / episodes.count
    row["episodes"] = episodes.count.astype(int)
    row["episode_length"] = length
    for team in dict.fromkeys(layout.teams):
        row[f"return_{team}"] = returns @ team_weights(team)
    for i, agent in enumerate(layout.agents):
        row[f"{agent}_return"] = returns[:, i]
    losses = metrics.update._asdict() if metrics.update is not None else {}
    for name in LEARNING_COLUMNS:
        values = np.asarray(losses[name], np.float64)[:count].mean(axis=1) if losses else None
        for i in layout.learners:
            row[f"{layout.agents[i]}_{name}"] = np.full(count, np.nan) if values is None else values[:, i]
    return row


def without_learning(row: Row, stopped: np.ndarray) -> Row:
    """The row with nan for what seeds learn in an interval in which they stopped, or after it; stopped: [seeds]."""
    learning = tuple(f"_{name}" for name in LEARNING_COLUMNS)
    return {name: np.where(stopped, np.nan, v) if name.endswith(learning) else v for name, v in row.items()}


def columns(layout: JointLayout) -> Sequence[str]:
    """The names of the columns of `of_interval`, in their order."""
    names = ["step", "seed", "updates", "episodes", "episode_length"]
    names += [f"return_{team}" for team in dict.fromkeys(layout.teams)]
    names += [f"{agent}_return" for agent in layout.agents]
    return names + [f"{agent}_{name}" for name in LEARNING_COLUMNS for agent in layout.learning_agents]
