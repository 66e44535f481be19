"""`python -m experiments.minimax`: whether agents trained against the others' worst case do better against strangers.

Not in the paper. Physical Deception: MADDPG and MATD3, each without a worst case, with the steps of M3DDPG's program
(0.001 against opponents), and with steps a hundred times as long. Both teams of a run have the same algorithm. Then
every team plays every opponent, all seeds against all, from their last checkpoints; pairs that were trained together do
not count. play=false trains only.
"""

import csv
import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from experiments import figures, markdown, study, tidy, verdict
from experiments.study import Study, StudyOptions
from experiments.tidy import Table
from experiments.verdict import Claim, Difference
from matd3_jax.cli import command
from matd3_jax.cli.options import asks_for_help, option
from matd3_jax.errors import UserError
from matd3_jax.evaluation import entrants
from matd3_jax.evaluation.cross_play import TEAMS
from matd3_jax.evaluation.cross_play_table import Mean, Pairings
from matd3_jax.figures import heat_map
from matd3_jax.runs.directory import RunDirectory
from matd3_jax.runtime import files
from matd3_jax.runtime.terminal import say
from matd3_jax.stats.text import plus_minus

ENV = "simple_adversary"
SETTINGS: dict[str, tuple[str, float]] = {
    "MADDPG": ("maddpg", 0.0),
    "M3DDPG": ("m3ddpg", 0.001),
    "M3DDPG, 0.1": ("m3ddpg", 0.1),
    "MATD3": ("matd3", 0.0),
    "M3MATD3": ("m3matd3", 0.001),
    "M3MATD3, 0.1": ("m3matd3", 0.1),
}
"""Algorithm and step against opponents by name; a hundredth of the step against one's own team."""
PAIRS = (("M3DDPG", "MADDPG"), ("M3DDPG, 0.1", "MADDPG"), ("M3MATD3", "MATD3"), ("M3MATD3, 0.1", "MATD3"))

SCALES = {
    "paper": ["seeds=10", "total_steps=1500000", "log_every=12500"],
    "small": ["seeds=5", "total_steps=250000", "log_every=5000"],
}
KEYS = {"algo": "algo.name", "adversarial_step": "algo.adversarial_step"}


@dataclasses.dataclass(frozen=True)
class MinimaxOptions(StudyOptions):
    """Options of this study."""

    play: bool = option("false: no cross-play, report what was played", default=True)
    episodes: int = option("whole episodes of each pair of seeds in the cross-play", default=100, least=1, most=10**6)


def label(name: str) -> str:
    algo, step = SETTINGS[name]
    return f"{algo}-{step:g}" if step else algo


def settings(scale: str, options: StudyOptions) -> dict[str, list[str]]:
    found = {}
    for name, (algo, step) in SETTINGS.items():
        steps = [f"algo.adversarial_step={step:g}", f"algo.adversarial_step_team={step / 100:g}"]
        found[label(name)] = [
            f"env={ENV}", f"algo={algo}", *steps, *SCALES[scale], "eval_every=0", "keep_checkpoints=1"
        ]  # fmt: skip
    return found


def part(table: Table, name: str) -> Table:
    """The rows of a setting by its name in `SETTINGS`."""
    return table.where(**dict(zip(KEYS, SETTINGS[name], strict=True)))


def claims(table: Table) -> list[Claim]:
    """Of self-play while training, where a longer step costs what it costs."""
    finals = {name: (name, tidy.final(part(table, name), "return_agents")) for name in SETTINGS}
    text = "The worst case costs nothing with one's own partners: {} does better than {} (ours)"
    return [
        verdict.compare(text.format(one, other), "team's final return in training", finals[one], finals[other])
        for one, other in PAIRS
    ]


def draw(table: Table, path: Path) -> None:
    figure, (axis,) = figures.canvas(1, width=6.4, height=4.2)
    for name, (algo, step) in SETTINGS.items():
        rows = part(table, name)
        if len(rows):
            color = figures.COLORS["maddpg" if algo in ("maddpg", "m3ddpg") else "matd3"]
            dashes = {0.0: "solid", 0.001: "dashed", 0.1: "dotted"}[step]
            episodes, means = tidy.trailing(rows, "return_agents")
            figures.band(axis, episodes / 1000, means, color, name, dashes)
    axis.set_xlabel("episodes (thousands)")
    axis.set_ylabel("team's return, mean of the last 1,000 episodes")
    axis.set_title(figures.task(ENV))
    axis.legend(frameon=False, loc="best")
    figures.save(figure, path)


STUDY = Study(
    name="minimax",
    title="Training against the others' worst case",
    help=str(__doc__),
    protocol="Ours, not the paper's: Physical Deception, both teams with the same algorithm, ten seeds, 60,000 "
    "episodes of 25 steps.",
    settings=settings,
    keys=KEYS,
    claims=claims,
    draw=draw,
    details=lambda table: figures.finals_table(
        table, tuple(KEYS), {"team's final return": "return_agents", "adversary's": "return_adversaries"}
    ),
    options=MinimaxOptions,
    points=30,
)


# ---- against strangers -----------------------------------------------------------------------------------------------


def contrast(pairings: Pairings, team: int, plus: int, minus: int) -> Difference | None:
    """Return of a team (0: agents, 1: adversaries) of the run `plus` minus that of the run `minus`, each the mean over
    all runs' opponents that are strangers."""
    runs = range(int(pairings.runs.max()) + 1)
    sides = [
        [
            np.flatnonzero((pairings.runs[:, team] == one) & (pairings.runs[:, 1 - team] == other) & ~pairings.own)
            for other in runs
        ]
        for one in (plus, minus)
    ]
    if any(len(cell) == 0 for side in sides for cell in side):
        return None
    signed = pairings.returns.copy()
    signed[np.concatenate(sides[1])] *= -1
    # Half the cells on either side: the difference is twice the mean of all with their signs.
    mean = pairings._replace(returns=2 * signed).mean([*sides[0], *sides[1]])
    assert mean is not None
    value, half = float(mean.value[team]), float(mean.half[team])
    return Difference(value, value - half, value + half, np.nan)


def cross_claims(pairings: Pairings, names: Sequence[str]) -> list[Claim]:
    found = []
    for one, other in PAIRS:
        for t, team in enumerate(TEAMS):
            text = f"{one} does better than {other} against strangers, {team} (ours)"
            quantity = f"return of {team} in cross-play: {one} minus {other}"
            there = one in names and other in names
            difference = contrast(pairings, t, names.index(one), names.index(other)) if there else None
            found.append(Claim(text, quantity, difference))
    return found


def play(folder: Path, out: Path, episodes: int) -> None:
    """Every run against every run: all pairs, their means, the heat map and what became of the claims, in `out`."""
    there = {name: folder / "runs" / label(name) for name in SETTINGS}
    there = {
        name: path
        for name, path in there.items()
        if (path / "config.yaml").is_file() and RunDirectory.open(path)[0].summary() is not None
    }
    if len(there) < 2:
        raise UserError(f"in {folder} there are not two finished runs to play each other")
    entered, env = entrants.load(list(there.values()), None, False, episodes)
    pairings = entrants.play(entered, env, False, episodes, False, 0)
    names = list(there)
    heading = ("agents", "agents_seed", "adversaries", "adversaries_seed")
    rows: list[Sequence[object]] = [(*heading, *(f"return_{team}" for team in TEAMS))]
    for runs, seeds, returns in zip(pairings.runs, pairings.seeds, pairings.returns, strict=True):
        who = [x for run, k in zip(runs, seeds, strict=True) for x in (names[run], entered[run].settings.seed + k)]
        rows.append((*who, *(f"{value:.6g}" for value in returns)))
    out.mkdir(parents=True, exist_ok=True)
    files.write_csv(out / "cross_play.csv", rows, line_end="\n")
    facts = {"episodes": episodes, "checkpoints": {name: e.steps for name, e in zip(names, entered, strict=True)}}
    files.write_json(out / "cross_play.json", facts)


def read(out: Path) -> tuple[Pairings, list[str]]:
    """What `play` left. Raises UserError where it is damaged."""
    try:
        with (out / "cross_play.csv").open(encoding="utf-8", newline="") as file:
            rows = list(csv.DictReader(file))
        names = [name for name in SETTINGS if any(row["agents"] == name for row in rows)]
        runs = np.array([[names.index(row[team]) for team in TEAMS] for row in rows])
        seeds = np.array([[int(row[f"{team}_seed"]) for team in TEAMS] for row in rows])
        returns = np.array([[float(row[f"return_{team}"]) for team in TEAMS] for row in rows])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UserError(f"cannot read {out / 'cross_play.csv'}: {error!r}; remove it") from error
    return Pairings(runs, seeds, returns, matched=False), names


def _cell(mean: Mean | None, team: int) -> str:
    return "—" if mean is None else plus_minus(mean.value[team], mean.half[team])


def report(out: Path) -> None:
    pairings, names = read(out)
    lines = ["# Training against the others' worst case: teams and opponents that never met", ""]
    lines += [
        "Every run's team against every run's adversary, all seeds against all, sampled episodes; pairs that were "
        "trained together are left out. Intervals (95 %) are the jackknife's over the trained seeds; there are no "
        "p-values.",
        "",
        *verdict.lines(cross_claims(pairings, names)),
        "",
        verdict.DEFINITIONS,
        "",
    ]
    for t, team in enumerate(TEAMS):
        head = (f"return of {team}: agents of", *(f"against {name}" for name in names))
        columns = range(len(names))
        rows = [[name, *(_cell(pairings.cell(i, j, own=False), t) for j in columns)] for i, name in enumerate(names)]
        lines += [*markdown.table(head, rows), ""]
    heat_map.draw(out / "cross_play.png", names, pairings, "Physical Deception, seeds x seeds")
    lines += ["![Returns between strangers](cross_play.png)"]
    files.write_text(out / "cross_play.md", "\n".join(lines) + "\n")
    say("\n".join(lines[:-1]))


def main(argv: Sequence[str]) -> int:
    code = study.main(STUDY, argv)
    if code or asks_for_help(argv):
        return code
    options = study.parse(STUDY, argv)
    assert isinstance(options, MinimaxOptions)
    if options.estimate:
        return 0
    folder, out = study.folders(STUDY, options)
    if options.play and options.train:
        play(folder, out, options.episodes)
    if (out / "cross_play.csv").exists():
        report(out)
    return 0


if __name__ == "__main__":
    command.run(main)
