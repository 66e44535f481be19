"""`python -m experiments.populations`: what population-based training reaches in less compute than random search.

Not in the paper. On Cooperative Navigation and the half-cheetah: random search over the learning rates and tau, and
population-based training (PBT) of the same draws with the same seeds and as many env steps; on Cooperative Navigation
also PBT whose selections begin after the first dip of the returns. Each seed is a population of its own. The best
member is compared, by deterministic evaluations: when has PBT's what random search's best ends with, and when has
random search it itself? The quotient of the two numbers of env steps is the compute that PBT needs. Whatever is
finished is used as it is, so a call that was stopped resumes with the same command.
"""

import dataclasses
import fnmatch
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.ticker import EngFormatter

from experiments import estimating, figures, markdown, verdict
from experiments.estimating import Batch, Estimator
from experiments.populations_data import METRIC, RANDOM, Data, best, compared, label, median_interval, ratios
from experiments.study import RESULTS
from experiments.verdict import Claim, Difference
from matd3_jax import config
from matd3_jax.cli import catalog, command, sweep
from matd3_jax.cli.options import Command, option, others
from matd3_jax.errors import UserError
from matd3_jax.figures.style import SERIES
from matd3_jax.runs.paths import check_directory
from matd3_jax.runtime import devices, files
from matd3_jax.runtime.terminal import say
from matd3_jax.stats.text import number

PBT, WITH_REPLAYS, LATER = "PBT", "PBT, replays copied", "PBT, begun later"
METHODS = {RANDOM: [], PBT: ["pbt=true"], WITH_REPLAYS: ["pbt=true", "pbt_replay=true"], LATER: ["pbt=true"]}
START = {"simple_spread": 60_000}
"""Env steps before the first selection of PBT that begins later: after the first dip of the returns."""

TASKS = {
    "simple_spread": [
        "env=simple_spread", "algo=matd3", "algo.actor_lr=interval(1e-4,1e-1)", "algo.critic_lr=interval(1e-4,1e-1)",
        "algo.tau=interval(1e-3,1e-1)", "eval_episodes=100",
    ],
    "half_cheetah": [
        "env=half_cheetah", "env.split=2x3", "algo=matd3", "recipe=fast", "algo.actor_lr=interval(1e-4,1e-2)",
        "algo.critic_lr=interval(1e-4,1e-2)", "algo.tau=interval(1e-3,5e-2)", "eval_episodes=5",
    ],
}  # fmt: skip
"""Search spaces, and how each task is trained."""

EVALUATIONS = 20
"""In a run; a selection after each."""


class Size(NamedTuple):
    """Members of a population, populations, env steps of each member."""

    members: int
    populations: int
    steps: int


SCALES = {
    "paper": {"simple_spread": Size(16, 10, 1_000_000), "half_cheetah": Size(10, 6, 500_000)},
    "small": {"simple_spread": Size(10, 6, 100_000), "half_cheetah": Size(5, 6, 40_000)},
}


@dataclasses.dataclass(frozen=True)
class PopulationOptions:
    """Options of the comparison."""

    scale: str = option("how large; small: some hours on two cores", default="paper", choices=tuple(SCALES))
    only: str | None = option("only the tasks whose names match", default=None, metavar="PATTERN")
    members: int | None = option("of a population", default=None, least=2, otherwise="the scale's")
    populations: int | None = option("how many, each a seed", default=None, least=1, otherwise="the scale's")
    steps: int | None = option("env steps of each member", default=None, least=1, otherwise="the scale's")
    replays: bool = option("true: also PBT that copies replays", default=False)
    train: bool = option("false: report what there is", default=True)
    estimate: bool = option(
        "true: print what is missing, and how long it would take here; write nothing", default=False
    )
    runs: Path | None = option("sweeps", default=None, otherwise="runs/experiments/populations, or populations_small")
    out: Path | None = option(
        "data, figure and table", default=None, otherwise="experiments/results/populations, or populations_small"
    )
    overrides: tuple[str, ...] = others("any other setting of matd3_jax.train, for all runs")


COMMAND = Command(
    "python -m experiments.populations", PopulationOptions, __doc__,
    examples=("python -m experiments.populations scale=small only=simple_spread",),
)  # fmt: skip


def main(argv: Sequence[str]) -> int:
    options = COMMAND.parse(argv)
    name = "populations" if options.scale == "paper" else "populations_small"
    folder, out = options.runs or Path("runs/experiments") / name, options.out or RESULTS / name
    for key, path in (("runs", folder), ("out", out)):
        check_directory(path, key)
    chosen = [task for task in TASKS if fnmatch.fnmatch(task, options.only or "*")]
    if not chosen:
        raise UserError(f"only={options.only}: matches none of {', '.join(TASKS)}")
    devices.prepare()
    data = Data.read(out)
    wanted = {(task, method): arguments(task, method, options) for task in chosen for method in methods(task, options)}
    missing = {key: line for key, line in wanted.items() if data.facts.get(label(*key)) != line}
    if options.estimate:
        estimating.report([batch(key, line) for key, line in missing.items()], Estimator())
        return 0
    for key, line in missing.items() if options.train else ():
        code = train(folder / label(*key), line)
        if code not in (0, command.DIVERGED):
            return code
        data.take(key, line, folder / label(*key))
        data.write(out)
    data = Data.read(out)  # the report is made of what is written
    if not data.values:
        raise UserError("there is nothing to report")
    report(data, out)
    return 0


def methods(task: str, options: PopulationOptions) -> list[str]:
    late = (1 - 1 / EVALUATIONS) * size(task, options).steps  # when the last selection comes
    chosen = {WITH_REPLAYS: options.replays, LATER: START.get(task, np.inf) <= late}
    return [name for name in METHODS if chosen.get(name, True)]


def size(task: str, options: PopulationOptions) -> Size:
    found = SCALES[options.scale][task]
    given = (options.members, options.populations, options.steps)
    return Size(*(own if one is None else one for own, one in zip(found, given, strict=True)))


def arguments(task: str, method: str, options: PopulationOptions) -> list[str]:
    """Of `matd3_jax.sweep`, but for where: the methods differ in nothing but what they are."""
    members, populations, steps = size(task, options)
    every = max(1, steps // EVALUATIONS)
    line = [*TASKS[task], f"samples={members}", f"seeds={populations}", f"total_steps={steps}", f"metric={METRIC}"]
    line += [f"log_every={every}", f"eval_every={every}", *METHODS[method]]
    line += [f"pbt_every={every}"] if METHODS[method] else []
    line += [f"pbt_start={START[task]}"] if method == LATER else []
    _check(task, options.overrides)
    return config.merge(line, options.overrides)


def _check(task: str, overrides: Sequence[str]) -> None:
    """Raise UserError for an override of what the experiment sets, and for what is no setting of the task's."""
    swept = {text.partition("=")[0] for line in TASKS.values() for text in line if "interval(" in text}
    own = {"seeds", "total_steps", "log_every", "eval_every", "name", "out", *swept}
    for override in config.parse(overrides):
        if override.key_or_group in own:
            raise UserError(f"cannot take {override.key_or_group}= here: the experiment sets it itself")
    fixed = [text for text in TASKS[task] if "interval(" not in text]
    config.load(config.merge(fixed, overrides), COMMAND.keys)


def batch(key: tuple[str, str], line: Sequence[str]) -> Batch:
    """What a sweep trains at once, for an estimate."""
    given = catalog.SWEEP.parse(line)
    settings = sweep.read(given.settings, given.samples, given.sample_seed)[1]
    name = label(*key)
    return Batch([dataclasses.replace(one, name=f"{name}/{member}") for member, one in settings.items()])


def train(place: Path, line: Sequence[str]) -> int:
    """Train a sweep to its end: the exit code. Raises UserError where another one is there."""
    where = [f"name={place.name}", f"out={place.parent}"]
    if not (place / "sweep.json").is_file():
        return sweep.main([*line, *where])
    if sweep.open_sweep(place)[1].get("command") != command.line("matd3_jax.sweep", *line, *where):
        raise UserError(f"{place} was begun with other settings: choose another runs=, or remove it")
    return sweep.main([f"resume={place}"])


# ---- telling ---------------------------------------------------------------------------------------------------------


def claims(data: Data) -> list[Claim]:
    found, there = [], compared(data)
    for task in TASKS:
        for method in METHODS:
            asked = method == PBT or (method == LATER and task in START)
            if method == RANDOM or not (asked or (task, method) in there):
                continue
            sooner = f"{figures.task(task)}: {method} reaches in less compute what random search reaches (ours)"
            share = "1 minus the ratio of env steps, median over populations"
            better = f"{figures.task(task)}: {method} ends with a better member than random search (ours)"
            final = f"best member at the end: {method} minus random search, within a population"
            if (task, method) not in there:
                found += [Claim(sooner, share), Claim(better, final)]
                continue
            ratio = ratios(data, task, method)
            middle, low, high = median_interval(ratio)
            words = f"ratio {number(middle)}; {np.isfinite(ratio).sum()} of {len(ratio)} populations reach it"
            found.append(Claim(sooner, share, Difference(1 - middle, 1 - high, 1 - low, np.nan), found=words))
            ours, theirs = (best(data.steps[task, m], data.values[task, m])[:, -1] for m in (method, RANDOM))
            words = f"{method} {number(ours.mean())}, {RANDOM} {number(theirs.mean())}"
            found.append(Claim(better, final, verdict.mean(ours - theirs), found=words))
    return found


def details(data: Data) -> list[str]:
    head = ("task", "method", "members", "populations", "env steps", "best at the end, median", "ratio of env steps")
    rows = []
    there = compared(data)
    for key, values in data.values.items():
        populations, members, _ = values.shape
        cells = [*key, str(members), str(populations), f"{data.steps[key][-1]:,}"]
        cells.append(number(float(np.median(best(data.steps[key], values)[:, -1]))))
        text = "1" if key[1] == RANDOM else "—"
        if key in there:
            middle, low, high = median_interval(ratios(data, *key))
            text = number(middle) + ("" if np.isnan(low) else f" ({number(low)} to {number(high)})")
        rows.append([*cells, text])
    return markdown.table(head, rows)


def report(data: Data, out: Path) -> None:
    """Figure and table from the data."""
    draw(data, out / "figure.png")
    lines = ["# Population-based training against random search", ""]
    lines += [
        "Both train the same random draws of learning rates and tau with the same seeds, each seed a population of its "
        "own, for the same env steps. A member's score: deterministic evaluations, mean over the last tenth of the "
        "run. *Ratio*: env steps at which the best member of PBT first has what the best of random search has at its "
        "end, divided by those at which random search's best first has it, for each population; the median, and in "
        "brackets its 95 % interval (order statistics; none below six populations). inf: never.",
        "",
        *verdict.lines(claims(data)),
        "",
        verdict.DEFINITIONS,
        "",
        *details(data),
        "",
        "![The best member along training](figure.png)",
    ]
    files.write_text(out / "table.md", "\n".join(lines) + "\n")
    say("\n".join(lines[:-2]))


def draw(data: Data, path: Path) -> None:
    """The best member of each population along training, and the median over populations."""
    tasks = list(dict.fromkeys(task for task, _ in data.values))
    figure, axes = figures.canvas(len(tasks), width=5.2, height=3.8)
    for axis, task in zip(axes, tasks, strict=True):
        for color, method in zip(SERIES, METHODS, strict=False):
            if (task, method) not in data.values:
                continue
            steps, curves = data.steps[task, method], best(data.steps[task, method], data.values[task, method])
            axis.plot(steps, curves.T, color=color, linewidth=0.5, alpha=0.4)
            axis.plot(steps, np.median(curves, axis=0), color=color, label=f"{method} ({len(curves)} populations)")
        axis.set_title(figures.task(task))
        axis.set_xlabel("env steps of each member")
        axis.xaxis.set_major_formatter(EngFormatter(sep=""))
        axis.set_ylabel("best member's evaluations, last tenth")
        axis.legend(frameon=False, loc="lower right")
    figures.save(figure, path)


if __name__ == "__main__":
    command.run(main, COMMAND)
