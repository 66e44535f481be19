"""`python -m experiments.cross_play`: the teams of the competitive study against opponents that they never met.

After `python -m experiments.competitive`: in each task the teams of all four pairings play the single agents of all
four, every seed against every seed. Pairs that were trained together stand apart. The table has the team's return for
each algorithm of the team and of the single agent, and what the algorithms make of it. Goes by task: what was played
with the same checkpoints is used as it is, so a call that was stopped resumes with the same command. What
`matd3_jax.crossplay` left of a task's four pairings in `out`/cross_play_TASK is taken, too.
"""

import dataclasses
import fnmatch
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import track

from experiments import figures, markdown, verdict
from experiments.competitive import ALGOS, ENVS, PAIRINGS, team_is_adversaries
from experiments.cross_play_data import Task, of_command, read, write
from experiments.study import RESULTS
from experiments.verdict import Claim, Difference
from matd3_jax.cli import command
from matd3_jax.cli.options import Command, option
from matd3_jax.config import Config
from matd3_jax.errors import UserError
from matd3_jax.evaluation import entrants
from matd3_jax.evaluation.cross_play_table import Mean
from matd3_jax.runs.directory import RunDirectory
from matd3_jax.runs.paths import check_directory
from matd3_jax.runtime import devices, files
from matd3_jax.runtime.terminal import say
from matd3_jax.stats.text import plus_minus
from matd3_jax.training import checkpoint

FILES = ("cross_play.csv", "cross_play.json")


@dataclasses.dataclass(frozen=True)
class CrossPlayOptions:
    """Options of the cross-play."""

    scale: str = option("of the competitive study", default="paper", choices=("paper", "small"))
    only: str | None = option("play only the tasks whose names match", default=None, metavar="PATTERN")
    episodes: int = option("whole episodes of each pair of seeds", default=100, least=1, most=10**6)
    deterministic: bool = option("true: no noise at all; false: sampled, as in training", default=False)
    play: bool = option("false: report what there is", default=True)
    runs: Path | None = option(
        "run directories of the study", default=None, otherwise="runs/experiments/competitive, or competitive_small"
    )
    out: Path | None = option(
        "data, figure and table", default=None, otherwise="experiments/results/competitive, or competitive_small"
    )


COMMAND = Command(
    "python -m experiments.cross_play", CrossPlayOptions, __doc__,
    examples=("python -m experiments.cross_play only=simple_tag episodes=20",),
)  # fmt: skip


def main(argv: Sequence[str]) -> int:
    options = COMMAND.parse(argv)
    name = "competitive" if options.scale == "paper" else "competitive_small"
    folder, out = options.runs or Path("runs/experiments") / name, options.out or RESULTS / name
    check_directory(out, "out")
    chosen = [env for env in ENVS if fnmatch.fnmatch(env, options.only or "*")]
    if not chosen:
        raise UserError(f"only={options.only}: matches none of {', '.join(ENVS)}")
    devices.prepare()
    where = tuple(out / file for file in FILES)
    tasks = read(*where)
    for env in ENVS:
        played = out / f"cross_play_{env}"
        if env not in tasks and played.is_dir():
            tasks[env] = of_command(played, int(team_is_adversaries(env)))
            write(tasks, *where)
    runs = run_directories(folder) if options.play else {}
    for env in chosen if options.play else ():
        missing = [" against ".join(figures.NAMES[algo] for algo in pair) for pair in PAIRINGS if pair not in runs[env]]
        if missing:
            if env not in tasks:
                say(f"{env}: not played, for in {folder} there is no finished run of {', '.join(missing)}")
            continue
        own = {pair: runs[env][pair] for pair in PAIRINGS}
        facts = planned(own, options)
        if env in tasks and tasks[env].facts == facts:
            continue
        tasks[env] = play(env, own, facts, options)
        out.mkdir(parents=True, exist_ok=True)
        write(tasks, *where)
        say(f"{env}: played")
    if not tasks:
        raise UserError("there is nothing to report")
    report(tasks, out)
    return 0


# ---- playing ---------------------------------------------------------------------------------------------------------


Runs = Mapping[tuple[str, str], Sequence[Path]]
"""Of each pairing the run directories, which hold different seeds."""


def run_directories(folder: Path) -> dict[str, dict[tuple[str, str], list[Path]]]:
    """For each task the finished runs of each (algorithm of the team, of the single agent) in the study's folder.

    Raises UserError where two of them have the same seed.
    """
    found: dict[str, dict[tuple[str, str], list[Path]]] = {env: {} for env in ENVS}
    owners: dict[tuple[str, tuple[str, str], int], Path] = {}
    for path in (path.parent for depth in ("*", "*/*") for path in sorted(folder.glob(f"{depth}/config.yaml"))):
        run, settings = RunDirectory.open(path)
        env = str(settings.env["name"])
        if run.summary() is None or env not in found:
            continue
        teams = settings.teams()
        pair = teams["agents"].name, teams["adversaries"].name
        pair = pair if not team_is_adversaries(env) else (pair[1], pair[0])
        for seed in seeds_of(settings):
            if owner := owners.get((env, pair, seed)):
                raise UserError(f"{owner} and {path} both have seed {seed} of the same pairing: move one elsewhere")
            owners[env, pair, seed] = path
        found[env].setdefault(pair, []).append(path)
    return found


def seeds_of(settings: Config) -> list[int]:
    return list(settings.seed_numbers)


def planned(own: Runs, options: CrossPlayOptions) -> dict[str, Any]:
    """What decides the numbers of a task, as it is kept beside them."""
    runs = {}
    for pair, paths in own.items():
        opened = [RunDirectory.open(path) for path in paths]
        steps = {int(checkpoint.verify(run.checkpoints).name) for run, _ in opened}
        if len(steps) > 1:
            raise UserError(f"{' and '.join(map(str, paths))} were trained for different numbers of env steps")
        seeds = [seed for _, settings in opened for seed in seeds_of(settings)]
        runs["-vs-".join(pair)] = {"checkpoint": steps.pop(), "seeds": seeds}
    return {"episodes": options.episodes, "deterministic": options.deterministic, "runs": runs}


def play(env: str, own: Runs, facts: dict[str, Any], options: CrossPlayOptions) -> Task:
    """Every team of a task against every single agent."""
    console = Console(stderr=True)

    def shown(cells):
        return track(cells, env, console=console, transient=True, disable=not console.is_terminal)

    paths = [path for pair in PAIRINGS for path in own[pair]]
    entered, environment = entrants.load(paths, None, False, options.episodes)
    found = entrants.play(entered, environment, False, options.episodes, options.deterministic, 0, shown)
    # Directories of the same pairing become one.
    number = [k for k, pair in enumerate(PAIRINGS) for _ in own[pair]]
    sizes = {path: entrant.settings.seeds for path, entrant in zip(paths, entered, strict=True)}
    before = [sum(sizes[other] for other in own[pair][:k]) for pair in PAIRINGS for k in range(len(own[pair]))]
    side = int(team_is_adversaries(env))
    order = [side, 1 - side]  # the team first, whichever side of the environment it is
    runs, seeds = np.array(number)[found.runs], np.array(before)[found.runs] + found.seeds
    return Task(facts, runs[:, order], seeds[:, order], found.returns[:, side])


# ---- telling ---------------------------------------------------------------------------------------------------------


def claims(tasks: Mapping[str, Task]) -> list[Claim]:
    """The paper's direct comparison between strangers, and what each algorithm does for the team."""
    found = []
    for env in ENVS:
        better, worse = ("maddpg", "matd3") if env == "simple_crypto" else ALGOS
        name, (b, w) = figures.task(env), (figures.NAMES[algo] for algo in (better, worse))
        paper = f"{name}: {b} outperforms {w} in the direct comparison (the paper's claim, here between strangers)"
        quantity = f"team's return in cross-play: {b} team against {w} minus {w} team against {b}"
        ours = f"{name}: a MATD3 team does better than a MADDPG team against the same strangers (ours)"
        effect = "team's return in cross-play: MATD3 team minus MADDPG team, against all strangers"
        task = tasks.get(env)
        if task is None:
            found += [Claim(paper, quantity), Claim(ours, effect)]
            continue
        direct = [(better, worse)], [(worse, better)]
        teams = [[(team, single) for single in ALGOS] for team in ALGOS]
        for text, what, (plus, minus), names in (
            (paper, quantity, direct, (f"{b} team", f"{w} team")),
            (ours, effect, teams, ("MATD3 team", "MADDPG team")),
        ):
            numbers = [
                f"{who} {_number(task.mean(pairs, own=False))}" for who, pairs in zip(names, (plus, minus), strict=True)
            ]
            value, half = task.contrast(plus, minus)
            difference = Difference(value, value - half, value + half, np.nan)
            found.append(Claim(text, what, difference, found=", ".join(numbers)))
    return found


def _number(mean: Mean | None) -> str:
    return "—" if mean is None else plus_minus(mean.value[0], mean.half[0])


def report(tasks: Mapping[str, Task], out: Path) -> None:
    """Figure and table from the data."""
    draw(tasks, out / "cross_play.png")
    lines = ["# Competitive tasks: teams against opponents that they never met", ""]
    lines += [
        "In each task the teams of all four pairings of `experiments.competitive` play the single agents of all four, "
        "every seed against every seed, from their last checkpoints. *Own*: pairs that were trained together; "
        "*strangers*: all others. Intervals (95 %) are the jackknife's over the trained seeds, since numbers that "
        "share a seed are not independent; there are no p-values.",
        "",
    ]
    sizes: dict[str, list[str]] = {}
    for env, task in tasks.items():
        kind = "deterministic" if task.facts["deterministic"] else "sampled"
        runs = task.facts["runs"].values()
        seeds = "/".join(sorted({str(len(run["seeds"])) for run in runs}))
        steps = "/".join(sorted({f"{run['checkpoint']:,}" for run in runs}))
        size = f"{seeds} seeds of each pairing after {steps} env steps, {task.facts['episodes']} {kind} episodes"
        sizes.setdefault(f"{size} of each pair.", []).append(figures.task(env))
    lines += [line for size, names in sizes.items() for line in (f"{', '.join(names)}: {size}", "")]
    lines += [*verdict.lines(claims(tasks)), "", verdict.DEFINITIONS, ""]
    rows = []
    for env, task in tasks.items():
        for pair in PAIRINGS:
            own, others = (task.mean([pair], own) for own in (True, False))
            cells = [figures.task(env), *(figures.NAMES[algo] for algo in pair), _number(own), _number(others)]
            rows.append([*cells, f"{0 if others is None else others.pairs:,}"])
    head = ("task", "team", "single agent", "own partner", "strangers", "pairs of strangers")
    lines += markdown.table(head, rows)
    lines += ["", "![Team's returns with own partners and with strangers](cross_play.png)"]
    files.write_text(out / "cross_play.md", "\n".join(lines) + "\n")
    say("\n".join(lines[:-2]))


def draw(tasks: Mapping[str, Task], path: Path) -> None:
    """For each task: the team's return by pairing with own partners and strangers, and the matrix of all runs."""
    figure, axes = figures.canvas(2 * len(tasks), columns=len(tasks), width=3.1, height=3.3)
    for k, (env, task) in enumerate(tasks.items()):
        axis = axes[k]
        for position, pair in enumerate(PAIRINGS):
            for own, shift, fill in ((True, -0.13, "white"), (False, 0.13, None)):
                mean = task.mean([pair], own)
                if mean is not None:
                    color = figures.COLORS[pair[0]]
                    axis.errorbar(
                        position + shift, mean.value[0], mean.half[0], fmt="s" if own else "o", color=color, capsize=3,
                        markerfacecolor=fill or color,
                    )  # fmt: skip
        axis.set_xticks(range(len(PAIRINGS)), [f"vs\n{figures.NAMES[single]}" for _, single in PAIRINGS], fontsize=8)
        for t, team in enumerate(ALGOS):  # below the opponents, the team
            axis.text(
                2 * t + 0.5, -0.2, f"{figures.NAMES[team]} team", transform=axis.get_xaxis_transform(), ha="center",
                va="top", color=figures.COLORS[team], fontweight="bold", fontsize=9,
            )  # fmt: skip
        axis.set_xlim(-0.6, len(PAIRINGS) - 0.4)
        axis.set_title(figures.task(env), fontsize=11)
        _matrix(axes[len(tasks) + k], task)
    axes[0].set_ylabel("team's return")
    axes[len(tasks)].set_ylabel("pairing of the team")
    for marker, fill, label in (("s", "white", "own partner"), ("o", "grey", "strangers (95 % interval)")):
        axes[0].plot([], [], marker, color="grey", markerfacecolor=fill, label=label)
    figure.legend(loc="outside upper center", ncols=min(2, len(tasks)), frameon=False, fontsize=9)
    figures.save(figure, path)


def _matrix(axis: Any, task: Task) -> None:
    """The team's mean return between strangers: rows are the pairings of the team, columns those of the opponent."""
    values = task.matrix()
    image = axis.imshow(values, cmap="cividis")
    axis.grid(False)
    for (i, j), value in np.ndenumerate(values):
        red, green, blue, _ = image.cmap(image.norm(value))
        dark = 0.299 * red + 0.587 * green + 0.114 * blue < 0.5
        axis.text(j, i, f"{value:.3g}", ha="center", va="center", fontsize=8, color="white" if dark else "black")
    short = [f"{figures.NAMES[team]}\nv {figures.NAMES[single]}" for team, single in PAIRINGS]
    axis.set_yticks(range(len(PAIRINGS)), short, fontsize=7)
    axis.set_xticks(range(len(PAIRINGS)), short, fontsize=7)
    axis.set_xlabel("pairing of the opponent", fontsize=9)


if __name__ == "__main__":
    command.run(main, COMMAND)
