"""`python -m experiments.estimators`: bias of the critics against what is learned, over estimators of the target.

Not in the paper. MATD3 with one critic, with the minimum of two, three and five, with the minimum of two drawn out of
five (REDQ), and with quantiles of which 0, 2 or 5 of 25 are left out of the target (TQC), on Cooperative Navigation as
in `overestimation` and on the half-cheetah. The bias is the Q-bias instrument's: the critics' estimates minus the
returns that are then played.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from experiments import evaluations, figures, markdown, study, verdict
from experiments.one_at_a_time import QUANTITY, against_base, better, label
from experiments.overestimation import measured
from experiments.study import StudyOptions
from experiments.tidy import Table
from experiments.verdict import Claim
from matd3_jax.cli import command
from matd3_jax.figures.style import SERIES

ALL = "algo.actor_critics=all"

ESTIMATORS: dict[str, list[str]] = {
    "1 critic": ["algo.num_critics=1"],
    "minimum of 2": [],
    "minimum of 3": ["algo.num_critics=3"],
    "minimum of 5": ["algo.num_critics=5"],
    "REDQ, 2 of 5": ["algo.num_critics=5", "algo.target_critics=2", ALL],
    "TQC, 0 of 25 dropped": ["algo.critic_head=quantile", "algo.dropped_quantiles=0", ALL],
    "TQC, 2 of 25 dropped": ["algo.critic_head=quantile", ALL],
    "TQC, 5 of 25 dropped": ["algo.critic_head=quantile", "algo.dropped_quantiles=5", ALL],
}
BASE = "minimum of 2"
"""MATD3's."""
MINIMA = {1: "1 critic", 2: "minimum of 2", 3: "minimum of 3", 5: "minimum of 5"}
FAMILIES = ("1 critic", "minimum", "REDQ", "TQC")
MARKERS = ("o", "s", "^")
"""Of the members of a family, which has one color."""

TASKS = {
    "simple_spread": ["env=simple_spread", "env.episode_length=200"],
    "half_cheetah": [
        # Of a discount of 0.99 two percent are left after 400 steps.
        "env=half_cheetah", "env.split=2x3", "recipe=fast", "diagnostics.q_bias_steps=400",
        "diagnostics.q_bias_rollouts=50",
    ],
}  # fmt: skip
SCALES = {
    "paper": {
        "simple_spread": ["seeds=10", "total_steps=1500000", "log_every=12500", "eval_every=50000"],
        "half_cheetah": ["seeds=6", "total_steps=1000000", "eval_every=50000"],
    },
    "small": {
        "simple_spread": ["seeds=5", "total_steps=400000", "log_every=5000", "eval_every=20000"],
        "half_cheetah": ["seeds=3", "total_steps=300000", "eval_every=25000"],
    },
}
KEYS = {
    "env": "env.name",
    "critics": "algo.num_critics",
    "head": "algo.critic_head",
    "dropped": "algo.dropped_quantiles",
    "climbed": "algo.actor_critics",
}


def line(task: str, name: str) -> list[str]:
    return [*TASKS[task], "algo=matd3", "diagnostics.q_bias=true", *ESTIMATORS[name]]


def settings(scale: str, options: StudyOptions) -> dict[str, list[str]]:
    return {
        f"{task}-{label(name)}": [
            *line(task, name), *SCALES[scale][task], "keep_checkpoints=1"
        ]
        for task in TASKS
        for name in ESTIMATORS
    }  # fmt: skip


def part(table: Table, task: str, name: str) -> Table:
    """The rows of one task with one estimator."""
    return table.where(**study.key_values(KEYS, line(task, name)))


def bias(part: Table) -> np.ndarray | None:
    """(estimate - true value) / |true value| of ONE setting in the last third of training, [seeds]: the quotient of the
    means over agents and evaluations."""
    found = measured(part)
    if found is None:
        return None
    steps, estimate, truth = found
    last = steps > 2 / 3 * steps[-1]
    return (estimate - truth)[:, last].mean(axis=1) / np.abs(truth[:, last].mean(axis=1))


def claims(table: Table) -> list[Claim]:
    found: list[Claim] = []
    for task in TASKS:
        biases = {number: bias(part(table, task, name)) for number, name in MINIMA.items()}
        there = {number: values for number, values in biases.items() if values is not None}
        text = f"{task}: the more critics the minimum is over, the lower the estimate (a question of ours)"
        quantity = "minus the change of the relative bias with each critic more"
        claim = Claim(text, quantity)
        if len(there) > 1:
            numbers = np.concatenate([np.full(len(values), number) for number, values in there.items()])
            words = ", ".join(f"{number}: {100 * values.mean():+.1f} %" for number, values in there.items())
            slope = verdict.negative(verdict.slope(numbers, np.concatenate(list(there.values()))))
            claim = Claim(text, quantity, slope, found=words)
        found.append(claim)
        values = {name: evaluations.late(part(table, task, name)) for name in ESTIMATORS}
        found += against_base(
            values, BASE, better(f"{task}: {{}} leads to more than MATD3's twins (a question of ours)")
        )
    return found


def draw(table: Table, path: Path) -> None:
    there = [task for task in TASKS if any(len(part(table, task, name)) for name in ESTIMATORS)]
    figure, axes = figures.canvas(len(there), width=5.6, height=4.4)
    for axis, task in zip(axes, there, strict=True):
        for name in ESTIMATORS:
            rows = part(table, task, name)
            over, returns = bias(rows), evaluations.late(rows)
            if over is None or returns is None:
                continue
            k = next(k for k, family in enumerate(FAMILIES) if name.startswith(family))
            marker = MARKERS[[other for other in ESTIMATORS if other.startswith(FAMILIES[k])].index(name)]
            figures.cross(axis, 100 * over, returns, SERIES[k], marker, name)
        axis.axvline(0, color="black", linewidth=0.8)
        axis.set_xlabel("estimate minus true value, % of the true value")
        axis.set_ylabel(QUANTITY)
        axis.set_title(figures.task(task))
        figures.legend_above(axis, columns=3)
    figures.save(figure, path)


def details(table: Table) -> list[str]:
    rows = []
    for task in TASKS:
        for name in ESTIMATORS:
            found = part(table, task, name)
            curve, over = evaluations.curve(found), bias(found)
            if curve is None or over is None:
                continue
            steps, values = curve
            cells = [task, name, str(len(values)), f"{steps[-1]:,.0f}"]
            cells += map(figures.interval, (100 * over, evaluations.late(found), values[:, -1]))
            rows.append(cells)
    head = ("task", "target of", "seeds", "env steps", "relative bias, %", QUANTITY, "last return")
    return [
        *markdown.table(head, rows),
        "",
        "In brackets: 95 % intervals of the mean. Bias: in the last third of training.",
    ]


STUDY = study.of_evaluations(
    name="estimators",
    title="Estimators of the target: bias and return",
    help=str(__doc__),
    protocol="Ours, not the paper's: MATD3 but for its critics. Cooperative Navigation with episodes of 200 steps, ten "
    "seeds, 1.5 million env steps; the half-cheetah as two agents, recipe=fast, six seeds, a million. At each "
    "evaluation 200 rollouts of 100 steps (half-cheetah: 50 of 400) from stored states and actions: the true values.",
    settings=settings,
    keys=KEYS,
    claims=claims,
    draw=draw,
    details=details,
)


def main(argv: Sequence[str]) -> int:
    return study.main(STUDY, argv)


if __name__ == "__main__":
    command.run(main)
