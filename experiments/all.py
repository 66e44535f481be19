"""`python -m experiments.all`: every experiment of the paper, one after another, and a summary of all claims.

Takes the options of the single experiments and gives them to each. Whatever is finished is used as it is, so a call
that was stopped resumes with the same command. `runs` and `out` are folders of folders here, one for each experiment;
the summary is summary.md (summary_small.md) in `out`. `skip` leaves experiments out. An experiment that cannot be run
(no memory, a setting that it does not take) is reported in the summary, and the next one follows.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from experiments import (
    ant,
    competitive,
    cooperative,
    grid_search,
    number_of_agents,
    overestimation,
    policy_delay,
    study,
    target_smoothing,
    verdict,
)
from experiments.estimating import Estimator
from experiments.study import RESULTS, Stopped, Study, StudyOptions
from experiments.tidy import Table
from matd3_jax.cli import command
from matd3_jax.cli.options import Command, option, others
from matd3_jax.errors import UserError, nearest
from matd3_jax.runs.paths import check_directory
from matd3_jax.runtime import files
from matd3_jax.runtime.terminal import say
from matd3_jax.training import cost

STUDIES: dict[str, Study] = {
    module.STUDY.name: module.STUDY
    for module in (
        cooperative,
        overestimation,
        competitive,
        policy_delay,
        target_smoothing,
        number_of_agents,
        grid_search,
        ant,
    )
}
"""In this order: first what the paper's main claims are about, last what takes longest."""


EACH_STUDY = 20.0
"""Seconds more for measuring with each experiment that is estimated."""


@dataclasses.dataclass(frozen=True)
class AllOptions:
    """Options of all experiments together."""

    skip: tuple[str, ...] = option("experiments to leave out", default=(), metavar="[NAME,NAME,...]")
    runs: Path | None = option("a folder for the run directories of each", default=None, otherwise="theirs")
    out: Path = option("a folder for the results of each, and the summary", default=RESULTS)
    rest: tuple[str, ...] = others("an option of all single experiments (scale=, seeds=, ...), or a setting of all")


COMMAND = Command("python -m experiments.all", AllOptions, __doc__, examples=("python -m experiments.all scale=small",))


def main(argv: Sequence[str]) -> int:
    given = COMMAND.parse(argv)
    for name in given.skip:
        if name not in STUDIES:
            raise UserError(f"skip={name}: there is no experiment {name!r}; {nearest(name, STUDIES)}")
    check_directory(given.out, "out")
    chosen = {name: one for name, one in STUDIES.items() if name not in given.skip}
    parsed = {name: study.parse(one, given.rest) for name, one in chosen.items()}
    study.check_some(chosen.values(), given.rest)
    if any(options.estimate for options in parsed.values()):
        return _estimate(chosen, parsed, given)
    lines: list[str] = []
    failed = 0
    for name, one in chosen.items():
        out_folder, more = _places(one, parsed[name], given)
        say(f"\n==== {name}")
        lines += [f"## {one.title}", ""]
        try:
            claims = study.run(one, [*given.rest, *more])
            lines += verdict.lines(one.claims(Table({})) if claims is None else claims)
            lines += [] if claims is None else ["", f"[Protocol, all values, figure]({out_folder.name}/table.md)"]
        except UserError as error:
            say(f"error: {error}")
            lines += [*verdict.lines(one.claims(Table({}))), "", f"Could not be run: {error}"]
            failed = 2
        except Stopped as stopped:
            say("stopped; resume with the same command")
            return stopped.code
        lines.append("")
    small = any(options.scale == "small" for options in parsed.values())
    head = ["# The paper's claims, one by one" + (" (small runs)" if small else ""), "", verdict.DEFINITIONS, ""]
    given.out.mkdir(parents=True, exist_ok=True)
    summary = given.out / ("summary_small.md" if small else "summary.md")
    files.write_text(summary, "\n".join([*head, *lines]).rstrip() + "\n")
    say(f"\nsummary: {summary}")
    return failed


def _places(one: Study, options: StudyOptions, given: AllOptions) -> tuple[Path, list[str]]:
    """(folder of an experiment's results, its arguments that say where everything is)."""
    runs_folder, out_folder = study.folders(one, options)
    more = [f"out={given.out / out_folder.name}"]
    return out_folder, more + ([] if given.runs is None else [f"runs={given.runs / runs_folder.name}"])


def _estimate(chosen: dict[str, Study], parsed: dict[str, StudyOptions], given: AllOptions) -> int:
    """What all experiments lack, each measured a while, and the total: the exit code."""
    estimator, steps, seconds, failed = Estimator(0.0), 0, 0.0, 0
    for name, one in chosen.items():
        say(f"\n==== {name}")
        estimator.seconds += EACH_STUDY
        try:
            found = study.estimate(one, [*given.rest, *_places(one, parsed[name], given)[1]], estimator)
            steps, seconds = steps + found[0], seconds + found[1]
        except UserError as error:
            say(f"error: {error}")
            failed = 2
    say(f"\nall: {steps:,} env steps, {cost.duration(seconds)}")
    return failed


if __name__ == "__main__":
    command.run(main, COMMAND)
