"""`python -m experiments.cooperative`: MATD3 and MADDPG on Cooperative Navigation and Cooperative Communication.

Figure 3 of the paper: mean return of the last 1,000 training episodes along training, with the 95 % interval of the
mean."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from experiments import figures, study, tidy, verdict
from experiments.study import Study, StudyOptions
from experiments.tidy import Table
from experiments.verdict import Claim
from matd3_jax.cli import command

ENVS = ("simple_spread", "simple_speaker_listener")
ALGOS = ("matd3", "maddpg")
SHARE = 0.9
"""Of the way from untrained to trained play: where an algorithm counts as having learned."""
MARGIN = 0.05
"""Of the same way: final levels within it count as similar."""

SCALES = {
    "paper": ["seeds=20", "total_steps=1500000", "log_every=12500"],
    "small": ["seeds=5", "total_steps=400000", "log_every=5000"],
}


def settings(scale: str, options: StudyOptions) -> dict[str, list[str]]:
    common = [*SCALES[scale], "eval_every=0", "keep_checkpoints=1"]
    return {f"{env}-{algo}": [f"env={env}", f"algo={algo}", *common] for env in ENVS for algo in ALGOS}


def claims(table: Table) -> list[Claim]:
    spread, listener = (
        {algo: table.where(env=env, algo=algo) for algo in ALGOS}
        for env in ("simple_spread", "simple_speaker_listener")
    )
    finals = {algo: tidy.final(spread[algo], "return_agents") for algo in ALGOS}
    areas = {algo: tidy.along(spread[algo], "return_agents") for algo in ALGOS}
    way = _way(spread)
    until: dict[str, np.ndarray | None] = dict.fromkeys(ALGOS)
    level, more = 0.0, ""
    if way is not None:
        level = way[0] + SHARE * (way[1] - way[0])
        until = {algo: episodes_until(spread[algo], "return_agents", level) for algo in ALGOS}
        late = {algo: sum(final < level) for algo, final in finals.items() if final is not None}
        more = "".join(f"; {figures.NAMES[a]}: {n} seeds end below it" for a, n in late.items() if n)
    quick = f"episodes until the last 1,000 return {level:.0f}" if way else "episodes until learned"
    sooner = "Cooperative Navigation: MATD3 learns a better policy significantly faster"
    return [
        verdict.compare(
            "Cooperative Navigation: both achieve a similar final performance",
            "final return",
            ("MATD3", finals["matd3"]),
            ("MADDPG", finals["maddpg"]),
            kind="no difference",
            margin=MARGIN * abs(way[1] - way[0]) if way else 0.0,
        ),
        verdict.compare(
            sooner, "mean return over the whole training", ("MATD3", areas["matd3"]), ("MADDPG", areas["maddpg"])
        ),
        verdict.compare(sooner, quick, ("MADDPG", until["maddpg"]), ("MATD3", until["matd3"]), more=more),
        verdict.compare(
            "Cooperative Communication: MATD3 achieves a significantly better final performance",
            "final return",
            ("MATD3", tidy.final(listener["matd3"], "return_agents")),
            ("MADDPG", tidy.final(listener["maddpg"], "return_agents")),
        ),
    ]


def _way(tables: Mapping[str, Table]) -> tuple[float, float] | None:
    """(untrained return, the lower of the algorithms' mean final returns): what all of them learned."""
    finals = [tidy.final(table, "return_agents") for table in tables.values()]
    if any(final is None for final in finals):
        return None
    untrained = np.mean([table.by_seed("return_agents")[:, 0].mean() for table in tables.values()])
    return float(untrained), float(min(final.mean() for final in finals))  # type: ignore[union-attr]


def episodes_until(table: Table, name: str, level: float) -> np.ndarray:
    """Episodes of each seed of ONE setting until the mean return of its last ones reaches `level` after the first
    update, [seeds]; of a seed that never does, all of its episodes."""
    episodes, means = tidy.trailing(table, name)
    there = (means >= level) & (table.by_seed("updates") > 0)
    return np.array([episodes[np.argmax(row)] if row.any() else episodes[-1] for row in there])


def draw(table: Table, path: Path) -> None:
    envs = [env for env in ENVS if env in table.values("env")]
    figure, axes = figures.canvas(len(envs))
    for axis, env in zip(axes, envs, strict=True):
        for algo in ALGOS:
            part = table.where(env=env, algo=algo)
            if len(part):
                figures.learning(axis, part, "return_agents", figures.COLORS[algo], figures.NAMES[algo])
        axis.set_title(figures.task(env))
        axis.legend(frameon=False, loc="lower right")
    axes[0].set_ylabel("return, mean of the last 1,000 episodes")
    figures.save(figure, path)


STUDY = Study(
    name="cooperative",
    title="Cooperative tasks",
    help=str(__doc__),
    protocol="The paper: MATD3 and MADDPG, 20 trials each of 60,000 episodes of 25 steps; return summed over agents, "
    "mean of the last 1,000 training episodes. Here a final return is that mean at the end (a fifth of all episodes in "
    f"runs below 5,000); learned is {SHARE:.0%} of the way from untrained play to the lower final level; final levels "
    f"within {MARGIN:.0%} of that way of each other count as similar.",
    settings=settings,
    keys={"env": "env.name", "algo": "algo.name"},
    claims=claims,
    draw=draw,
    details=lambda table: figures.finals_table(table, ("env", "algo"), {"final return": "return_agents"}),
)


def main(argv: Sequence[str]) -> int:
    return study.main(STUDY, argv)


if __name__ == "__main__":
    command.run(main)
