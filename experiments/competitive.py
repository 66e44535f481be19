"""`python -m experiments.competitive`: MATD3 and MADDPG against each other on the four competitive tasks.

Figure 4 of the paper: final return of the team in all four pairings of algorithms, normalized to 0 to 1 for each task.
The pairs are trained together in one environment. The team are the good agents, in Predator-Prey the three predators.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from experiments import figures, markdown, study, tidy, verdict
from experiments.study import Study, StudyOptions
from experiments.tidy import Table
from experiments.verdict import Claim
from matd3_jax.cli import command

ENVS = ("simple_crypto", "simple_push", "simple_adversary", "simple_tag")
ALGOS = ("matd3", "maddpg")
PAIRINGS = tuple((team, single) for team in ALGOS for single in ALGOS)
"""(algorithm of the team, algorithm of the single agent)."""

SCALES = {
    "paper": ["seeds=20", "total_steps=1500000", "log_every=12500"],
    "small": ["seeds=3", "total_steps=125000", "log_every=5000"],
}


def team_is_adversaries(env: str) -> bool:
    """Whether the team ("Team vs Single Agent") is what the environment calls adversaries: the three predators."""
    return env == "simple_tag"


def settings(scale: str, options: StudyOptions) -> dict[str, list[str]]:
    """Labels are ENV-ALGO-vs-ADVERSARY, as in algo= and adversary=."""
    common = [*SCALES[scale], "eval_every=0", "keep_checkpoints=1"]
    return {
        f"{env}-{algo}-vs-{adversary}": [f"env={env}", f"algo={algo}", f"adversary={adversary}", *common]
        for env in ENVS
        for algo in ALGOS
        for adversary in ALGOS
    }


def pairing(table: Table, env: str, team: str, single: str) -> Table:
    """The rows of one pairing of one task."""
    algo, adversary = (single, team) if team_is_adversaries(env) else (team, single)
    return table.where(env=env, algo=algo, adversary=adversary)


def team_return(table: Table, env: str, team: str, single: str) -> np.ndarray | None:
    """The team's final return in one pairing, [seeds]."""
    column = "return_adversaries" if team_is_adversaries(env) else "return_agents"
    return tidy.final(pairing(table, env, team, single), column)


def normalized(table: Table, env: str) -> dict[tuple[str, str], np.ndarray]:
    """The team's final returns by pairing, [seeds] each, mapped so that the worst trial of all pairings is 0 and the
    best is 1."""
    found = {(team, single): team_return(table, env, team, single) for team, single in PAIRINGS}
    there = {pair: values for pair, values in found.items() if values is not None}
    if not there:
        return {}
    every = np.concatenate(list(there.values()))
    low, high = np.nanmin(every), np.nanmax(every)
    return {pair: (values - low) / (high - low if high > low else 1.0) for pair, values in there.items()}


def claims(table: Table) -> list[Claim]:
    found = []
    for env in ("simple_push", "simple_adversary", "simple_tag", "simple_crypto"):
        ours = ("MATD3 team against MADDPG", team_return(table, env, "matd3", "maddpg"))
        theirs = ("MADDPG team against MATD3", team_return(table, env, "maddpg", "matd3"))
        if env == "simple_crypto":
            paper, pair = "MADDPG outperforms MATD3", (theirs, ours)
        else:
            paper, pair = "MATD3 outperforms MADDPG in the direct comparison", (ours, theirs)
        found.append(verdict.compare(f"{figures.task(env)}: {paper}", "team's final return", *pair))
    return found


def draw(table: Table, path: Path) -> None:
    envs = [env for env in ENVS if env in table.values("env")]
    figure, axes = figures.canvas(len(envs), width=2.9, height=3.6)
    for axis, env in zip(axes, envs, strict=True):
        values = normalized(table, env)
        for position, pair in enumerate(PAIRINGS):
            if pair in values:
                figures.bar(axis, position, values[pair], figures.COLORS[pair[0]])
        axis.set_xticks(range(len(PAIRINGS)), [f"vs\n{figures.NAMES[single]}" for _, single in PAIRINGS], fontsize=8)
        for k, team in enumerate(ALGOS):  # below the opponents, the team: its bars have its color
            axis.text(
                2 * k + 0.5, -0.2, f"{figures.NAMES[team]} team", transform=axis.get_xaxis_transform(), ha="center",
                color=figures.COLORS[team], fontweight="bold", fontsize=9,
            )  # fmt: skip
        axis.set_xlim(-0.6, len(PAIRINGS) - 0.4)
        axis.set_title(figures.task(env), fontsize=11)
        seeds = {len(v) for v in values.values()}
        axis.set_xlabel(f"{'/'.join(map(str, sorted(seeds)))} seeds", labelpad=20, fontsize=9)
    axes[0].set_ylabel("team's final return, normalized")
    figures.save(figure, path)


def details(table: Table) -> list[str]:
    head = ("task", "team", "against", "seeds", "env steps", "team's final return (95 % interval)", "normalized")
    rows = []
    for env in ENVS:
        values = normalized(table, env) if env in table.values("env") else {}
        for (team, single), scaled in values.items():
            found = team_return(table, env, team, single)
            steps = pairing(table, env, team, single).by_seed("step")[0, -1]
            cells = [figures.task(env), figures.NAMES[team], figures.NAMES[single], str(len(scaled)), f"{steps:,.0f}"]
            rows.append([*cells, figures.interval(found), f"{scaled.mean():.2f}"])
    return markdown.table(head, rows)


STUDY = Study(
    name="competitive",
    title="Competitive tasks",
    help=str(__doc__),
    protocol="The paper: the team and the single agent each MATD3 or MADDPG, trained together, 20 trials of each of "
    "the four pairings, 60,000 episodes of 25 steps. A final return is the mean of the last 1,000 training episodes (a "
    "fifth of all in runs below 5,000), summed over the team's agents; in Predator-Prey the team are the predators. "
    "The paper does not say how it normalized; here, for each task, the worst single trial of all pairings is 0 and "
    "the best is 1. The direct comparison is of a MATD3 team against a MADDPG opponent with a MADDPG team against a "
    "MATD3 opponent; tests are on the returns as they are.",
    settings=settings,
    keys={"env": "env.name", "algo": "algo.name", "adversary": "adversary.name"},
    claims=claims,
    draw=draw,
    details=details,
    points=30,
)


def main(argv: Sequence[str]) -> int:
    return study.main(STUDY, argv)


if __name__ == "__main__":
    command.run(main)
