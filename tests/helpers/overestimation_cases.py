"""A metrics table with overestimation of three agents, for its numbers and its picture."""

import numpy as np

from matd3_jax.runs import overestimation


def metrics_of(seeds):
    """Evaluations at 10 and 30 env steps: 1 and 3, more by 0, 5 and 7 for agents a, b and c, and by the column's
    place among `overestimation.COLUMNS`."""
    metrics = {
        "updates": np.repeat([0.0, 1.0, 2.0], seeds),
        "step": np.repeat([10.0, 20.0, 30.0], seeds),
        "seed": np.tile(np.arange(seeds), 3),
    }
    for agent, shift in (("a", 0), ("b", 5), ("c", 7)):
        numbers = np.tile([1.0, np.nan, 3.0], (seeds, 1)).T.ravel() + shift
        metrics |= {f"{agent}_{name}": numbers + k for k, name in enumerate(overestimation.COLUMNS)}
    return metrics
