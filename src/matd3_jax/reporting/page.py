"""A report as one page: no scripts, nothing that is loaded from elsewhere."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

import matd3_jax
from matd3_jax.reporting import sections
from matd3_jax.reporting.facts import Setting
from matd3_jax.reporting.html import Markup, join, tag
from matd3_jax.reporting.style import CSS

POLICY = "default-src 'none'; img-src data:; media-src data:; style-src 'unsafe-inline'"
"""What the browser may load: nothing but what is in the page. Whatever a run directory holds stays text."""


@dataclasses.dataclass(frozen=True)
class Pictures:
    """Files that go into the page."""

    figures: Sequence[tuple[str, Path, Path]]
    """Of each its caption, and its picture for a light and for a dark page."""
    films: Mapping[str, Path]
    """By the names of the runs."""
    without: Mapping[str, str]
    """Why runs have no film, by their names."""


def write(settings: Sequence[Setting], pictures: Pictures, title: str, made: str, command: str) -> str:
    """The page.

    Args:
        made: when, for the reader.
        command: the line that makes it.
    """
    runs = [run for one in settings for run in one.runs]
    seeds = sum(len(one.seeds) for one in settings)
    parts: list[tuple[str, str, Markup | None]] = [
        ("returns", "Final returns", sections.final_returns(settings)),
        ("diverged", "Seeds that diverged", sections.diverged(settings)),
        ("differences", "Differences", sections.pairwise(settings)),
        ("curves", "Learning curves", sections.curves(settings, pictures.figures)),
        ("films", "Films", sections.films(settings, pictures.films, pictures.without)),
        ("settings", "What differs", sections.differing(settings)),
        ("all-settings", "All settings", sections.all_settings(runs)),
        ("runs", "Runs", sections.runs(settings)),
        ("machines", "Machines and versions", sections.machines(runs)),
        ("commands", "To reproduce", sections.commands(runs, command)),
    ]
    there = [(key, head, content) for key, head, content in parts if content is not None]
    about = (
        f"{_count(len(runs), 'run')}, {_count(len(settings), 'setting')}, {_count(seeds, 'seed')}; made {made} with "
        f"matd3_jax {matd3_jax.__version__}"
    )
    body = tag(
        "body",
        tag("header", tag("h1", title), tag("p", about, class_="faint")),
        tag("nav", *(tag("a", head, href=f"#{key}") for key, head, _ in there)),
        tag("main", *(tag("section", tag("h2", head), content, id=key) for key, head, content in there)),
    )
    head = tag(
        "head",
        tag("meta", charset="utf-8"),
        tag("meta", http_equiv="Content-Security-Policy", content=POLICY),
        tag("meta", name="viewport", content="width=device-width, initial-scale=1"),
        tag("title", title),
        tag("style", Markup(CSS)),
    )
    return join(Markup("<!DOCTYPE html>\n"), tag("html", head, body, lang="en"), Markup("\n"))


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'s' * (number != 1)}"
