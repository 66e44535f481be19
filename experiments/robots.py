"""`python -m experiments.robots`: MATD3 and MADDPG with the fast recipe on robots shared out among two to six agents.

One recipe for all of them; the Ant in two halves is in `experiments.ant`. The table also has the returns of HARL's
MATD3 and MADDPG (Zhong et al. 2024), read off its figures.
"""

from collections.abc import Sequence
from pathlib import Path

from experiments import evaluations, figures, markdown, study, verdict
from experiments.one_at_a_time import QUANTITY
from experiments.study import StudyOptions
from experiments.tidy import Table
from experiments.verdict import Claim
from matd3_jax.cli import command
from matd3_jax.stats.text import NOTHING

ALGOS = ("matd3", "maddpg")
ROBOTS: dict[tuple[str, str], dict[str, str]] = {
    ("ant", "2x4"): {},
    ("ant", "4x2"): {"matd3": "2,700 at 1M, 3,800 at 2M, 5,700 at 10M", "maddpg": "4,000 at 10M"},
    ("half_cheetah", "2x3"): {"matd3": "4,300 ± 1,700 at 10M", "maddpg": "8,200 at 10M"},
    ("half_cheetah", "6x1"): {},
    ("walker2d", "2x3"): {"matd3": "6,800 at 10M", "maddpg": "5,000 to 5,500 at 10M"},
    ("hopper", "3x1"): {"matd3": "3,400 at 10M", "maddpg": "2,800 at 10M"},
    ("swimmer", "2x1"): {},
    ("humanoid", "9|8"): {},
}
"""(robot, split) and the returns of HARL's algorithms there, where its figures have them."""

HARL_ANT = 2700.0
"""HARL's MATD3 on the Ant, four agents, after 1M env steps."""


def settings(scale: str, options: StudyOptions) -> dict[str, list[str]]:
    more = ["seeds=3"] if scale == "paper" else ["seeds=2", "total_steps=60000", "eval_every=20000", "eval_episodes=5"]
    return {
        f"{env}-{split.replace('|', '_')}-{algo}": [
            f"env={env}", f'env.split="{split}"', f"algo={algo}", "recipe=fast", *more
        ]
        for env, split in ROBOTS
        for algo in ALGOS
    }  # fmt: skip


def _part(table: Table, env: str, split: str, algo: str) -> Table:
    return table.where(env=env, split=split, algo=algo)


def claims(table: Table) -> list[Claim]:
    found = evaluations.curve(_part(table, "ant", "4x2", "matd3"))
    quantity = f"last evaluation of the Ant, 4x2, minus {HARL_ANT:,.0f}"
    difference = None if found is None else verdict.mean(found[1][:, -1] - HARL_ANT)
    harl = Claim(
        "Ant with four agents: MATD3 above HARL's MATD3 at 1M env steps (a goal of ours)",
        quantity,
        difference,
        found="" if found is None else f"{found[1][:, -1].mean():.0f} (n = {len(found[1])})",
    )
    pairs = [
        verdict.compare(
            f"{_title(*key)}: MATD3 performs better than MADDPG (a question of ours)",
            QUANTITY,
            *((figures.NAMES[algo], evaluations.late(_part(table, *key, algo))) for algo in ALGOS),
        )
        for key in ROBOTS
    ]
    return [harl, *pairs]


def _title(env: str, split: str) -> str:
    return f"{env} {split}"


def draw(table: Table, path: Path) -> None:
    there = [key for key in ROBOTS if any(len(_part(table, *key, algo)) for algo in ALGOS)]
    figure, axes = figures.canvas(len(there), columns=min(4, len(there)), width=3.6, height=3.0)
    for axis, key in zip(axes, there, strict=True):
        for algo in ALGOS:
            part = _part(table, *key, algo)
            if len(part):
                evaluations.draw(axis, part, evaluations.RETURN, figures.COLORS[algo], figures.NAMES[algo])
        if key == ("ant", "4x2") and table["step"].max() >= 0.9e6:
            axis.plot(1e6, HARL_ANT, "*", color="black", markersize=8, label="HARL's MATD3", zorder=5)
        axis.set_title(_title(*key))
        axis.legend(frameon=False, fontsize=8, loc="upper left")
    figure.suptitle("recipe=fast: mean ± sd over seeds")
    figures.save(figure, path)


def details(table: Table) -> list[str]:
    rows = []
    for (env, split), harl in ROBOTS.items():
        for algo in ALGOS:
            part = _part(table, env, split, algo)
            if len(part):
                who = [env, split, figures.NAMES[algo]]
                rows.append([*who, *evaluations.row(part), harl.get(algo, NOTHING)])
    return markdown.table(("robot", "split", "algorithm", *evaluations.HEAD, "HARL's"), rows)


STUDY = study.of_evaluations(
    name="robots",
    title="MATD3 and MADDPG on robots, one recipe",
    help=str(__doc__),
    protocol="Ours, not the paper's: recipe=fast for both, three seeds, 1M env steps, ten deterministic episodes every "
    "50,000. HARL's numbers are of its own settings (256-256 networks, returns of 5 to 20 steps).",
    settings=settings,
    keys={"env": "env.name", "split": "env.split", "algo": "algo.name"},
    claims=claims,
    draw=draw,
    details=details,
)


def main(argv: Sequence[str]) -> int:
    return study.main(STUDY, argv)


if __name__ == "__main__":
    command.run(main)
