"""What the experiments share: options, training what is missing, reuse of data, and the report.

A study names its settings; each becomes an ordinary run directory under `runs`, then rows of a tidy table in `out`. The
figure and the claims are made from that table alone, so they can be made again at once, and without any run
directories.
"""

import dataclasses
import fnmatch
import functools
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from experiments import collecting, estimating, machine_time, verdict
from experiments.collecting import Data
from experiments.estimating import Estimator
from experiments.tidy import Table
from experiments.verdict import Claim
from matd3_jax import config
from matd3_jax.cli.command import line as line_to_copy
from matd3_jax.cli.options import Command, asks_for_help, key, option, others
from matd3_jax.config import Config
from matd3_jax.config.diff import text
from matd3_jax.errors import UserError
from matd3_jax.runs.paths import check_directory
from matd3_jax.runtime import devices, files
from matd3_jax.runtime.terminal import say
from matd3_jax.sweep import batching, runner
from matd3_jax.sweep.runner import Stopped

RESULTS = Path(__file__).parent / "results"


@dataclasses.dataclass(frozen=True)
class StudyOptions:
    """Options of every study."""

    scale: str = option(
        "the paper's protocol, or one that takes minutes on a laptop", default="paper", choices=("paper", "small")
    )
    seeds: int | None = option("trials of each setting", default=None, least=1, otherwise="the scale's")
    train: bool = option("false: report what there is", default=True)
    estimate: bool = option(
        "true: print what is missing, how long it would take here (measured in a minute) and its memory; write nothing",
        default=False,
    )
    only: str | None = option(
        "train only the settings whose names match, for instance only='*maddpg*'", default=None, metavar="PATTERN"
    )
    at_once: int | None = option(
        "seeds of each setting that are trained, and their data written, before the next ones; what a stop loses is "
        "no more than that",
        default=None, least=1, otherwise="all",
    )  # fmt: skip
    runs: Path | None = option("run directories", default=None, otherwise="runs/experiments/NAME, or NAME_small")
    out: Path | None = option(
        "data, figure and table", default=None, otherwise="experiments/results/NAME, or NAME_small"
    )
    overrides: tuple[str, ...] = others("any other setting of matd3_jax.train, for all settings of the study")


@dataclasses.dataclass(frozen=True)
class Study:
    """One experiment of the paper.

    Attributes:
        help: what the command says with --help.
        protocol: the paper's protocol in a sentence or two, with what it leaves open.
        settings: (scale, options) -> for each setting by label the overrides of `matd3_jax.train`.
        keys: columns that distinguish the settings, and where each stands in the resolved settings.
        claims: what the paper found and what we found, from the rows of finished settings.
        draw: draws the figure from all rows into a file.
        details: lines of Markdown under the claims, from all rows.
        keep: patterns of the metrics to keep.
        points: rows of each seed's curve that are kept, besides the last 1,000 episodes.
        evaluations: keep the rows with an evaluation only.
        options: `StudyOptions`, or a subclass with options of its own.
        check: raises UserError for options that do not go together.
        folders: (options) -> name of the folders under runs/experiments and experiments/results; default: NAME,
            NAME_small.
        beside: (options) -> names of other studies' folders beside the results, whose rows of the same settings are
            taken over, each with the `keys` of its study.
        data, figure: names of those files.
    """

    name: str
    title: str
    help: str
    protocol: str
    settings: Callable[[str, Any], dict[str, list[str]]]
    keys: Mapping[str, str]
    claims: Callable[[Table], list[Claim]]
    draw: Callable[[Table, Path], None]
    details: Callable[[Table], list[str]]
    keep: tuple[str, ...] = ("return_*",)
    points: int = 120
    evaluations: bool = False
    options: type[StudyOptions] = StudyOptions
    check: Callable[[Any], None] = lambda options: None
    folders: Callable[[Any], tuple[Path, Path]] | None = None
    beside: Callable[[Any], Mapping[str, Mapping[str, str]]] = lambda options: {}
    data: str = "data.csv"
    figure: str = "figure.png"

    @property
    def command(self) -> Command[StudyOptions]:
        """How it is called."""
        program = f"python -m experiments.{self.name}"
        return Command(program, self.options, self.help, examples=(f"{program} scale=small",))


of_evaluations = functools.partial(Study, keep=("eval_*",), evaluations=True, data="curves.csv", figure="curves.png")
"""A study whose curves are deterministic evaluations along training."""


def main(study: Study, argv: Sequence[str]) -> int:
    """Run a study's command; the exit code."""
    if asks_for_help(argv):
        say(study.command.help())
        return 0
    if parse(study, argv).estimate:
        estimate(study, argv, Estimator())
        return 0
    try:
        claims = run(study, argv)
    except Stopped as stopped:
        return stopped.code
    if claims is None:
        raise UserError("there is no run to report")
    return 0


@dataclasses.dataclass(frozen=True)
class Plan:
    """What a call of a study asks for, and what there is already.

    Attributes:
        folder: of the run directories.
        out: where the results are.
        wanted: the settings by label.
        missing: what of them is to be trained: by name of a run (label, seeds) the label and the settings.
        adopted: whether `data` has rows of another study that are not written yet.
    """

    options: Any
    folder: Path
    out: Path
    data: Data
    wanted: dict[str, Config]
    missing: dict[str, tuple[str, Config]]
    adopted: bool

    @property
    def settings(self) -> dict[str, Config]:
        """Of all runs that are missing, by name."""
        return {name: settings for name, (_, settings) in self.missing.items()}

    def rounds(self) -> list[dict[str, Config]]:
        """The missing runs by what is trained one after the other: of each setting one."""
        found: list[dict[str, Config]] = []
        number: dict[str, int] = {}
        for name, (label, settings) in self.missing.items():
            number[label] = number.get(label, -1) + 1
            found += [{}] if number[label] == len(found) else []
            found[number[label]][name] = settings
        return found

    @classmethod
    def of(cls, study: Study, argv: Sequence[str]) -> "Plan":
        """Read the arguments, check them and the directories, and read the data. Raises UserError."""
        options = parse(study, argv)
        folder, out = folders(study, options)
        for name, path in (("runs", folder), ("out", out)):
            check_directory(path, name)
        devices.prepare()
        wanted = _wanted(study, options)
        data = collecting.read(*_files(study, out), study.keys)
        there = study.beside(options).items()
        others = [collecting.read(*_files(study, out.parent / name), keys) for name, keys in there]
        adopted = any([data.adopt(other, wanted) for other in others])
        missing: dict[str, tuple[str, Config]] = {}
        if options.train:
            chosen = [label for label in wanted if fnmatch.fnmatch(label, options.only or "*")]
            if not chosen:
                raise UserError(f"only={options.only}: matches none of {', '.join(wanted)}")
            for label in chosen:
                missing |= _runs(label, wanted[label], data, options.at_once)
            for name, (_, settings) in missing.items():
                if (folder / "runs" / name / "config.yaml").exists():
                    collecting.check(folder / "runs" / name, settings)
        return cls(options, folder, out, data, wanted, missing, adopted)


def _runs(label: str, wanted: Config, data: Data, at_once: int | None) -> dict[str, tuple[str, Config]]:
    """What is to be trained of a setting: by name its label and settings with some of the seeds."""
    most, found = at_once or wanted.seeds, {}
    for begin, length in batching.consecutive(data.missing(label, wanted), wanted.seeds):
        for first in range(begin, begin + length, most):
            number = min(most, begin + length - first)
            name = label if number == wanted.seeds else f"{label}-seeds_{first}_to_{first + number - 1}"
            found[name] = label, dataclasses.replace(wanted, seed=first, seeds=number)
    return found


def _files(study: Study, out: Path) -> tuple[Path, Path]:
    return out / study.data, out / "runs.json"


def estimate(study: Study, argv: Sequence[str], estimator: Estimator) -> tuple[int, float]:
    """Print what a call would train and how long it would take; (env steps of all seeds, seconds). Writes nothing."""
    plan = Plan.of(study, argv)
    left = len({label for label, _ in plan.missing.values()})
    say(f"{study.title}: {left} of {len(plan.wanted)} settings to train, {len(plan.wanted) - left} not")
    return estimating.report(estimating.planned(plan.settings, plan.folder), estimator)


def run(study: Study, argv: Sequence[str]) -> list[Claim] | None:
    """Train what is missing, collect, report; the claims, or None if there are no data at all.

    Raises UserError for options and directories that will not do, Stopped when a signal ended the training.
    """
    plan = Plan.of(study, argv)
    data, out, files = plan.data, plan.out, _files(study, plan.out)
    command = line_to_copy(f"experiments.{study.name}", *_recorded(argv))
    how = {"keep": study.keep, "points": study.points, "evaluations": study.evaluations}

    def offer(label: str, found: Sequence[Path]) -> bool:
        return bool(found) and data.offer(label, *collecting.gather(study.keys, found, command, **how))

    def write() -> None:
        out.mkdir(parents=True, exist_ok=True)
        collecting.write(data, *files)

    if plan.adopted:
        write()
    for settings in plan.rounds():
        trained = runner.train(settings, plan.folder)
        if any([offer(plan.missing[name][0], paths) for name, paths in trained.items()]):
            write()
    others = {label: settings for label, settings in plan.wanted.items() if not data.has(label, settings)}
    if any([offer(label, collecting.find(plan.folder, label, one)) for label, one in others.items()]):
        write()
    data = collecting.read(*files, study.keys)  # the report is made of what is written
    if not data.rows:
        return None
    return report(study, data, out, plan.options)


def report(study: Study, data: Data, out: Path, options: StudyOptions) -> list[Claim]:
    """Figure and table from the data; the claims."""
    study.draw(data.table, out / study.figure)
    claims = study.claims(data.finished)
    lines = [f"# {study.title}", "", study.protocol, ""]
    lines += [*departures(study, data, options), *verdict.lines(claims), "", verdict.DEFINITIONS, ""]
    lines += [*study.details(data.table), "", *machine_time.lines(data.facts), f"![{study.title}]({study.figure})"]
    files.write_text(out / "table.md", "\n".join(lines) + "\n")
    say("\n".join(lines[:-2]))
    return claims


def departures(study: Study, data: Data, options: StudyOptions) -> list[str]:
    """Lines on where what was run departs from the paper's protocol, and what is not finished."""
    lines: dict[str, list[str]] = {}
    for name, value in (("env", None), ("quick_targets", False)):  # the paper's own
        options = dataclasses.replace(options, **{name: value}) if hasattr(options, name) else options
    paper = study.settings("paper", options)
    for label, fact in data.facts.items():
        differences = []
        if label in paper:
            protocol = _load(tuple(paper[label]))
            other = collecting.differences(fact["settings"], protocol.to_dict())
            other = {key: pair for key, pair in other.items() if not key.startswith("adversary.")} or other
            differences += [f"{key} {text(was)} ({text(asked)})" for key, (was, asked) in other.items()]
            seeds = len(data.seeds(label))
            differences += [f"seeds {seeds} ({protocol.seeds})"] if seeds != protocol.seeds else []
        if differences:
            lines.setdefault(", ".join(differences), []).append(label)
    found = []
    for what, labels in lines.items():
        who = "" if len(labels) == len(data.facts) else f" ({', '.join(labels)})"
        found.append(f"Departs from the paper's protocol{who}: {what}. In brackets: the protocol's.")
    found += [f"Not finished: {label}." for label in data.facts if data.unfinished(label)]
    missing = [label for label in paper if label not in data.facts]
    if missing:
        found.append(f"Not yet run: {', '.join(missing)}.")
    return [line for text in found for line in (text, "")]


# ---- options ---------------------------------------------------------------------------------------------------------


def parse(study: Study, argv: Sequence[str]) -> StudyOptions:
    """The options of a study. Raises UserError."""
    options = study.command.parse(argv)
    study.check(options)
    return options


def _overrides(options: StudyOptions) -> list[str]:
    """What all settings of the study have in the place of their own."""
    return [*options.overrides, *([] if options.seeds is None else [f"seeds={options.seeds}"])]


def folders(study: Study, options: StudyOptions) -> tuple[Path, Path]:
    """(folder of the run directories, folder of the results)."""
    name = study.name if options.scale == "paper" else f"{study.name}_small"
    folder, out = study.folders(options) if study.folders else (Path("runs/experiments") / name, RESULTS / name)
    return options.runs or folder, options.out or out


def _wanted(study: Study, options: StudyOptions) -> dict[str, Config]:
    """The study's settings by label. Raises UserError for overrides that it does not take."""
    overrides = _overrides(options)
    lines = _checked(study, options, overrides)
    known = study.command.keys
    return {label: _load(tuple(config.merge(line, overrides)), known) for label, line in lines.items()}


def _checked(study: Study, options: StudyOptions, overrides: Sequence[str]) -> dict[str, list[str]]:
    """The study's settings. Raises UserError for overrides that they leave no room for."""
    lines = study.settings(options.scale, options)
    settings = [{key(text): text for text in line} for line in lines.values()]
    varied = {name for line in settings for name in line if len({other.get(name) for other in settings}) > 1}
    for override in config.parse(overrides):
        name = override.key_or_group
        if name in ("name", "resume", "checkpoint"):
            raise UserError(f"cannot take {name}= here: the study names its runs and resumes them by itself")
        if name in varied:
            raise UserError(f"cannot take {name}= here: the study itself varies it (only=PATTERN trains a part)")
    return lines


def check_some(studies: Iterable[Study], overrides: Sequence[str]) -> None:
    """Raise UserError for a setting that none of the studies takes, such as a misspelled option of theirs."""
    errors = []
    for study in studies:
        try:
            _wanted(study, parse(study, overrides))
            return
        except UserError as error:
            errors.append(error)
    raise errors[0]


def key_values(keys: Mapping[str, str], line: Sequence[str]) -> dict[str, Any]:
    """The values of a setting's columns, from its overrides."""
    return collecting.key_values(keys, _load(tuple(line)).to_dict())


@functools.cache
def _load(overrides: tuple[str, ...], known: tuple[str, ...] = ()) -> Config:
    return config.load(overrides, known)


def _recorded(argv: Sequence[str]) -> list[str]:
    """The arguments worth recording: not where files are."""
    return [text for text in argv if key(text) not in ("runs", "out", "train")]
