"""`python -m experiments.hybrid`: whether MATD3 that hands over to TD3 is early like the one and late like the other.

The future work of the paper: a robot's agents learn by MATD3 until three tenths of the env steps, then one agent in
their place goes on by TD3, with their networks side by side or with networks that have learned from them (distilled).
Beside it MATD3 and TD3 alone, TD3 also with networks as wide as the joined ones. All with the same recipe. With MATD3
the hybrid is compared seed by seed where the two are the same run until the switch, and so are the two hybrids. `env`
is any robot; scale=small is the half-cheetah, 200,000 env steps of five seeds. What `experiments.ant` has trained with
the same settings is taken over.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from experiments import ant, evaluations, figures, markdown, study, verdict
from experiments.study import RESULTS, StudyOptions
from experiments.tidy import Table
from experiments.verdict import Claim
from matd3_jax import config, envs
from matd3_jax.cli import command
from matd3_jax.cli.options import option
from matd3_jax.figures import style

SHARE = 0.3
"""Of the env steps, before the switch."""

STEPS = {"paper": 1_000_000, "small": 200_000}
SCALES = {"paper": ["seeds=6"], "small": ["seeds=5", "eval_every=10000", "log_every=5000"]}
KEYS = {"env": "env.name", "algo": "algo.name", "width": "algo.hidden", "handover": "algo.handover"}

Curve = tuple[np.ndarray, np.ndarray]
"""(env steps [points], values [seeds, points])."""

COLORS = {name: style.web(color) for name, color in (
    ("MATD3", style.BLUE), ("hybrid", style.VERMILION), ("TD3", style.PURPLE), ("TD3, as wide", style.SKY_BLUE),
    ("hybrid, distilled", style.GREEN),
)}  # fmt: skip


@dataclasses.dataclass(frozen=True)
class HybridOptions(StudyOptions):
    """Options of this study."""

    env: str | None = option("any robot", default=None, metavar="NAME", otherwise="ant; scale=small: half_cheetah")

    @property
    def robot(self) -> str:
        """The robot."""
        return self.env or ("ant" if self.scale == "paper" else "half_cheetah")


def lines(env: str) -> dict[str, list[str]]:
    """What distinguishes the settings, by name."""
    settings = config.load([f"env={env}"])
    agents = len(envs.make(**settings.env).agents)
    wide = ",".join(str(agents * width) for width in settings.algo.hidden)
    return {
        "MATD3": ["algo=matd3"],
        "hybrid": ["algo=hybrid"],
        "TD3": ["algo=td3"],
        "TD3, as wide": ["algo=td3", f"algo.hidden=[{wide}]"],
        "hybrid, distilled": ["algo=hybrid", "algo.handover=distill"],
    }


def settings(scale: str, options: HybridOptions) -> dict[str, list[str]]:
    steps, found = STEPS[scale], {}
    for name, line in lines(options.robot).items():
        switch = [f"switch_at={round(SHARE * steps)}"] if name.startswith("hybrid") else []
        label = name.replace(", as ", "_").replace(", ", "_").lower()
        found[label] = [f"env={options.robot}", *line, *switch, f"total_steps={steps}", *SCALES[scale]]
    return found


def folders(options: HybridOptions) -> tuple[Path, Path]:
    name = f"hybrid_{options.robot}" + ("_small" if options.scale == "small" else "")
    return Path("runs") / name, RESULTS / name


def parts(table: Table) -> dict[str, Table]:
    """The rows of each setting by name, of the one robot of a table."""
    (env,) = table.values("env")
    return {name: table.where(**study.key_values(KEYS, [f"env={env}", *line])) for name, line in lines(env).items()}


def claims(table: Table) -> list[Claim]:
    env = "/".join(table.values("env")) or "robot"
    found = parts(table) if len(table) else {}
    curves = {name: evaluations.curve(part) for name, part in found.items()}

    def before(name: str):
        """Mean [seeds] over the evaluations until the switch."""
        curve = curves.get(name)
        return None if curve is None else curve[1][:, curve[0] <= SHARE * curve[0][-1]].mean(axis=1)

    def late(name: str):
        return evaluations.late(found[name]) if name in found else None

    pairs = began_alike(curves.get("hybrid"), curves.get("MATD3"))
    early = f"{env}: mean over the evaluations before the switch"
    last = f"{env}: mean over the evaluations in the last third"
    return [
        verdict.compare(
            "MATD3 is better than a single agent early (expected in the paper)",
            early, ("MATD3", before("MATD3")), ("TD3", before("TD3")),
        ),
        verdict.compare(
            "A single agent is better than MATD3 late (expected in the paper)",
            last, ("TD3", late("TD3")), ("MATD3", late("MATD3")),
        ),
        *(
            verdict.compare(f"The hybrid is better late than {name} (a question of ours)", last,
                            ("hybrid", late("hybrid")), (name, late(name)), paired=pairs and name == "MATD3")
            for name in ("MATD3", "TD3", "TD3, as wide")
        ),
        *(
            verdict.compare(f"The distilled hybrid is better late than {name} (a question of ours)", last,
                            ("hybrid, distilled", late("hybrid, distilled")), (name, late(name)),
                            paired=name == "hybrid" and began_alike(curves.get("hybrid, distilled"), curves.get(name)))
            for name in ("TD3", "hybrid")
        ),
    ]  # fmt: skip


def began_alike(one: Curve | None, other: Curve | None) -> bool:
    """Whether the evaluations of the same seeds are the same until the switch: those of another machine are not."""
    if one is None or other is None or len(one[1]) != len(other[1]):
        return False
    steps = np.intersect1d(one[0], other[0])
    steps = steps[steps <= SHARE * other[0][-1]]
    until = [values[:, np.isin(own, steps)] for own, values in (one, other)]
    return len(steps) > 0 and np.array_equal(*until)


def draw(table: Table, path: Path) -> None:
    columns = [name for name in evaluations.COLUMNS if name in table]
    figure, axes = figures.canvas(len(columns), width=5.0, height=4.0)
    for axis, column in zip(axes, columns, strict=True):
        for name, part in parts(table).items():
            curve = evaluations.curve(part, column)
            if curve is None:
                continue
            evaluations.draw(axis, part, column, COLORS[name], name)
            if name == "hybrid":
                axis.axvline(SHARE * curve[0][-1], color="grey", linewidth=0.8, linestyle=":")
    axes[0].legend(frameon=False, fontsize=8, loc="upper left")
    figure.suptitle(f"{table['env'][0]}: mean ± sd over seeds; dotted: the switch")
    figures.save(figure, path)


def details(table: Table) -> list[str]:
    rows = [[name, *evaluations.row(part)] for name, part in parts(table).items() if len(part)]
    return markdown.table(("algorithm", *evaluations.HEAD), rows)


STUDY = study.of_evaluations(
    name="hybrid",
    title="MATD3, then a single agent",
    help=str(__doc__),
    protocol="Planned in the paper, not run there: here the Ant in two halves, one million env steps, six seeds, "
    "deterministic evaluation episodes.",
    settings=settings,
    keys=KEYS,
    claims=claims,
    draw=draw,
    details=details,
    options=HybridOptions,
    folders=folders,
    beside=lambda options: {options.robot: ant.STUDY.keys},
)


def main(argv: Sequence[str]) -> int:
    """Run the command; the exit code."""
    return study.main(STUDY, argv)


if __name__ == "__main__":
    command.run(main)
