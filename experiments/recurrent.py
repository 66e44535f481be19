"""`python -m experiments.recurrent`: do recurrent actors and critics learn what takes memory?

Not in the paper. MATD3 on Cooperative Communication whose speaker is silent after two of 25 env steps, with perceptrons
and with gated recurrent units (actor=gru); beside them perceptrons where the speaker never falls silent.
"""

from collections.abc import Sequence
from pathlib import Path

from experiments import evaluations, figures, study, verdict
from experiments.one_at_a_time import QUANTITY, label
from experiments.study import StudyOptions
from experiments.tidy import Table
from experiments.verdict import Claim
from matd3_jax.cli import command

SILENT, SPEAKING = "env.speaking_steps=2", "env.speaking_steps=25"
WAYS: dict[str, list[str]] = {
    "perceptrons": [SILENT],
    "recurrent": [SILENT, "algo.actor=gru"],
    "nothing hidden": [SPEAKING],
}
SCALES = {
    "paper": ["seeds=10", "total_steps=1500000", "log_every=12500", "eval_every=50000", "eval_episodes=100"],
    "small": ["seeds=5", "total_steps=200000", "log_every=5000", "eval_every=10000", "eval_episodes=100"],
}
KEYS = {"speaking_steps": "env.speaking_steps", "actor": "algo.actor"}


def line(way: str) -> list[str]:
    return ["env=simple_speaker_listener", "algo=matd3", *WAYS[way]]


def settings(scale: str, options: StudyOptions) -> dict[str, list[str]]:
    return {label(way): [*line(way), *SCALES[scale], "keep_checkpoints=1"] for way in WAYS}


def part(table: Table, way: str) -> Table:
    """The rows of one of the settings."""
    return table.where(**study.key_values(KEYS, line(way)))


def claims(table: Table) -> list[Claim]:
    late = {way: evaluations.late(part(table, way)) for way in WAYS}
    text = "With a speaker that falls silent, recurrent networks do better than perceptrons (a question of ours)"
    pair = (("recurrent", late["recurrent"]), ("perceptrons", late["perceptrons"]))
    return [verdict.compare(text, QUANTITY, *pair)]


def parts(table: Table) -> dict[str, Table]:
    return {way: part(table, way) for way in WAYS}


def draw(table: Table, path: Path) -> None:
    evaluations.draw_each(
        parts(table), f"{figures.task('simple_speaker_listener')}, the speaker silent after two steps", path
    )


def details(table: Table) -> list[str]:
    return evaluations.details_of_each("networks", QUANTITY, parts(table))


STUDY = study.of_evaluations(
    name="recurrent",
    title="Recurrent networks",
    help=str(__doc__),
    protocol="Ours, not the paper's: Cooperative Communication at the paper's settings, ten seeds, 1.5 million env "
    "steps; 100 deterministic episodes every 50,000.",
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
