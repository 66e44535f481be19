"""`python -m experiments.page`: the claims in docs/paper.md and their figure, from the data in experiments/results.

Writes the tables between the marks `<!-- NAME: made by experiments.page -->` and `<!-- end -->`, and nothing else of
the page; claims.png has the paper's claims as standardized differences. A claim that has no data at the paper's size
has those of the small runs, and says so.
"""

import dataclasses
import os
from collections.abc import Iterator, Sequence
from pathlib import Path

from experiments import (
    ablation,
    claims_figure,
    collecting,
    critics,
    cross_play,
    cross_play_data,
    machine_time,
    markdown,
    robots,
    target_speed,
    verdict,
)
from experiments import study as studies
from experiments.all import STUDIES
from experiments.claims_figure import SHORT
from experiments.collecting import Data
from experiments.study import RESULTS, Study
from experiments.tidy import Table
from experiments.verdict import Claim
from matd3_jax import config
from matd3_jax.cli import command
from matd3_jax.cli.options import Command, option
from matd3_jax.errors import UserError
from matd3_jax.runtime import files
from matd3_jax.runtime.terminal import say
from matd3_jax.stats.text import NOTHING

DOCS = Path(__file__).parents[1] / "docs"
OURS: dict[str, Study] = {module.STUDY.name: module.STUDY for module in (target_speed, robots, ablation, critics)}
"""Studies of questions of ours, which are in the page where they have data."""
END = "<!-- end -->"


@dataclasses.dataclass(frozen=True)
class PageOptions:
    """Options of the page."""

    results: Path = option("folder of the results of each experiment", default=RESULTS)
    page: Path = option("the page", default=DOCS / "paper.md", new_file=True)
    figure: Path = option("the figure", default=DOCS / "images" / "claims.png", new_file=True)


COMMAND = Command("python -m experiments.page", PageOptions, __doc__)


@dataclasses.dataclass(frozen=True)
class Entry:
    """A claim with where it comes from.

    Attributes:
        study: name of the experiment.
        short: the claim in a few words.
        size: seeds and env steps in words, and what the paper has.
        small: whether the data are not those of the paper's size.
        folder: of the data.
        figure: name of the figure in it.
    """

    study: str
    short: str
    claim: Claim
    size: str = NOTHING
    small: bool = False
    folder: Path | None = None
    figure: str = ""


def main(argv: Sequence[str]) -> int:
    options = COMMAND.parse(argv)
    try:
        text = options.page.read_text(encoding="utf-8")
    except OSError as error:
        raise UserError(f"page={options.page}: {error.strerror}") from error
    if not options.results.is_dir():
        raise UserError(f"results={options.results}: there is no such folder")
    paper = [entry for one in STUDIES.values() for entry in entries(one, options.results)]
    ours = [entry for one in OURS.values() for entry in entries(one, options.results) if entry.folder]
    ours += strangers(options.results)
    where = options.page.parent
    hours = machine_time.hours(data.facts for data in _all_data(options.results))
    blocks = {
        "claims": [counts(paper, hours), "", *table(paper, where)],
        "ours": table(ours, where) if ours else ["No data yet."],
    }
    for name, lines in blocks.items():
        text = replaced(text, name, lines, options.page)
    if any(entry.folder for entry in paper):
        claims_figure.draw([(e.study, e.short, e.claim, e.small) for e in paper], options.figure)
    files.write_text(options.page, text)
    say(f"{counts(paper, hours)}\npage: {options.page}\nfigure: {options.figure}")
    return 0


# ---- claims ----------------------------------------------------------------------------------------------------------


def entries(one: Study, results: Path) -> list[Entry]:
    """The claims of an experiment, each from the data of the paper's size or else from the small ones."""
    found = [Entry(one.name, short, claim) for short, claim in zip(shorts(one), one.claims(Table({})), strict=True)]
    for scale in ("small", "paper"):
        folder = results / studies.folders(one, one.options(scale=scale))[1].name
        data = collecting.read(folder / one.data, folder / "runs.json", one.keys)
        if not data.rows:
            continue
        size = _size(one, data, scale)
        for k, claim in enumerate(one.claims(data.finished)):
            if claim.difference is not None:
                found[k] = Entry(one.name, found[k].short, claim, size, scale == "small", folder, one.figure)
    return found


def shorts(one: Study) -> list[str]:
    """The claims of an experiment in a few words."""
    claims = one.claims(Table({}))
    return list(SHORT[one.name]) if one.name in SHORT else [claim.paper for claim in claims]


def strangers(results: Path) -> list[Entry]:
    """The claims of the cross-play that have data."""
    folder = results / "competitive"
    tasks = cross_play_data.read(*(folder / name for name in cross_play.FILES))
    found = []
    for env in tasks:
        runs = tasks[env].facts["runs"].values()
        size = f"{_range([len(run['seeds']) for run in runs])} seeds of each pairing x "
        size += f"{_millions([run['checkpoint'] for run in runs])} million env steps"
        for claim in cross_play.claims({env: tasks[env]}):
            if claim.difference is not None:
                found.append(Entry("cross_play", claim.paper, claim, size, False, folder, "cross_play.png"))
    return found


def _size(one: Study, data: Data, scale: str) -> str:
    """Seeds and env steps of the finished settings, and those of the paper's protocol where they differ."""
    paper = {label: config.load(line) for label, line in one.settings("paper", one.options()).items()}
    labels = [label for label in data.rows if not data.unfinished(label)]
    seeds = [len(data.seeds(label)) for label in labels]
    steps = [float(data.rows[label]["step"].max()) for label in labels]
    protocol = [paper[label] for label in labels if label in paper]
    text = f"{_range(seeds)} seeds"
    wanted = {one.seeds for one in protocol}
    if wanted and wanted != set(seeds):
        text += f" (protocol: {_range(sorted(wanted))})"
    text += f" x {_millions(steps)} million env steps"
    total = {one.total_steps for one in protocol}
    if total and min(steps) < 0.99 * max(total):
        text += f" (protocol: {_millions(sorted(total))})"
    envs = {str(data.facts[label]["settings"]["env"]["name"]) for label in labels}
    if scale == "small" and not envs <= {str(one.env["name"]) for one in paper.values()}:
        text += f"; {', '.join(sorted(envs))}"
    return text


def _range(numbers: Sequence[float]) -> str:
    low, high = min(numbers), max(numbers)
    return f"{low:g}" if low == high else f"{low:g} to {high:g}"


def _millions(steps: Sequence[float]) -> str:
    return _range([float(f"{one / 1e6:.2g}") for one in steps])


def _all_data(results: Path) -> Iterator[Data]:
    """The data of every experiment of the page, whatever their size."""
    for one in [*STUDIES.values(), *OURS.values()]:
        for scale in ("small", "paper"):
            folder = results / studies.folders(one, one.options(scale=scale))[1].name
            yield collecting.read(folder / one.data, folder / "runs.json", one.keys)


# ---- Markdown --------------------------------------------------------------------------------------------------------


def counts(found: Sequence[Entry], hours: float) -> str:
    """How many claims have each verdict, in a sentence."""
    words = ("same", "opposite", "not shown", "not yet run")
    numbers = {word: sum(entry.claim.verdict == word for entry in found) for word in words}
    said = ", ".join(f"{number} *{word}*" for word, number in numbers.items() if number)
    return f"{len(found)} claims: {said}. All runs together took {hours:.1f} hours."


def table(found: Sequence[Entry], where: Path) -> list[str]:
    """A Markdown table for a page in the folder `where`."""
    head = ("the claim", "measured", "size", "found: difference (95 % interval)", "verdict", "")
    rows = []
    for entry in found:
        claim, links, words = entry.claim, NOTHING, NOTHING
        if claim.difference is not None and entry.folder is not None:
            words = verdict.in_words(claim)
            file = "cross_play.md" if entry.study == "cross_play" else "table.md"
            links = (
                f"[table]({_link(entry.folder / file, where)}), [figure]({_link(entry.folder / entry.figure, where)})"
            )
        rows.append((claim.paper, claim.quantity, entry.size, words, f"**{claim.verdict}**", links))
    return markdown.table(head, rows)


def _link(path: Path, where: Path) -> str:
    return Path(os.path.relpath(path.resolve(), where.resolve())).as_posix()


def replaced(text: str, name: str, lines: Sequence[str], page: Path) -> str:
    """The page with these lines between the marks of `name`. Raises UserError where the marks are not there once."""
    mark = f"<!-- {name}: made by experiments.page -->"
    before, found, rest = text.partition(mark)
    _, end, after = rest.partition(END)
    if not found or not end or mark in rest:
        raise UserError(f"{page}: the marks {mark} and {END} must be there once")
    return "\n".join([before + mark, "", *lines, "", END + after])


if __name__ == "__main__":
    command.run(main, COMMAND)
