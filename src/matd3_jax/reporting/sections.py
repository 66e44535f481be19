"""The sections of a report."""

import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from matd3_jax.config import command_line, diff
from matd3_jax.figures import style
from matd3_jax.reporting import facts
from matd3_jax.reporting.facts import Run, Setting
from matd3_jax.reporting.html import Markup, data_uri, join, number, table, tag
from matd3_jax.stats import text
from matd3_jax.stats.intervals import Estimate

SWATCH = (0, 5, 30)
"""Begin, middle and end of a line in the legend."""


def swatch(index: int) -> Markup:
    """The line that stands for a setting in the figures."""
    drawn = style.STYLES[index % len(style.STYLES)]
    dashes = None if drawn == "solid" else " ".join(str(3 * length) for length in drawn[1])  # type: ignore[index]
    color = style.SERIES[index % len(style.SERIES)]
    begin, middle, end = SWATCH
    line = tag(
        "line", x1=begin, y1=middle, x2=end, y2=middle, stroke_width=3, stroke_dasharray=dashes,
        stroke="currentColor" if color == style.web(style.BLACK) else color,
    )  # fmt: skip
    return tag("svg", line, class_="line", viewBox="0 0 30 10", aria_hidden="true")


def words(column: str) -> str:
    """What a column of returns is."""
    kind, team = ("evaluation", column[12:]) if column.startswith("eval_") else ("training", column[7:])
    return f"{team}, {kind}"


def final_returns(settings: Sequence[Setting]) -> Markup:
    """A row for each setting: the mean over its seeds with the 95 % interval, for each team."""
    names = facts.columns(settings)
    rows: list[list[str | Markup]] = []
    for k, one in enumerate(settings):
        row: list[str | Markup] = [join(swatch(k), one.label), _seeds(one), number(f"{one.end:,.0f}", one.end)]
        for name in names:
            found = one.estimate(name)
            row.append(number(text.NOTHING) if found is None else _with_interval(found))
        rows.append(row)
    heads: list[str | Markup] = ["setting", "seeds", "env steps", *map(words, names)]
    note = (
        "Training: mean undiscounted return over the last tenth of the run, exploration included. Evaluation: the last "
        "one, without exploration. Means over seeds, below them the ends of their 95 % intervals (Student's t); seeds "
        "that diverged are left out."
    )
    return join(table(heads, rows, class_="returns"), tag("p", note, class_="faint"))


def _with_interval(found: Estimate) -> Markup:
    value, low, high = (float(part) for part in found)
    band = None if np.isnan(low) else tag("small", text.ends(low, high), data_low=repr(low), data_high=repr(high))
    return tag("td", text.number(value), band, class_="number", data_value=repr(value))


def _seeds(one: Setting) -> Markup:
    lost = len(one.diverged)
    shown = f"{len(one.seeds) - lost} of {len(one.seeds)}" if lost else str(len(one.seeds))
    return number(shown, len(one.seeds) - lost)


def diverged(settings: Sequence[Setting]) -> Markup | None:
    """The seeds that diverged, by name."""
    lines = [
        tag("li", f"{one.label}: seed {seed} at env step {found.step:,} ({found.what})")
        for one in settings
        for seed, found in one.diverged.items()
    ]
    return tag("ul", *lines, class_="warning") if lines else None


def pairwise(settings: Sequence[Setting]) -> Markup | None:
    """Differences of final returns; None where there is nothing to compare."""
    rows: list[list[str | Markup]] = []
    for name in facts.columns(settings):
        for one in facts.differences(settings, name):
            found = one.found
            difference, low, high, p = (float(part) for part in (found.difference, found.low, found.high, found.p))
            band = text.NOTHING if np.isnan(low) else text.ends(low, high)
            chance = text.NOTHING if np.isnan(p) else ("< 0.001" if p < 0.001 else f"{p:.3f}")
            shown = text.number(difference)
            marked = tag("td", shown, class_="number clear" if bool(found.clear) else "number",
                         data_value=repr(difference))  # fmt: skip
            rows.append([f"{one.a.label} minus {one.b.label}", words(name), marked, number(band), number(chance, p)])
    if not rows:
        return None
    note = (
        "Welch's t-test of the seeds' values; bold where the interval leaves zero out. Of many comparisons some 5 % do "
        "so by chance."
    )
    if len(settings) > facts.ALL_PAIRS:
        note += " The best setting is compared with each other one."
    heads: list[str | Markup] = ["settings", "return", "difference", "95 % interval", "p"]
    return join(table(heads, rows, class_="pairs"), tag("p", note, class_="faint"))


def curves(settings: Sequence[Setting], figures: Sequence[tuple[str, Path, Path]]) -> Markup | None:
    """Learning curves, with one legend for all.

    Args:
        figures: of each its caption, and its picture for a light and for a dark page.
    """
    if not figures:
        return None
    legend = tag("ul", *(tag("li", swatch(k), one.label) for k, one in enumerate(settings)), class_="legend")
    drawn = []
    for caption, light, dark in figures:
        source = tag("source", srcset=data_uri(dark), media="screen and (prefers-color-scheme: dark)")
        picture = tag("picture", source, tag("img", src=data_uri(light), alt=f"learning curves: {caption}"))
        drawn.append(tag("figure", picture, tag("figcaption", caption)))
    note = "Mean over the seeds and its 95 % interval (Student's t); a curve ends where the first of its seeds ends."
    return join(legend, tag("div", *drawn, class_="gallery"), tag("p", note, class_="faint"))


def differing(settings: Sequence[Setting]) -> Markup:
    """The settings in which the runs differ."""
    if len(settings) == 1:
        return tag("p", f"All runs have the same settings but for their seeds ({settings[0].label}).")
    values = [diff.learning(one.settings) for one in settings]
    keys = diff.differing(values)
    rows: list[list[str | Markup]] = []
    for key in keys:
        cells = [diff.text(one[key]) if key in one else text.NOTHING for one in values]
        rows.append([tag("th", tag("code", key), scope="row"), *cells])
    heads: list[str | Markup] = ["key", *(join(swatch(k), one.label) for k, one in enumerate(settings))]
    return table(heads, rows, class_="differing")


def all_settings(runs: Sequence[Run]) -> Markup:
    """Every setting of every run, folded."""
    return join(*(_settings_of(run) for run in runs))


def _settings_of(run: Run) -> Markup:
    rows: list[list[str | Markup]] = [
        [tag("th", tag("code", key), scope="row"), diff.text(value)] for key, value in diff.flat(run.settings).items()
    ]
    return tag("details", tag("summary", run.name), table(["key", "value"], rows))


def runs(settings: Sequence[Setting]) -> Markup:
    """What each run directory is, how far it has come, and how long it took."""
    rows: list[list[str | Markup]] = []
    for one in settings:
        for run in one.runs:
            summary = run.summary or {}
            first, last = run.settings.seed, run.settings.seed + run.settings.seeds - 1
            state = "finished" if run.summary is not None else f"at {run.last_step:,} of {run.settings.total_steps:,}"
            rates = [_quantity(summary, key, form) for key, form in RATES]
            rows.append([run.name, one.label, f"{first} to {last}" if last > first else str(first), state, *rates])
    heads: list[str | Markup] = [
        "run directory", "setting", "seeds", "state", "wall time", "env steps/s", "updates/s", "evaluations",
    ]  # fmt: skip
    note = (
        "Rates are over all seeds and all the time but compiling; of runs that were resumed, and the wall time, too, "
        "since then. A run of a sweep has the time and the rates of the batch that it was trained in."
    )
    return join(table(heads, rows, class_="runs"), tag("p", note, class_="faint"))


RATES = (("seconds", "time"), ("env_steps_per_second", "number"), ("updates_per_second", "number"),
         ("evaluation_share", "share"))  # fmt: skip


def _quantity(summary: Mapping[str, Any], key: str, form: str) -> Markup:
    value = summary.get(key)
    if not isinstance(value, int | float) or isinstance(value, bool) or not np.isfinite(value):
        return number(text.NOTHING)
    if form == "time":
        minutes, seconds = divmod(round(value), 60)
        hours, minutes = divmod(minutes, 60)
        shown = f"{hours}:{minutes:02d}:{seconds:02d}" if hours else f"{minutes}:{seconds:02d}"
    else:
        shown = f"{100 * value:.1f} %" if form == "share" else text.number(float(value))
    return number(shown, float(value))


def films(settings: Sequence[Setting], found: Mapping[str, Path], left_out: Mapping[str, str]) -> Markup | None:
    """A film of each run.

    Args:
        found: files by the names of the runs, in their order.
        left_out: why a run has none, by its name.
    """
    shown = []
    labels = [one.label for one in settings for run in one.runs if run.name in found]
    for (name, path), label in zip(found.items(), labels, strict=True):
        uri = data_uri(path)
        if path.suffix == ".mp4":
            film = tag("video", src=uri, controls=True, loop=True, muted=True, playsinline=True, preload="metadata")
        else:
            film = tag("img", src=uri, alt=f"an episode of {name}")
        shown.append(tag("figure", film, tag("figcaption", f"{name} ({label})")))
    notes = [tag("li", f"{name}: {why}") for name, why in left_out.items()]
    if not shown and not notes:
        return None
    gallery = tag("div", *shown, class_="gallery films") if shown else None
    return join(gallery, tag("ul", *notes, class_="faint") if notes else None)


def machines(runs: Sequence[Run]) -> Markup:
    """Versions and devices; runs of the same ones share a row."""
    shared: dict[str, tuple[list[str], str, str]] = {}
    for run in runs:
        versions = run.machine.get("versions")
        named = versions if isinstance(versions, dict) else {}
        shown = ", ".join(f"{name} {version}" for name, version in named.items()) or text.NOTHING
        devices = run.machine.get("devices")
        parts = [", ".join(map(str, devices))] if isinstance(devices, list) else []
        parts += [f"{key.replace('_', ' ')}: {run.machine[key]}" for key in MACHINE if key in run.machine]
        where = "; ".join(parts) or text.NOTHING
        shared.setdefault(f"{shown}\0{where}", ([], where, shown))[0].append(run.name)
    rows: list[list[str | Markup]] = [[", ".join(names), where, shown] for names, where, shown in shared.values()]
    return table(["runs", "machine", "versions"], rows, class_="machines")


MACHINE = ("processor", "cores", "memory_gib", "system", "processes", "hosts")


def commands(runs: Sequence[Run], report: str) -> Markup:
    """How to train the runs again, and to make this page."""
    lines, without = [], []
    for run in runs:
        found = command_line.overrides(run.settings)
        if found is None:
            without.append(tag("li", f"{run.name}: no command line gives its settings; they are listed above"))
        else:
            lines.append(shlex.join(["python", "-m", "matd3_jax.train", *found]))
    return join(
        tag("pre", "\n".join(lines)) if lines else None,
        tag("ul", *without, class_="faint") if without else None,
        tag("p", "This page:"),
        tag("pre", report),
    )
