"""`python -m experiments.target_smoothing`: MATD3 with several levels of target policy smoothing on Cooperative
Navigation.

Figure 6 of the paper: return along training for several standard deviations of the noise on the target actions. What
`experiments.policy_delay` has trained with the same settings is taken over: its d = 2 is without smoothing.
"""

from collections.abc import Sequence
from pathlib import Path

from experiments import figures, policy_delay, study, tidy, verdict
from experiments.study import Study, StudyOptions
from experiments.tidy import Table
from experiments.verdict import Claim
from matd3_jax.cli import command
from matd3_jax.figures.style import SERIES

LEVELS = (0, 0.1, 0.2, 0.4)
MARGIN = 0.05
"""Of what is learned without smoothing (final minus untrained return): a smaller gain counts as none."""

SCALES = {
    "paper": ["seeds=10", "total_steps=1500000", "log_every=12500"],
    "small": ["seeds=5", "total_steps=300000", "log_every=5000"],
}


def settings(scale: str, options: StudyOptions) -> dict[str, list[str]]:
    common = ["env=simple_spread", "algo=matd3", *SCALES[scale], "eval_every=0", "keep_checkpoints=1"]
    return {f"sigma{sigma}": [*common, f"algo.target_noise={sigma}"] for sigma in LEVELS}


def claims(table: Table) -> list[Claim]:
    without = table.where(target_noise=0)
    base = tidy.final(without, "return_agents")
    margin = 0.0
    if base is not None:
        margin = MARGIN * abs(float(base.mean() - without.by_seed("return_agents")[:, 0].mean()))
    return [
        verdict.compare(
            "Cooperative Navigation: target policy smoothing brings no significant advantage",
            "final return",
            (f"σ = {sigma}", tidy.final(table.where(target_noise=sigma), "return_agents")),
            ("none", base),
            kind="no gain",
            margin=margin,
        )
        for sigma in LEVELS[1:]
    ]


def draw(table: Table, path: Path) -> None:
    figure, (whole, late) = figures.canvas(2)
    lowest, highest = [], []
    for sigma, color in zip(LEVELS, SERIES, strict=False):
        part = table.where(target_noise=sigma)
        if not len(part):
            continue
        for axis in (whole, late):
            figures.learning(axis, part, "return_agents", color, f"σ = {sigma}" if sigma else "no smoothing")
        episodes, means = tidy.trailing(part, "return_agents")
        there = means[:, episodes >= episodes[-1] / 3].mean(axis=0)
        lowest.append(there.min())
        highest.append(there.max())
    whole.set_title(figures.task("simple_spread"))
    late.set_title("the last two thirds, zoomed in")
    room = 0.15 * (max(highest) - min(lowest)) + 1e-6
    late.set_ylim(min(lowest) - room, max(highest) + room)
    late.set_xlim(left=whole.get_xlim()[1] / 3)
    whole.set_ylabel("return, mean of the last 1,000 episodes")
    whole.legend(frameon=False, loc="lower right")
    figures.save(figure, path)


STUDY = Study(
    name="target_smoothing",
    title="Target policy smoothing",
    help=str(__doc__),
    protocol="The paper: several levels of noise on the target actions on Cooperative Navigation, 10 runs each; it "
    "does not list them: here σ = 0 (none), 0.1, 0.2 and 0.4, clipped at 0.5. A gain below "
    f"{MARGIN:.0%} of what is learned without smoothing counts as none.",
    settings=settings,
    keys={"target_noise": "algo.target_noise"},
    claims=claims,
    draw=draw,
    details=lambda table: figures.finals_table(table, ("target_noise",), {"final return": "return_agents"}),
    beside=lambda options: {"policy_delay": policy_delay.STUDY.keys},
)


def main(argv: Sequence[str]) -> int:
    return study.main(STUDY, argv)


if __name__ == "__main__":
    command.run(main)
