"""`python -m experiments.robots`: MATD3 with the fast recipe on robots shared out among two to six agents.

One recipe for all of them; the Ant in two halves is in `experiments.ant`. The table also has the returns of HARL's
MATD3 (Zhong et al. 2024), read off its figures.
"""

from collections.abc import Sequence
from pathlib import Path

from experiments import evaluations, figures, study, verdict
from experiments.study import StudyOptions
from experiments.tidy import Table
from experiments.verdict import Claim
from matd3_jax.cli import command

ROBOTS = {
    ("ant", "2x4"): None,
    ("ant", "4x2"): "2,700 at 1M, 3,850 at 2M, 5,700 at 10M",
    ("half_cheetah", "2x3"): "4,300 ± 1,700 at 10M",
    ("half_cheetah", "6x1"): None,
    ("walker2d", "2x3"): "6,800 at 10M",
    ("hopper", "3x1"): "3,400 at 10M",
}
"""(robot, split) and the return of HARL's MATD3 there, where its figures have it."""

HARL_ANT = 2700.0
"""HARL's MATD3 on the Ant, four agents, after 1M env steps."""


def settings(scale: str, options: StudyOptions) -> dict[str, list[str]]:
    more = ["seeds=3"] if scale == "paper" else ["seeds=2", "total_steps=60000", "eval_every=20000", "eval_episodes=5"]
    return {
        f"{env}-{split}": [f"env={env}", f"env.split={split}", "algo=matd3", "recipe=fast", *more]
        for env, split in ROBOTS
    }


def _part(table: Table, env: str, split: str) -> Table:
    return table.where(env=env, split=split)


def claims(table: Table) -> list[Claim]:
    found = evaluations.curve(_part(table, "ant", "4x2"))
    quantity = f"last evaluation of the Ant, 4x2, minus {HARL_ANT:,.0f}"
    difference = None if found is None else verdict.mean(found[1][:, -1] - HARL_ANT)
    return [
        Claim(
            "Ant with four agents: above HARL's MATD3 at 1M env steps (a goal of ours, not a claim of the paper)",
            quantity,
            difference,
            found="" if found is None else f"{found[1][:, -1].mean():.0f} (n = {len(found[1])})",
        )
    ]


def draw(table: Table, path: Path) -> None:
    there = [key for key in ROBOTS if len(_part(table, *key))]
    figure, axes = figures.canvas(len(there), columns=min(4, len(there)), width=3.6, height=3.0)
    for axis, key in zip(axes, there, strict=True):
        evaluations.draw(axis, _part(table, *key), evaluations.RETURN, figures.COLORS["matd3"], "MATD3")
        axis.set_title(" ".join(key))
        axis.legend(frameon=False, fontsize=8, loc="upper left")
    figure.suptitle("recipe=fast: mean ± sd over seeds")
    figures.save(figure, path)


def details(table: Table) -> list[str]:
    rows = [
        [*key, *evaluations.row(_part(table, *key)), harl or "—"]
        for key, harl in ROBOTS.items()
        if len(_part(table, *key))
    ]
    return evaluations.table(("robot", "split", *evaluations.HEAD, "HARL's MATD3"), rows)


STUDY = study.of_evaluations(
    name="robots",
    title="MATD3 on robots, one recipe",
    help=str(__doc__),
    protocol="Ours, not the paper's: recipe=fast, three seeds, 1M env steps, ten deterministic episodes every 50,000.",
    settings=settings,
    keys={"env": "env.name", "split": "env.split"},
    claims=claims,
    draw=draw,
    details=details,
)


def main(argv: Sequence[str]) -> int:
    return study.main(STUDY, argv)


if __name__ == "__main__":
    command.run(main)
