"""`python -m experiments.number_of_agents`: does relative overestimation change with the number of agents?

The paper reports it in one sentence, without a figure. Cooperative Navigation with 2 to 6 agents, MADDPG and MATD3.
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from scipy import stats

from experiments import figures, markdown, overestimation, study, verdict
from experiments.overestimation import beyond, last_two_thirds, measured
from experiments.study import Study, StudyOptions
from experiments.tidy import Table
from experiments.verdict import Claim
from matd3_jax.cli import command

ALGOS = ("maddpg", "matd3")
NUMBERS = {"paper": (2, 3, 4, 5, 6), "small": (2, 3, 4)}
MARGIN = 0.025
"""Change of the relative overestimation with each agent more that counts as none: a tenth of the true value from 2 to
6."""

SCALES = {
    "paper": ["seeds=5", "total_steps=1500000", "log_every=12500", "eval_every=50000"],
    "small": ["seeds=3", "total_steps=200000", "log_every=5000", "eval_every=20000"],
}


def settings(scale: str, options: StudyOptions) -> dict[str, list[str]]:
    common = ["env=simple_spread", "env.episode_length=200", *SCALES[scale], "diagnostics.q_bias=true"]
    return {
        f"simple_spread{number}-{algo}": [*common, f"env.num_agents={number}", f"algo={algo}", "keep_checkpoints=1"]
        for number in NUMBERS[scale]
        for algo in ALGOS
    }


def relative(table: Table, algo: str) -> dict[int, np.ndarray]:
    """For each number of agents (estimate - true value) / |true value|, [seeds]: means over agents and evaluations
    after the first update, the quotient of the means."""

    def of(part: Table) -> np.ndarray | None:
        values = measured(part)
        if values is None:
            return None
        _, estimate, truth = values
        return (estimate - truth).mean(axis=1) / np.abs(truth).mean(axis=1)

    return _by_number(table, algo, of)


def relative_beyond(table: Table, algo: str) -> dict[int, np.ndarray]:
    """`relative` over the last two thirds of training, without what the targets' slow start explains."""

    def of(part: Table) -> np.ndarray | None:
        values, rest = measured(part), beyond(part)
        if values is None or rest is None:
            return None
        return rest / np.abs(last_two_thirds(values[2])).mean(axis=1)

    return _by_number(table, algo, of)


def _by_number(table: Table, algo: str, of: Callable[[Table], np.ndarray | None]) -> dict[int, np.ndarray]:
    """What `of` makes of the rows of each number of agents, where it makes something."""
    numbers = [int(number) for number in table.values("num_agents")]
    found = {number: of(table.where(algo=algo, num_agents=number)) for number in numbers}
    return {number: values for number, values in found.items() if values is not None}


def claims(table: Table) -> list[Claim]:
    paper = "no significant difference in relative overestimation between numbers of agents"
    change = "change with each agent more"
    ours = f"{change}, last two thirds, without the lag"
    found = [_claim(paper, f"{figures.NAMES[algo]}: {change}", relative(table, algo)) for algo in ALGOS]
    for algo in ALGOS:  # not in the paper
        values = relative_beyond(table, algo)
        found.append(_claim(f"{paper}, beyond the targets' lag", f"{figures.NAMES[algo]}: {ours}", values))
    return found


def _claim(paper: str, quantity: str, values: Mapping[int, np.ndarray]) -> Claim:
    """No difference between numbers of agents. values: relative overestimation [seeds] of each."""
    if len(values) < 2:
        return Claim(paper, quantity, kind="no difference", margin=MARGIN)
    number = np.concatenate([np.full(len(v), n) for n, v in values.items()])
    over = np.concatenate(list(values.values()))
    words = ", ".join(f"{100 * v.mean():+.1f} % ({n} agents)" for n, v in values.items())
    if min(map(len, values.values())) > 1 and np.ptp(over) > 0:
        words += f"; all alike: p = {stats.kruskal(*values.values()).pvalue:.2g} (Kruskal and Wallis)"
    return Claim(paper, quantity, verdict.slope(number, over), "no difference", MARGIN, words)


def draw(table: Table, path: Path) -> None:
    figure, axes = figures.canvas(2, width=4.6)
    numbers = [int(number) for number in table.values("num_agents")]
    words = ("whole training", "last two thirds,\nwithout the targets' lag")
    for axis, how, title in zip(axes, (relative, relative_beyond), words, strict=True):
        for k, algo in enumerate(ALGOS):
            values = how(table, algo)
            for number, over in values.items():
                place = numbers.index(number) + 0.4 * (k - 0.5)
                figures.bar(axis, place, 100 * over, figures.COLORS[algo], width=0.36)
            if values:
                seeds = "/".join(sorted({str(len(v)) for v in values.values()}))
                axis.bar(0, 0, color=figures.COLORS[algo], alpha=0.75, label=f"{figures.NAMES[algo]} ({seeds} seeds)")
        axis.set_xticks(range(len(numbers)), list(map(str, numbers)))
        axis.axhline(0, color="black", linewidth=0.8)
        axis.set_xlabel("agents")
        axis.set_title(title)
    axes[0].set_ylabel("relative overestimation (%)")
    axes[0].set_ylim(top=1.3 * axes[0].get_ylim()[1])  # room for the legend
    axes[0].legend(frameon=False, loc="upper left")
    figures.save(figure, path)


def details(table: Table) -> list[str]:
    over = "relative overestimation (95 % interval)"
    head = ("algorithm", "agents", "seeds", "env steps", over, "the same, last two thirds, without the lag")
    rows = []
    for algo in ALGOS:
        rest = relative_beyond(table, algo)
        for number, values in relative(table, algo).items():
            steps = table.where(algo=algo, num_agents=number).by_seed("step")[0, -1]
            cells = [figures.NAMES[algo], str(number), str(len(values)), f"{steps:,.0f}", figures.interval(values)]
            rows.append([*cells, figures.interval(rest.get(number))])
    return markdown.table(head, rows)


STUDY = Study(
    name="number_of_agents",
    title="Overestimation and the number of agents",
    help=str(__doc__),
    protocol="The paper compared the relative overestimation for several numbers of agents and says no more; here the "
    "protocol of the overestimation experiment (episodes of 200 steps, 5 runs, an evaluation every 50,000 of 1.5 "
    "million env steps) with 2 to 6 agents and as many landmarks. Relative overestimation: (estimate - true value) / "
    "|true value|, means over agents and over all evaluations after the first update. The change with the number of "
    "agents is the slope of a least-squares line over all seeds. The lag is what is left of the critics' start at zero "
    "while the targets move (see the overestimation experiment).",
    settings=settings,
    keys={**overestimation.STUDY.keys, "num_agents": "env.num_agents"},
    claims=claims,
    draw=draw,
    details=details,
    points=60,
)


def main(argv: Sequence[str]) -> int:
    return study.main(STUDY, argv)


if __name__ == "__main__":
    command.run(main)
