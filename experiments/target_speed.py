"""`python -m experiments.target_speed`: whether MATD3 is slow at first because its targets move half as often.

Not in the paper. With a delay of 2 MATD3's targets (and policies) move with every second update, so that with the same
tau its critics take twice as long to leave their start (`experiments.overestimation`), and on Cooperative Navigation
MATD3 is behind MADDPG for the first 5,000 episodes before it is ahead. Here MATD3 has targets as quick as MADDPG's (tau
0.02), or no delay, and MADDPG targets as slow as MATD3's (tau 0.005), for 20,000 episodes.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from experiments import figures, study, tidy, verdict
from experiments.study import Study, StudyOptions
from experiments.tidy import Table
from experiments.verdict import Claim
from matd3_jax.cli import command
from matd3_jax.figures import style
from matd3_jax.figures.style import web

SETTINGS: dict[str, tuple[str, float, int]] = {
    "MATD3": ("matd3", 0.01, 2),
    "MATD3, tau 0.02": ("matd3", 0.02, 2),
    "MATD3, no delay": ("matd3", 0.01, 1),
    "MADDPG": ("maddpg", 0.01, 1),
    "MADDPG, tau 0.005": ("maddpg", 0.005, 1),
}
"""Algorithm, tau, delay by name."""

COLORS = tuple(map(web, (style.BLUE, style.SKY_BLUE, style.GREEN, style.ORANGE, style.VERMILION)))

EARLY = 5000
"""Episodes after the first update over which "at first" is meant."""

SCALES = {
    "paper": ["seeds=10", "total_steps=500000", "log_every=5000"],
    "small": ["seeds=3", "total_steps=200000", "log_every=5000"],
}
KEYS = {"algo": "algo.name", "tau": "algo.tau", "policy_delay": "algo.policy_delay"}


def settings(scale: str, options: StudyOptions) -> dict[str, list[str]]:
    common = ["env=simple_spread", *SCALES[scale], "eval_every=0", "keep_checkpoints=1"]
    return {
        f"{algo}-tau{tau}-d{delay}": [f"algo={algo}", f"algo.tau={tau}", f"algo.policy_delay={delay}", *common]
        for algo, tau, delay in SETTINGS.values()
    }


def part(table: Table, name: str) -> Table:
    """The rows of a setting by its name in `SETTINGS`."""
    return table.where(**dict(zip(KEYS, SETTINGS[name], strict=True)))


def early(table: Table) -> np.ndarray | None:
    """Mean return over the first `EARLY` episodes after the first update of ONE setting, [seeds]."""
    if not len(table):
        return None
    weights, values = (table.by_seed(name)[:, 1:] for name in ("episodes", "return_agents"))
    inside = np.cumsum(weights, axis=1) <= EARLY
    inside[:, 0] = True
    return (weights * values * inside).sum(axis=1) / (weights * inside).sum(axis=1)


def claims(table: Table) -> list[Claim]:
    at_first = {name: (name, early(part(table, name))) for name in SETTINGS}
    whole = {name: (name, tidy.along(part(table, name), "return_agents")) for name in SETTINGS}
    first, mean = f"mean return over the first {EARLY:,} episodes of learning", "mean return over 20,000 episodes"
    matd3, quick, undelayed, maddpg, slow = SETTINGS
    return [
        verdict.compare("MADDPG is ahead at first", first, at_first[maddpg], at_first[matd3]),
        verdict.compare("It is the targets: MATD3 gains from quicker ones", first, at_first[quick], at_first[matd3]),
        verdict.compare("It is the delay: MATD3 gains without it", first, at_first[undelayed], at_first[matd3]),
        verdict.compare("It is the targets: MADDPG loses with slower ones", first, at_first[maddpg], at_first[slow]),
        verdict.compare("With targets as quick, MATD3 learns faster than MADDPG", mean, whole[quick], whole[maddpg]),
    ]


def draw(table: Table, path: Path) -> None:
    figure, (axis,) = figures.canvas(1, width=6.4, height=4.2)
    levels = []
    for name, color in zip(SETTINGS, COLORS, strict=True):
        rows = part(table, name)
        if len(rows):
            dashes = "solid" if name in ("MATD3", "MADDPG") else "dashed"
            episodes, means = tidy.trailing(rows, "return_agents")
            figures.band(axis, episodes / 1000, means, color, name, dashes)
            levels.append(means.mean(axis=0)[episodes > episodes[-1] / 4])
    low, high = min(map(np.min, levels)), max(map(np.max, levels))
    axis.set_ylim(low - (high - low), high + 0.3 * (high - low))  # the dip at the start lies far below
    axis.set_xlabel("episodes (thousands)")
    axis.set_ylabel("return, mean of the last 1,000 episodes")
    axis.set_title(figures.task("simple_spread"))
    axis.legend(frameon=False, loc="lower right")
    figures.save(figure, path)


STUDY = Study(
    name="target_speed",
    title="How quickly the targets move, and who is ahead at first",
    help=str(__doc__),
    protocol="Ours, not the paper's: Cooperative Navigation, ten seeds, 20,000 episodes of 25 steps.",
    settings=settings,
    keys=KEYS,
    claims=claims,
    draw=draw,
    details=lambda table: figures.finals_table(table, tuple(KEYS), {"final return": "return_agents"}),
)


def main(argv: Sequence[str]) -> int:
    return study.main(STUDY, argv)


if __name__ == "__main__":
    command.run(main)
