"""`python -m experiments.sharing`: does it cost return when agents share their networks, or a team its critics?

Not in the paper. MATD3 on Cooperative Navigation, whose agents are all of one kind and get the same reward: each with
its own actor and critics, with one actor and one set of critics for all (share_parameters=kind), with the team's one
set of critics (critic=shared), and with both. What it costs and saves in time and memory `python -m benchmarks.sharing`
measures.
"""

from collections.abc import Sequence
from pathlib import Path

from experiments import evaluations, figures, study, verdict
from experiments.one_at_a_time import QUANTITY, against_base, label
from experiments.study import StudyOptions
from experiments.tidy import Table
from experiments.verdict import Claim
from matd3_jax.cli import command

MODES: dict[str, list[str]] = {
    "apart": [],
    "kind": ["algo.share_parameters=kind"],
    "team critic": ["algo.critic=shared"],
    "both": ["algo.share_parameters=kind", "algo.critic=shared"],
}
BASE = "apart"
WORDS = {"kind": "one actor and one set of critics", "team critic": "the team's critics", "both": "both in common"}
MARGIN = 15.0
"""Of the team's summed return: what counts as no difference, 3 % of the -500 or so that MATD3 comes to."""

SCALES = {
    "paper": ["seeds=10", "total_steps=1500000", "log_every=12500", "eval_every=50000", "eval_episodes=100"],
    "small": ["seeds=5", "total_steps=200000", "log_every=5000", "eval_every=10000", "eval_episodes=100"],
}
KEYS = {"share": "algo.share_parameters", "critic": "algo.critic"}


def line(name: str) -> list[str]:
    return ["env=simple_spread", "algo=matd3", *MODES[name]]


def settings(scale: str, options: StudyOptions) -> dict[str, list[str]]:
    return {label(name): [*line(name), *SCALES[scale], "keep_checkpoints=1"] for name in MODES}


def part(table: Table, name: str) -> Table:
    """The rows of one of the settings."""
    return table.where(**study.key_values(KEYS, line(name)))


def claims(table: Table) -> list[Claim]:
    found = {name: evaluations.late(part(table, name)) for name in MODES}

    def same(name: str, base: tuple, changed: tuple) -> Claim:
        text = f"With {WORDS[name]} agents learn as well as apart (a question of ours)"
        return verdict.compare(text, QUANTITY, changed, base, "no difference", MARGIN)

    return against_base(found, BASE, same)


def parts(table: Table) -> dict[str, Table]:
    return {name: part(table, name) for name in MODES}


def draw(table: Table, path: Path) -> None:
    evaluations.draw_each(parts(table), figures.task("simple_spread"), path)


def details(table: Table) -> list[str]:
    return evaluations.details_of_each("networks", QUANTITY, parts(table))


STUDY = study.of_evaluations(
    name="sharing",
    title="Networks in common",
    help=str(__doc__),
    protocol="Ours, not the paper's: Cooperative Navigation with three agents at the paper's settings, ten seeds, 1.5 "
    "million env steps; 100 deterministic episodes every 50,000.",
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
