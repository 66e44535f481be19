"""`python -m experiments.policy_delay`: MATD3 with policies updated after every, every second and every third critic
update.

Figure 5 of the paper: Cooperative Navigation, and Covert Communication, where team and adversary have the same delay.
A delay slows the targets, too, and with them the critics (`experiments.overestimation`): quick_targets=true gives them
the same speed whatever the delay, and leaves slower policies alone; d = 1 is the same run and taken over.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from experiments import figures, study, tidy, verdict
from experiments.study import RESULTS, Study, StudyOptions
from experiments.tidy import Table
from experiments.verdict import Claim
from matd3_jax.cli import command
from matd3_jax.cli.options import option
from matd3_jax.figures.style import SERIES

ENVS = ("simple_spread", "simple_crypto")
DELAYS = (1, 2, 3)
KEYS = {"env": "env.name", "policy_delay": "algo.policy_delay"}

SCALES = {
    "paper": ["seeds=10", "total_steps=1500000", "log_every=12500"],
    "small": ["seeds=4", "total_steps=300000", "log_every=5000"],
}


@dataclasses.dataclass(frozen=True)
class DelayOptions(StudyOptions):
    """Options of this study."""

    quick_targets: bool = option("true: tau 0.01 times the delay (not the paper's)", default=False)


def settings(scale: str, options: StudyOptions) -> dict[str, list[str]]:
    common = [*SCALES[scale], "eval_every=0", "keep_checkpoints=1"]
    quick = getattr(options, "quick_targets", False)
    return {
        f"{env}-d{delay}": [
            f"env={env}", "algo=matd3", f"algo.policy_delay={delay}", *([f"algo.tau={0.01 * delay:g}"] * quick), *common
        ]
        for env in ENVS
        for delay in DELAYS
    }  # fmt: skip


def folders(options: DelayOptions) -> tuple[Path, Path]:
    name = "policy_delay" + "_quick_targets" * options.quick_targets + "_small" * (options.scale == "small")
    return Path("runs/experiments") / name, RESULTS / name


def claims(table: Table) -> list[Claim]:
    def finals(env: str, column: str) -> dict[int, np.ndarray | None]:
        return {d: tidy.final(table.where(env=env, policy_delay=d), column) for d in DELAYS}

    spread, team, adversary = (
        finals("simple_spread", "return_agents"),
        finals("simple_crypto", "return_agents"),
        finals("simple_crypto", "return_adversaries"),
    )
    found = []
    for d in DELAYS[1:]:
        found.append(
            verdict.compare(
                "Cooperative Navigation: less frequent policy updates give a higher final performance",
                "final return",
                (f"d = {d}", spread[d]),
                ("d = 1", spread[1]),
            )
        )
    for d in DELAYS[1:]:
        slow, fast = (None if v is None else verdict.spread(v) for v in (spread[d], spread[1]))
        found.append(
            verdict.compare(
                "Cooperative Navigation: less frequent policy updates give a lower variance in results",
                "distance of a seed's final return from the median",
                ("d = 1", fast),
                (f"d = {d}", slow),
            )
        )
    for d in DELAYS[1:]:
        found.append(
            verdict.compare(
                "Covert Communication: less frequent policy updates make the adversary better at decrypting",
                "adversary's final return",
                (f"d = {d}", adversary[d]),
                ("d = 1", adversary[1]),
            )
        )
    for d in DELAYS[1:]:
        found.append(
            verdict.compare(
                "Covert Communication: less frequent policy updates are not beneficial to the team",
                "team's final return",
                ("d = 1", team[1]),
                (f"d = {d}", team[d]),
            )
        )
    return found


def draw(table: Table, path: Path) -> None:
    panels = [("simple_spread", "return_agents", "return"), ("simple_crypto", "return_agents", "team's return")]
    panels += [("simple_crypto", "return_adversaries", "adversary's return")]
    panels = [panel for panel in panels if panel[0] in table.values("env")]
    several = [panel for panel in panels if len(table.where(env=panel[0]).values("policy_delay")) > 1]
    panels = several or panels  # what another study trained of a task this one did not is no comparison
    figure, axes = figures.canvas(len(panels), width=4.0)
    for axis, (env, column, label) in zip(axes, panels, strict=True):
        for d, color in zip(DELAYS, SERIES, strict=False):
            part = table.where(env=env, policy_delay=d)
            if len(part):
                figures.learning(axis, part, column, color, f"d = {d}")
        axis.set_title(figures.task(env))
        axis.set_ylabel(f"{label},\nmean of the last 1,000 episodes")
        axis.legend(frameon=False, loc="best")
    figures.save(figure, path)


STUDY = Study(
    name="policy_delay",
    title="Delayed policy updates",
    help=str(__doc__),
    protocol="The paper: policies and targets updated after every d-th critic update, d = 1, 2, 3, on Cooperative "
    "Navigation and Covert Communication (team and adversary with the same d); it does not say how many trials: here "
    "10. Variance is compared by Brown and Forsythe's test: seeds' distances from the median of their setting.",
    settings=settings,
    keys=KEYS,
    claims=claims,
    draw=draw,
    options=DelayOptions,
    beside=lambda options: {"policy_delay": KEYS} if options.quick_targets else {},
    folders=folders,
    details=lambda table: figures.finals_table(
        table,
        ("env", "policy_delay"),
        {"team's final return": "return_agents", "adversary's": "return_adversaries"},
    ),
)


def main(argv: Sequence[str]) -> int:
    return study.main(STUDY, argv)


if __name__ == "__main__":
    command.run(main)
