"""`python -m experiments.squashing`: why the Ant stood still with sigmoid actors: squashing x actors' learning rate.

The Ant in two halves, MATD3, 300,000 env steps: actions as low + range x sigmoid(output), as the paper has them, or as
center + half range x tanh(output), which is the sigmoid of twice the output. If the slope is the reason, a sigmoid with
twice the learning rate is a tanh.
"""

from collections.abc import Sequence
from pathlib import Path

from experiments import evaluations, figures, markdown, study, verdict
from experiments.study import StudyOptions
from experiments.tidy import Table
from experiments.verdict import Claim
from matd3_jax.cli import command
from matd3_jax.figures.style import SERIES

GRID = (("sigmoid", 0.001), ("sigmoid", 0.002), ("tanh", 0.0005), ("tanh", 0.001))
MARGIN = 300.0
"""Returns closer than this count as alike: a third of what standing still gets."""

COMMON = [
    "env=ant", "algo=matd3", "recipe=paper", "num_envs=16", "updates_per_collect=4", "batch_size=256",
    "shared_minibatch=true", "n_step=3", "algo.tau=0.005", "algo.exploration_noise=0.2", "algo.hidden=[128,128]",
    "replay_capacity=400000", "eval_every=50000", "eval_episodes=5",
]  # fmt: skip
SCALES = {
    "paper": ["seeds=5", "total_steps=300000", "log_every=10000"],
    "small": ["seeds=2", "total_steps=100000", "log_every=5000"],
}


def settings(scale: str, options: StudyOptions) -> dict[str, list[str]]:
    return {
        f"{squash}-{lr}": [*COMMON, *SCALES[scale], f"algo.actor_output={squash}", f"algo.actor_lr={lr}"]
        for squash, lr in GRID
    }


def name(squash: str, lr: float) -> str:
    return f"{squash}, {lr:g}"


def claims(table: Table) -> list[Claim]:
    found = {key: (name(*key), evaluations.late(table.where(actor_output=key[0], actor_lr=key[1]))) for key in GRID}
    quantity = "mean evaluation in the last third"
    return [
        verdict.compare(
            "At one learning rate (0.001) tanh actors walk better than sigmoid actors",
            quantity,
            found["tanh", 0.001],
            found["sigmoid", 0.001],
        ),
        *(
            verdict.compare(
                f"It is the slope: a tanh at {slow:g} is a sigmoid at twice that",
                quantity,
                found["tanh", slow],
                found["sigmoid", 2 * slow],
                kind="no difference",
                margin=MARGIN,
            )
            for slow in (0.0005, 0.001)
        ),
    ]


def draw(table: Table, path: Path) -> None:
    columns = [column for column in evaluations.COLUMNS if column in table]
    figure, axes = figures.canvas(len(columns), width=5.0, height=4.0)
    for axis, column in zip(axes, columns, strict=True):
        for key, color in zip(GRID, SERIES, strict=False):
            part = table.where(actor_output=key[0], actor_lr=key[1])
            if len(part):
                dashes = "solid" if key[0] == "tanh" else "dashed"
                evaluations.draw(axis, part, column, color, name(*key), dashes)
    axes[0].legend(frameon=False, fontsize=8, loc="upper left", title="squashing, actors' learning rate")
    figure.suptitle("Ant, two halves, MATD3: mean ± sd over seeds")
    figures.save(figure, path)


def details(table: Table) -> list[str]:
    rows = []
    for key in GRID:
        part = table.where(actor_output=key[0], actor_lr=key[1])
        if len(part):
            rows.append([name(*key), figures.interval(evaluations.late(part)), *evaluations.row(part)])
    return markdown.table(("squashing, learning rate", "mean in the last third", *evaluations.HEAD), rows)


STUDY = study.of_evaluations(
    name="squashing",
    title="Squashing of the actors' outputs and their learning rate",
    help=str(__doc__),
    protocol="Ours, not the paper's: the Ant in two halves, MATD3, 16 environments, 4 updates of 256 transitions after "
    "each of their env steps, 128-128 networks, n-step 3, noise 0.2, five seeds, 300,000 env steps; five deterministic "
    "episodes every 50,000.",
    settings=settings,
    keys={"actor_output": "algo.actor_output", "actor_lr": "algo.actor_lr"},
    claims=claims,
    draw=draw,
    details=details,
)


def main(argv: Sequence[str]) -> int:
    return study.main(STUDY, argv)


if __name__ == "__main__":
    command.run(main)
