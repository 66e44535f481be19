"""Run directories and tables that were made up, for the tests of the experiments."""

import numpy as np

from experiments import tidy
from experiments.tidy import Table
from matd3_jax import config
from matd3_jax.runs.directory import RunDirectory

NOISE = np.array([-1.0, 1.0, 0.5, -0.5])
"""Seeds about their mean."""


def fake_run(path, overrides, columns, finished=True, first=0):
    """A run directory of two rows (untrained, and 1,000 episodes later) for each seed, from number `first` on.

    columns: name -> (values [seeds] of the first row, of the second).
    """
    seeds = len(next(iter(columns.values()))[0])
    settings = config.load([*overrides, f"seeds={seeds}", *([f"seed={first}"] if first else [])])
    run = RunDirectory.create(path, settings, {"cores": 2})
    for k, step in enumerate((25_000, 50_000)):
        row = {"step": np.full(seeds, step), "seed": first + np.arange(seeds), "updates": np.full(seeds, 250 * k)}
        row |= {"episodes": np.full(seeds, 1000), "episode_length": np.full(seeds, 25.0)}
        run.append(row | {name: np.asarray(values[k], float) for name, values in columns.items()})
    if finished:
        run.write_summary({"total_steps": 50_000, "seconds": 1.0})


def table_of(settings, seeds=4):
    """A table from {(key values as items): {column: [points][seeds]}}: 1,000 episodes and 100 updates a point."""
    tables = []
    for keys, columns in settings.items():
        points = len(next(iter(columns.values())))
        place = [(seed, k) for seed in range(seeds) for k in range(points)]
        rows = {key: np.full(len(place), value) for key, value in keys}
        rows |= {
            "seed": np.array([s for s, _ in place], float),
            "step": np.array([25_000.0 * (k + 1) for _, k in place]),
        }
        rows |= {"updates": np.array([100.0 * k for _, k in place]), "episodes": np.full(len(place), 1000.0)}
        for name, values in columns.items():
            rows[name] = np.array([np.broadcast_to(values[k], seeds)[s] for s, k in place], float)
        tables.append(Table(rows))
    return tidy.concatenate(tables)


def verdicts(claims):
    return [claim.verdict for claim in claims]
