"""`python -m experiments.grid_search`: the paper's grid of learning rate, minibatch and policy delay.

The paper names the grids and the best points, without a figure. task=particle (Cooperative Navigation, or another
env=): lr 0.01, 0.003, 0.001 x batch 256, 1000 x d 1, 2, 3. task=ant: lr 0.01, 0.003, 0.001 x batch 100, 300 x tau
0.005, 0.01."""

import dataclasses
import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from experiments import factorial, figures, markdown, study, tidy, verdict
from experiments.study import RESULTS, Study, StudyOptions
from experiments.tidy import Table
from experiments.verdict import Claim
from matd3_jax.cli import command
from matd3_jax.cli.options import option
from matd3_jax.errors import UserError
from matd3_jax.figures.style import SERIES
from matd3_jax.stats.text import ends, number

RATES = (0.01, 0.003, 0.001)
GRIDS = {
    "particle": {"algo.lr": RATES, "batch_size": (256, 1000), "algo.policy_delay": (1, 2, 3)},
    "ant": {"algo.lr": RATES, "batch_size": (100, 300), "algo.tau": (0.005, 0.01)},
}
KEYS = {"lr": "algo.actor_lr", "batch": "batch_size", "d": "algo.policy_delay", "tau": "algo.tau"}
SHORT = {"algo.lr": "lr", "batch_size": "batch", "algo.policy_delay": "d", "algo.tau": "tau"}
BEST = {"particle": {"lr": 0.01, "batch": 1000, "d": 2}, "ant": {"lr": 0.001, "batch": 100, "tau": 0.01}}
"""What the paper found to work best."""

SCALES = {
    ("particle", "paper"): ["env=simple_spread", "seeds=4", "total_steps=1500000", "log_every=12500", "eval_every=0"],
    ("particle", "small"): ["env=simple_spread", "seeds=2", "total_steps=150000", "log_every=3000", "eval_every=0"],
    ("ant", "paper"): ["env=ant", "recipe=paper", "seeds=3"],
}


@dataclasses.dataclass(frozen=True)
class GridOptions(StudyOptions):
    """Options of this study."""

    task: str = option("whose grid: Cooperative Navigation's, or the Ant's", default="particle", choices=tuple(GRIDS))


def settings(scale: str, options: GridOptions) -> dict[str, list[str]]:
    task = options.task
    grid = GRIDS[task]
    common = ["algo=matd3", *SCALES[task, scale], "keep_checkpoints=1"]
    return {
        "-".join(f"{SHORT[key]}{value}" for key, value in zip(grid, point, strict=True)): [
            *common,
            *(f"{key}={value}" for key, value in zip(grid, point, strict=True)),
        ]
        for point in itertools.product(*grid.values())
    }


def check(options: GridOptions) -> None:
    if options.task == "ant" and options.scale == "small":
        raise UserError("task=ant scale=small: the Ant is not trained in minutes; use task=particle, or scale=paper")


def folders(options: GridOptions) -> tuple[Path, Path]:
    name = "grid_search" + ("_ant" if options.task == "ant" else "")
    name += "" if options.scale == "paper" else "_small"
    return Path("runs/experiments") / name, RESULTS / name


def ranking(table: Table) -> list[tuple[dict[str, float], np.ndarray, np.ndarray]]:
    """(point of the grid, final returns [seeds], mean returns over the whole training [seeds]), best final mean
    first."""
    points = dict.fromkeys(zip(*(table[key].tolist() for key in KEYS), strict=True)) if len(table) else {}
    found = []
    for values in points:
        point = dict(zip(KEYS, values, strict=True))
        part = table.where(**point)
        if robot(table):
            returns = part.by_seed("eval_return_agents")
            returns = returns[:, ~np.isnan(returns).any(axis=0)]
            found.append((point, returns[:, -1], returns.mean(axis=1)))
        else:
            final, along = tidy.final(part, "return_agents"), tidy.along(part, "return_agents")
            assert final is not None and along is not None
            found.append((point, final, along))
    return sorted(found, key=lambda one: -np.nan_to_num(one[1].mean(), nan=-np.inf))


def robot(table: Table) -> bool:
    """Whether this is the Ant's grid: judged by evaluations."""
    return "eval_return_agents" in table


def best(table: Table) -> dict[str, float]:
    """The paper's best point of this grid."""
    return BEST["ant" if robot(table) else "particle"]


def claims(table: Table) -> list[Claim]:
    wanted = best(table)
    name = ", ".join(f"{key} {value:g}" for key, value in wanted.items())
    paper = f"{name} was found to work best"
    ranks = ranking(table)
    rank = next((k for k, (point, *_) in enumerate(ranks) if _is(point, wanted)), None)
    if rank is None or len(ranks) < 2:
        return [Claim(paper, "final return: this setting minus the best other one")]
    other = ranks[1 if rank == 0 else 0]
    best_other = ", ".join(f"{key} {other[0][key]:g}" for key in wanted)
    more = f"; it ranks {rank + 1} of {len(ranks)} (to have picked the best of the others favors them)"
    return [verdict.compare(paper, "final return", (name, ranks[rank][1]), (best_other, other[1]), more=more)]


def _is(point: Mapping[str, float], wanted: Mapping[str, float]) -> bool:
    return all(point[key] == value for key, value in wanted.items())


def draw(table: Table, path: Path) -> None:
    ranks, wanted = ranking(table), best(table)
    figure, (axis,) = figures.canvas(1, width=6.2, height=1.2 + 0.27 * len(ranks))
    for k, (_, final, _) in enumerate(ranks):
        figures.point(axis, k, final, figures.COLORS["matd3"])
    labels = [", ".join(f"{key} {point[key]:g}" for key in wanted) for point, *_ in ranks]
    axis.set_yticks(range(len(ranks)), labels, fontsize=8)
    for k, (label, (point, *_)) in enumerate(zip(axis.get_yticklabels(), ranks, strict=True)):
        if _is(point, wanted):
            label.set_fontweight("bold")
            axis.axhspan(k - 0.45, k + 0.45, color=SERIES[1], alpha=0.25, linewidth=0)
    center = [final.mean() for _, final, _ in ranks]
    axis.set_ylim(len(ranks) - 0.4, -0.6)
    middle, reach = np.nanmedian(center), 1.3 * np.nanmax(np.abs(center - np.nanmedian(center))) + 1e-6
    axis.set_xlim(middle - 1.5 * reach, middle + 1.5 * reach)  # intervals of few seeds may reach far beyond
    axis.set_xlabel("final return, mean and 95 % interval (shaded: the paper's best)")
    axis.set_title("the Ant" if robot(table) else "MATD3")
    figures.save(figure, path)


def details(table: Table) -> list[str]:
    wanted = best(table)
    head = ("rank", *wanted, "seeds", "final return (95 % interval)", "mean return over the whole training")
    rows = []
    for k, (point, final, along) in enumerate(ranking(table)):
        cells = [str(k + 1), *(f"{point[key]:g}" for key in wanted), str(len(final)), figures.interval(final)]
        rows.append([*cells, figures.interval(along)])
    return [*markdown.table(head, rows), *effects(table)]


def effects(table: Table) -> list[str]:
    """A table of what each value of a setting does against the next smaller one, the others alike."""
    keys = list(best(table))
    cells = {tuple(point[key] for key in keys): final for point, final, _ in ranking(table)}
    rows = []
    for place, key in enumerate(keys):
        for a, b in factorial.neighbors([point[place] for point in cells]):
            found = factorial.effect(cells, place, a, b)
            if found is not None:
                numbers = f"{number(found.estimate)} ({ends(found.low, found.high)})"
                rows.append([f"{key} {a:g} minus {key} {b:g}", numbers, f"{found.p:.2g}"])
    if not rows:
        return []
    words = "Each setting against its next smaller value, mean over all points of the grid that differ in nothing else:"
    return ["", words, "", *markdown.table(("setting", "final return (95 % interval)", "p"), rows)]


STUDY = Study(
    name="grid_search",
    title="Grid search",
    help=str(__doc__),
    protocol="The paper chose lr 0.01, batch 1000, d 2 from lr 0.01, 0.003, 0.001 x batch 256, 1000 x d 1, 2, 3 for "
    "all particle tasks (here on Cooperative Navigation), and lr 0.001, batch 100, tau 0.01 from lr 0.01, 0.003, 0.001 "
    "x batch 100, 300 x tau 0.005, 0.01 for the Ant; it does not say with how many trials, or what it ranked by: here "
    "4 seeds (the Ant 3), by the mean return of the last 1,000 training episodes (a fifth of all in runs below 5,000; "
    "the Ant: by the last evaluation).",
    settings=settings,
    keys=KEYS,
    claims=claims,
    draw=draw,
    details=details,
    keep=("return_agents", "eval_return_agents"),
    points=60,
    options=GridOptions,
    check=check,
    folders=folders,
)


def main(argv: Sequence[str]) -> int:
    return study.main(STUDY, argv)


if __name__ == "__main__":
    command.run(main)
