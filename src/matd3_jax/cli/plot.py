"""`python -m matd3_jax.plot runs=A,B`: learning curves of any set of runs."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from matd3_jax.cli import catalog
from matd3_jax.cli.arguments import Plot
from matd3_jax.config import diff
from matd3_jax.errors import UserError, nearest
from matd3_jax.figures import learning_curves
from matd3_jax.figures.learning_curves import Line, Panel
from matd3_jax.runs import alike, curves, directory, divergence
from matd3_jax.runtime.terminal import say
from matd3_jax.stats import bootstrap, intervals

INTERVALS = {"mean": ("t", "bootstrap", "sd", "none"), "median": ("bootstrap", "none"), "iqm": ("bootstrap", "none")}
X_LABELS = {"step": "env steps of each seed", "episodes": "episodes of each seed", "updates": "updates"}
AVERAGES = {"mean": "mean", "median": "median", "iqm": "interquartile mean"}
BANDS = {"t": "95 % interval", "bootstrap": "95 % bootstrap interval", "sd": "± standard deviation"}


def main(argv: Sequence[str]) -> int:
    """Run the command; the exit code."""
    options = _checked(catalog.PLOT.parse(argv))
    groups = alike.groups(options.runs)
    settings = list(groups.values())
    found_labels = diff.label_differences(settings)
    labels = options.labels or found_labels
    if len(labels) != len(groups):
        raise UserError(f"labels={','.join(labels)}: names {len(labels)}, but there are {len(groups)}: "
                        f"{'; '.join(found_labels)}")  # fmt: skip
    tables = [directory.together(paths) for paths in groups]
    lost = [divergence.of_table(table) for table in tables]
    tables = [divergence.cut(*part) for part in zip(tables, lost, strict=True)]
    found = {
        name: [_curves(*part, name, options) for part in zip(tables, groups, lost, strict=True)] for name in options.y
    }
    many = len({len(table.seeds) for table in found[options.y[0]]}) > 1
    panels = [
        Panel(_y_label(name, tables[0]), [_line(*part, many, options) for part in zip(labels, columns, strict=True)])
        for name, columns in found.items()
    ]
    over = "" if options.window is None else f" (mean over the last {options.window:,} episodes)"
    title = alike.common(settings) if options.title is None else options.title
    caption = _caption(tables[0], many, options)
    learning_curves.compare(options.out, panels, X_LABELS[options.x] + over, title, caption, options.each)
    for panel, (name, columns) in zip(panels, found.items(), strict=True):
        for label, line, column, diverged in zip(labels, panel.lines, columns, lost, strict=True):
            if line is not None:
                _tell(f"{label}: {name}", line.estimate, column, diverged, options)
    say(str(options.out))
    return 0


def _curves(
    table: Mapping[str, np.ndarray],
    paths: Sequence[Path],
    diverged: Mapping[int, divergence.Divergence],
    name: str,
    options: Plot,
) -> curves.Curves:
    where = ", ".join(map(str, paths))
    if name not in table or name == "seed":
        raise UserError(f"y={name}: {where} has no such column; {nearest(name, (c for c in table if c != 'seed'))}")
    try:
        return curves.of_table(table, name, options.x, options.window)
    except ValueError as error:
        lost = f" ({divergence.which(diverged)})" if diverged else ""
        raise UserError(f"y={name} of {where}: {error}{lost}") from error


def _line(label: str, found: curves.Curves, many: bool, options: Plot) -> Line:
    count = len(found.seeds)
    shown = f"{label} ({count} seed{'s' if count > 1 else ''})" if many else label
    return Line(shown, found.x, _estimate(found.values, options), found.values)


def _estimate(values: np.ndarray, options: Plot) -> intervals.Estimate:
    """Values [seeds, points] as a line with its band [points]."""
    if options.interval == "bootstrap":
        return bootstrap.average(values, options.average)
    if options.interval == "t":
        return intervals.t_interval(values)
    middle = bootstrap.location(values, options.average)
    half = values.std(axis=0, ddof=1) if options.interval == "sd" and len(values) > 1 else np.full_like(middle, np.nan)
    return intervals.Estimate(middle, middle - half, middle + half)


def _tell(
    what: str,
    estimate: intervals.Estimate,
    found: curves.Curves,
    diverged: Mapping[int, divergence.Divergence],
    options: Plot,
) -> None:
    """Print where a line ends, what it is there, and which seeds do not go as far as the others."""
    value, low, high = (float(part[-1]) for part in estimate)
    count = len(found.seeds)
    band = "" if np.isnan(low) else f" ({BANDS[str(options.interval)]}: {low:.4g} to {high:.4g})"
    of = f"{AVERAGES[options.average]} of {count} seeds" if count > 1 else "one seed"
    say(f"{what} {value:.4g}{band}, {of}, at {options.x} {found.x[-1]:,.0f}")
    shortest, farthest = found.ends.min(), found.ends.max()
    if farthest - found.x[-1] > 2 * np.diff(found.x, prepend=0).max():
        early = ", ".join(f"{seed:.0f}" for seed in found.seeds[found.ends == shortest])
        say(f"  drawn up to there because the values with seed {early} end; others reach {farthest:,.0f}")
    if diverged:
        say(f"  {divergence.which(diverged)}: values from there on are left out")


def _y_label(name: str, table: Mapping[str, np.ndarray]) -> str:
    """What a column is, in words."""
    kind = "evaluation" if curves.evaluated(name) else "training"
    bare = name.replace("eval_", "", 1)
    if bare.startswith("return_"):
        teams = [column for column in table if column.startswith("return_")]
        return f"{kind} return" + (f", {bare.removeprefix('return_')}" if len(teams) > 1 else "")
    if bare.endswith("_return"):
        return f"{kind} return, {bare.removesuffix('_return').replace('_', ' ')}"
    return bare.replace("_", " ") + (" (evaluation)" if kind == "evaluation" else "")


def _caption(table: Mapping[str, np.ndarray], many: bool, options: Plot) -> str:
    """What lines and bands are, for the legend."""
    count = len(np.unique(table["seed"]))
    if count == 1 and not many:
        return "one seed"
    band = "" if options.interval == "none" else f", {BANDS[str(options.interval)]}"
    return f"{AVERAGES[options.average]} of {'the' if many else count} seeds{band}"


# ---- options ---------------------------------------------------------------------------------------------------------


def _checked(options: Plot) -> Plot:
    """The options, with the interval that goes with the average. Raises UserError for what does not go together."""
    if not options.y:
        raise UserError("y=: say what to draw, a COLUMN of metrics.csv, for instance y=return_agents")
    offered = INTERVALS[options.average]
    interval = options.interval or offered[0]
    if interval not in offered:
        raise UserError(f"interval={interval}: must be one of {', '.join(offered)} with average={options.average}")
    for name in options.y:
        if options.window is not None and curves.evaluated(name):
            raise UserError(f"window={options.window}: goes over training episodes, but y={name} is from evaluations")
    learning_curves.check(options.out)
    return dataclasses.replace(options, interval=interval)
