"""Columns of the metrics table, seed by seed."""

from collections.abc import Mapping

import numpy as np


def by_seed(metrics: Mapping[str, np.ndarray], name: str) -> tuple[np.ndarray, np.ndarray]:
    """Env steps [points] and values [seeds, points] of a column where it is not nan for all seeds."""
    seeds = np.unique(metrics["seed"])
    values = np.stack([metrics[name][metrics["seed"] == seed] for seed in seeds])
    there = ~np.isnan(values).all(axis=0)
    return metrics["step"][metrics["seed"] == seeds[0]][there], values[:, there]
