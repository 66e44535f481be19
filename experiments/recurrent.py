"""`python -m experiments.recurrent`: do recurrent actors and critics learn what takes memory?

Not in the paper. MATD3 with perceptrons and with gated recurrent units (actor=gru), where memory is needed: Cooperative
Communication whose speaker is silent after two of 25 env steps, and the half-cheetah in halves whose agents do not
observe velocities. Beside them perceptrons on the same tasks with nothing hidden.
"""

from collections.abc import Sequence
from pathlib import Path

from experiments import evaluations, figures, study, verdict
from experiments.one_at_a_time import QUANTITY
from experiments.study import StudyOptions
from experiments.tidy import Table
from experiments.verdict import Claim
from matd3_jax.cli import command
from matd3_jax.figures.style import SERIES

WAYS: dict[str, tuple[str, list[str]]] = {
    "perceptrons": ("hidden", []),
    "recurrent": ("hidden", ["algo.actor=gru"]),
    "nothing hidden": ("seen", []),
}
TASKS: dict[str, dict[str, list[str]]] = {
    "simple_speaker_listener": {
        "hidden": ["env=simple_speaker_listener", "env.speaking_steps=2"],
        "seen": ["env=simple_speaker_listener"],
    },
    "half_cheetah": {
        "hidden": ["env=half_cheetah", "env.split=2x3", "recipe=fast", "n_step=1", "env.velocities=false"],
        "seen": ["env=half_cheetah", "env.split=2x3", "recipe=fast", "n_step=1"],
    },
}
WORDS = {
    "simple_speaker_listener": "with a speaker that falls silent",
    "half_cheetah": "without velocities",
}
SCALES = {
    "paper": {
        "simple_speaker_listener": ["seeds=10", "total_steps=1500000", "log_every=12500", "eval_every=50000"],
        "half_cheetah": ["seeds=6", "total_steps=1000000", "eval_every=50000"],
    },
    "small": {
        "simple_speaker_listener": ["seeds=5", "total_steps=200000", "log_every=5000", "eval_every=10000"],
        "half_cheetah": ["seeds=3", "total_steps=300000", "eval_every=25000"],
    },
}
EPISODES = {"simple_speaker_listener": ["eval_episodes=100"], "half_cheetah": []}
KEYS = {
    "env": "env.name",
    "speaking_steps": "env.speaking_steps",
    "velocities": "env.velocities",
    "actor": "algo.actor",
}


def line(task: str, way: str) -> list[str]:
    observed, more = WAYS[way]
    return [*TASKS[task][observed], "algo=matd3", *more]


def settings(scale: str, options: StudyOptions) -> dict[str, list[str]]:
    return {
        f"{task}-{way.replace(' ', '_')}": [
            *line(task, way), *SCALES[scale][task], *EPISODES[task], "keep_checkpoints=1"
        ]
        for task in TASKS
        for way in WAYS
    }  # fmt: skip


def part(table: Table, task: str, way: str) -> Table:
    """The rows of one of the settings."""
    return table.where(**study.key_values(KEYS, line(task, way)))


def claims(table: Table) -> list[Claim]:
    found = []
    for task in TASKS:
        late = {way: evaluations.late(part(table, task, way)) for way in WAYS}
        text = f"{figures.task(task)} {WORDS[task]}: recurrent networks do better than perceptrons (a question of ours)"
        pair = (("recurrent", late["recurrent"]), ("perceptrons", late["perceptrons"]))
        found.append(verdict.compare(text, QUANTITY, *pair))
    return found


def draw(table: Table, path: Path) -> None:
    figure, axes = figures.canvas(len(TASKS), width=5.2 * len(TASKS), height=4.0)
    for axis, task in zip(axes, TASKS, strict=True):
        for k, way in enumerate(WAYS):
            rows = part(table, task, way)
            if evaluations.late(rows) is not None:
                evaluations.draw(axis, rows, evaluations.RETURN, SERIES[k], way)
        axis.set_title(f"{figures.task(task)} {WORDS[task]}", fontsize=9)
        if axis.lines:
            axis.legend(frameon=False, loc="best")
    figures.save(figure, path)


def details(table: Table) -> list[str]:
    rows = []
    for task in TASKS:
        for way in WAYS:
            found = part(table, task, way)
            if evaluations.late(found) is not None:
                late = figures.interval(evaluations.late(found))
                rows.append([f"{figures.task(task)}: {way}", late, *evaluations.row(found)])
    return evaluations.table(("networks", QUANTITY, *evaluations.HEAD), rows)


STUDY = study.of_evaluations(
    name="recurrent",
    title="Recurrent networks",
    help=str(__doc__),
    protocol="Ours, not the paper's: Cooperative Communication at the paper's settings, ten seeds, 1.5 million env "
    "steps, and the half-cheetah with the fast recipe but for targets of one step, six seeds, a million env steps.",
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
