"""`python -m experiments.ant`: MATD3, MADDPG, IL-TD3 and single-agent TD3 on a robot shared out among agents.

Figure 8 of the paper: deterministic evaluations along training, mean and standard deviation over seeds. `env` is any
robot, `recipe` one of its recipes, the same for all algorithms (recipe=paper: the paper's settings, days on a CPU);
scale=small is another robot, the half-cheetah, for 60,000 env steps of two seeds.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from experiments import evaluations, figures, markdown, study, verdict
from experiments.study import RESULTS, StudyOptions
from experiments.tidy import Table
from experiments.verdict import Claim
from matd3_jax.cli import command
from matd3_jax.cli.options import option
from matd3_jax.groups import known_names

STANDING = 1000
"""What an ant that stands still gets: 1 for each env step on its feet."""

SMALL = ["seeds=2", "total_steps=60000", "eval_every=5000", "eval_episodes=5", "log_every=5000"]


@dataclasses.dataclass(frozen=True)
class AntOptions(StudyOptions):
    """Options of this study."""

    env: str | None = option("any robot", default=None, metavar="NAME", otherwise="ant; scale=small: half_cheetah")
    recipe: str = option("of all algorithms", default="fast", choices=known_names("recipe"))
    algos: tuple[str, ...] = option(
        "which to train", default=("matd3", "maddpg", "iltd3", "td3"), choices=tuple(figures.NAMES), metavar="[A,B]"
    )


def settings(scale: str, options: AntOptions) -> dict[str, list[str]]:
    env = options.env or ("ant" if scale == "paper" else "half_cheetah")
    more = ["seeds=6"] if scale == "paper" else SMALL
    return {algo: [f"env={env}", f"recipe={options.recipe}", f"algo={algo}", *more] for algo in options.algos}


def folders(options: AntOptions) -> tuple[Path, Path]:
    name = options.env or ("ant" if options.scale == "paper" else "half_cheetah")
    if options.scale == "small" and name != "half_cheetah":
        name = f"{name}_small"
    if options.recipe != "fast":
        name = f"{name}_{options.recipe}"
    return Path("runs") / name, RESULTS / name


def claims(table: Table) -> list[Claim]:
    found = {algo: evaluations.curve(table.where(algo=algo)) for algo in ("matd3", "maddpg", "iltd3", "td3")}
    final = {algo: None if f is None else f[1][:, -1] for algo, f in found.items()}
    early = {algo: None if f is None else f[1][:, f[0] <= f[0][-1] / 2].mean(axis=1) for algo, f in found.items()}
    env = "/".join(table.values("env")) or "ant"
    last = f"{env}: last evaluation"
    ours = {algo: (figures.NAMES[algo], values) for algo, values in final.items()}
    return [
        verdict.compare("Ant: MATD3 performs better than MADDPG", last, ours["matd3"], ours["maddpg"]),
        verdict.compare("Ant: MATD3 performs better than IL-TD3", last, ours["matd3"], ours["iltd3"]),
        failing(f"{last}: standing still ({STANDING:,}) minus IL-TD3", final["iltd3"] if env == "ant" else None),
        verdict.compare(
            "Ant: SA-TD3 outperforms all multi-agent approaches in the end", last, ours["td3"], ours["matd3"]
        ),
        verdict.compare(
            "Ant: SA-TD3 does so only after many time steps",
            f"{env}: mean over the evaluations of the first half",
            ("MATD3", early["matd3"]),
            ("SA-TD3", early["td3"]),
        ),
    ]


def failing(quantity: str, returns: np.ndarray | None) -> Claim:
    """The claim that no seed's last evaluation, `returns` [seeds], is better than standing still."""
    text = "Ant: IL-TD3 fails in all trials"
    if returns is None:
        return Claim(text, quantity)
    better = (returns > STANDING).sum()
    found = f"IL-TD3 {returns.mean():,.0f} (n = {len(returns)}), {better} of {len(returns)} better than standing still"
    return Claim(text, quantity, verdict.mean(STANDING - returns), found=found)


def draw(table: Table, path: Path) -> None:
    columns = [name for name in evaluations.COLUMNS if name in table]
    figure, axes = figures.canvas(len(columns), width=5.0, height=4.0)
    for axis, column in zip(axes, columns, strict=True):
        for algo in dict.fromkeys(table["algo"].tolist()):
            evaluations.draw(axis, table.where(algo=algo), column, figures.COLORS[algo], figures.NAMES[algo])
    axes[0].legend(frameon=False, fontsize=8, loc="upper left")
    env = table["env"][0]
    if env in ("ant", "brax_ant"):
        axes[0].axhline(STANDING, color="grey", linewidth=0.8, linestyle=":")
        axes[0].annotate(
            "standing still", (1, STANDING), xycoords=("axes fraction", "data"), xytext=(-2, 3), ha="right",
            textcoords="offset points", color="grey", fontsize=8,
        )  # fmt: skip
    figure.suptitle(f"{env}: mean ± sd over seeds")
    figures.save(figure, path)


def details(table: Table) -> list[str]:
    algos = dict.fromkeys(table["algo"].tolist())
    rows = [[figures.NAMES[algo], *evaluations.row(table.where(algo=algo))] for algo in algos]
    return markdown.table(("algorithm", *evaluations.HEAD), rows)


STUDY = study.of_evaluations(
    name="ant",
    title="Robots shared out among agents",
    help=str(__doc__),
    protocol="The paper: the Ant in two halves, MATD3, MADDPG and IL-TD3 (independent learners), and single-agent TD3 "
    "with the whole observation; one million env steps, six seeds, deterministic evaluation episodes, mean and "
    "standard deviation.",
    settings=settings,
    keys={"env": "env.name", "algo": "algo.name"},
    claims=claims,
    draw=draw,
    details=details,
    options=AntOptions,
    folders=folders,
)


def main(argv: Sequence[str]) -> int:
    return study.main(STUDY, argv)


if __name__ == "__main__":
    command.run(main)
