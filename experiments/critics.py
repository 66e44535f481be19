"""`python -m experiments.critics`: whether layer normalization or categorical heads belong in the fast recipe.

Two robots shared out among two agents, MATD3 with recipe=fast, 500,000 env steps: critics as they are, with layer
normalization, with categorical heads, with both. Each is compared with the recipe as it is by the mean of its
evaluations in the last third.
"""

from collections.abc import Sequence
from pathlib import Path

from experiments import evaluations, figures, markdown, study
from experiments.one_at_a_time import against_base, better, label
from experiments.study import StudyOptions
from experiments.tidy import Table
from experiments.verdict import Claim
from matd3_jax.cli import command
from matd3_jax.figures.style import SERIES

ROBOTS = {"ant": "halves", "half_cheetah": "2x3"}

LAYER = "algo.critic_norm=layer"
CATEGORICAL = ["algo.critic_head=categorical", "algo.critic_atoms=101", "algo.critic_range=[-100,900]"]
"""One range for all robots: some 9 an env step, discounted by 0.99, at its upper end."""

CRITICS: dict[str, list[str]] = {
    "as they are": [],
    "layer normalization": [LAYER],
    "categorical": CATEGORICAL,
    "both": [LAYER, *CATEGORICAL],
}
BASE = "as they are"
KEYS = {"env": "env.name", "critic_norm": "algo.critic_norm", "critic_head": "algo.critic_head"}


def settings(scale: str, options: StudyOptions) -> dict[str, list[str]]:
    more = ["seeds=6", "total_steps=500000", "eval_every=50000"]
    if scale == "small":
        more = ["seeds=2", "total_steps=60000", "eval_every=20000", "eval_episodes=5"]
    return {
        f"{env}-{label(name)}": [
            f"env={env}", f"env.split={split}", "algo=matd3", "recipe=fast", *changes, *more
        ]
        for env, split in ROBOTS.items()
        for name, changes in CRITICS.items()
    }  # fmt: skip


def part(table: Table, env: str, name: str) -> Table:
    """The rows of one robot with one kind of critics."""
    line = [f"env={env}", f"env.split={ROBOTS[env]}", "algo=matd3", "recipe=fast", *CRITICS[name]]
    return table.where(**study.key_values(KEYS, line))


def claims(table: Table) -> list[Claim]:
    found: list[Claim] = []
    for env in ROBOTS:
        values = {name: evaluations.late(part(table, env, name)) for name in CRITICS}
        text = f"{env}: critics with {{}} lead to more than the recipe's (a question of ours)"
        found += against_base(values, BASE, better(text))
    return found


def draw(table: Table, path: Path) -> None:
    there = [env for env in ROBOTS if any(len(part(table, env, name)) for name in CRITICS)]
    figure, axes = figures.canvas(len(there))
    for axis, env in zip(axes, there, strict=True):
        for name, color in zip(CRITICS, SERIES, strict=False):
            rows = part(table, env, name)
            if len(rows):
                evaluations.draw(axis, rows, evaluations.RETURN, color, name)
        axis.set_title(f"{env}, {ROBOTS[env]}")
        axis.legend(frameon=False, fontsize=8, loc="upper left")
    figure.suptitle("Critics in recipe=fast: mean ± sd over seeds")
    figures.save(figure, path)


def details(table: Table) -> list[str]:
    rows = []
    for env in ROBOTS:
        for name in CRITICS:
            found = part(table, env, name)
            if len(found):
                rows.append([env, name, figures.interval(evaluations.late(found)), *evaluations.row(found)])
    return markdown.table(("robot", "critics", "mean in the last third", *evaluations.HEAD), rows)


STUDY = study.of_evaluations(
    name="critics",
    title="Critics of the fast recipe",
    help=str(__doc__),
    protocol="Ours, not the paper's: recipe=fast, six seeds, 500,000 env steps; ten deterministic episodes "
    "every 50,000.",
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
