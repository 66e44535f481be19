"""`python -m experiments.sequential`: whether agents that learn one after another get further (HATD3's scheme).

Not in the paper. MATD3 with recipe=fast on the Ant shared out among four agents: all agents updated from the same
state, and one after another in a random order, each seeing the policies that have moved already (Zhong et al. 2024).
HARL's figures have its HATD3 at 5,900 and its MATD3 at 5,700 there, after ten million env steps. What
`experiments.robots` has trained with the same settings is taken over. scale=small is the half-cheetah.
"""

from collections.abc import Sequence
from pathlib import Path

from experiments import evaluations, robots, study, verdict
from experiments.one_at_a_time import QUANTITY, label
from experiments.study import StudyOptions
from experiments.tidy import Table
from experiments.verdict import Claim
from matd3_jax.cli import command

ORDERS: dict[str, list[str]] = {"simultaneous": [], "random order": ["update_order=random_sequential"]}

SCALES = {
    "paper": ["env=ant", "env.split=4x2", "seeds=3"],
    "small": ["env=half_cheetah", "env.split=6x1", "seeds=3", "total_steps=200000", "eval_every=10000"],
}
KEYS = {"env": "env.name", "split": "env.split", "algo": "algo.name", "order": "update_order"}


def line(scale: str, name: str) -> list[str]:
    return [*SCALES[scale], "algo=matd3", "recipe=fast", *ORDERS[name]]


def settings(scale: str, options: StudyOptions) -> dict[str, list[str]]:
    return {label(name): line(scale, name) for name in ORDERS}


def parts(table: Table) -> dict[str, Table]:
    """The rows of each order."""
    orders = {name: study.key_values(KEYS, line("paper", name))["order"] for name in ORDERS}
    return {name: table.where(order=order) for name, order in orders.items()}


def claims(table: Table) -> list[Claim]:
    one, other = ((name, evaluations.late(part)) for name, part in parts(table).items())
    text = "Agents updated one after another in a random order get further (Zhong et al. 2024)"
    return [verdict.compare(text, QUANTITY, other, one)]


def title(table: Table) -> str:
    return ", ".join(str(table[key][0]) for key in ("env", "split"))


def draw(table: Table, path: Path) -> None:
    evaluations.draw_each(parts(table), title(table), path)


def details(table: Table) -> list[str]:
    return evaluations.details_of_each(f"updates ({title(table)})", QUANTITY, parts(table))


STUDY = study.of_evaluations(
    name="sequential",
    title="Agents that learn one after another",
    help=str(__doc__),
    protocol="Not in the paper: recipe=fast, the Ant as four agents, three seeds, 1M env steps, ten deterministic "
    "episodes every 50,000.",
    settings=settings,
    keys=KEYS,
    claims=claims,
    draw=draw,
    details=details,
    beside=lambda options: {"robots": robots.STUDY.keys},
)


def main(argv: Sequence[str]) -> int:
    """Run the command; the exit code."""
    return study.main(STUDY, argv)


if __name__ == "__main__":
    command.run(main)
