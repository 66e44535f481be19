"""`python -m experiments.number_of_agents`: does relative overestimation change with the number of agents?

The paper reports it in one sentence, without a figure. Cooperative Navigation with 2 to 6 agents, MADDPG and MATD3.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy import stats

from experiments import figures, markdown, study, verdict
from experiments.overestimation import measured
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
    found = {}
    for number in table.values("num_agents"):
        values = measured(table.where(algo=algo, num_agents=number))
        if values is not None:
            _, estimate, truth = values
            found[int(number)] = (estimate - truth).mean(axis=1) / np.abs(truth).mean(axis=1)
    return found


def claims(table: Table) -> list[Claim]:
    found = []
    for algo in ALGOS:
        name, values = figures.NAMES[algo], relative(table, algo)
        paper = "no significant difference in relative overestimation between numbers of agents"
        claim = Claim(paper, f"{name}: change with each agent more", kind="no difference", margin=MARGIN)
        if len(values) > 1:
            number = np.concatenate([np.full(len(v), n) for n, v in values.items()])
            over = np.concatenate(list(values.values()))
            words = ", ".join(f"{100 * v.mean():+.1f} % ({n} agents)" for n, v in values.items())
            if min(map(len, values.values())) > 1 and np.ptp(over) > 0:
                words += f"; all alike: p = {stats.kruskal(*values.values()).pvalue:.2g} (Kruskal and Wallis)"
            claim = Claim(paper, claim.quantity, verdict.slope(number, over), "no difference", MARGIN, words)
        found.append(claim)
    return found


def draw(table: Table, path: Path) -> None:
    figure, (axis,) = figures.canvas(1, width=5.2)
    for k, algo in enumerate(ALGOS):
        values = relative(table, algo)
        for position, number in enumerate(values):
            figures.bar(axis, position + 0.4 * (k - 0.5), 100 * values[number], figures.COLORS[algo], width=0.36)
        if values:
            seeds = "/".join(sorted({str(len(v)) for v in values.values()}))
            axis.bar(0, 0, color=figures.COLORS[algo], alpha=0.75, label=f"{figures.NAMES[algo]} ({seeds} seeds)")
    numbers = table.values("num_agents")
    axis.set_xticks(range(len(numbers)), [f"{number:g}" for number in numbers])
    axis.axhline(0, color="black", linewidth=0.8)
    axis.set_xlabel("agents")
    axis.set_ylabel("relative overestimation (%)")
    axis.set_title("Cooperative Navigation", pad=22)
    axis.legend(frameon=False, ncols=2, loc="lower center", bbox_to_anchor=(0.5, 0.98))
    figures.save(figure, path)


def details(table: Table) -> list[str]:
    head = ("algorithm", "agents", "seeds", "env steps", "relative overestimation (95 % interval)")
    rows = []
    for algo in ALGOS:
        for number, values in relative(table, algo).items():
            steps = table.where(algo=algo, num_agents=number).by_seed("step")[0, -1]
            rows.append([figures.NAMES[algo], str(number), str(len(values)), f"{steps:,.0f}", figures.interval(values)])
    return markdown.table(head, rows)


STUDY = Study(
    name="number_of_agents",
    title="Overestimation and the number of agents",
    help=str(__doc__),
    protocol="The paper compared the relative overestimation for several numbers of agents and says no more; here the "
    "protocol of the overestimation experiment (episodes of 200 steps, 5 runs, an evaluation every 50,000 of 1.5 "
    "million env steps) with 2 to 6 agents and as many landmarks. Relative overestimation: (estimate - true value) / "
    "|true value|, means over agents and over all evaluations after the first update. The change with the number of "
    "agents is the slope of a least-squares line over all seeds.",
    settings=settings,
    keys={"env": "env.name", "algo": "algo.name", "num_agents": "env.num_agents"},
    claims=claims,
    draw=draw,
    details=details,
    points=60,
)


def main(argv: Sequence[str]) -> int:
    return study.main(STUDY, argv)


if __name__ == "__main__":
    command.run(main)
