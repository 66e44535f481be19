"""The options of every command. Imports nothing heavy, so that --help is quick."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from matd3_jax.bounds import Bounds
from matd3_jax.cli.options import flag, number, option, others
from matd3_jax.errors import UserError
from matd3_jax.runs.paths import paths
from matd3_jax.runtime import slurm

LARGEST_SEED = 2**31 - 1


@dataclasses.dataclass(frozen=True)
class OfProcesses:
    """Options of commands that several processes may share; `runtime.slurm` checks them together."""

    coordinator_address: str | None = option(
        "of several processes (SLURM's are found by themselves): where process 0 runs, and a free port",
        default=None, metavar="HOST:PORT",
    )  # fmt: skip
    num_processes: str | None = option("how many processes there are", default=None, metavar="N")
    process_id: str | None = option("which of them this one is, from 0 to N-1", default=None, metavar="I")

    def processes(self) -> dict[str, str]:
        """Those that are given, as `multihost.start` takes them."""
        found = {name: getattr(self, name) for name in slurm.KEYS}
        return {name: text for name, text in found.items() if text is not None}


@dataclasses.dataclass(frozen=True)
class Train(OfProcesses):
    """Train with every seed, and leave a run directory; or resume one (resume=)."""

    resume: Path | None = option("resume this run; total_steps= may be raised", default=None, metavar="RUN_DIR")
    checkpoint: int | None = option(
        "with resume: start from the checkpoint of this env step", default=None, least=0, otherwise="the last"
    )
    cfg: bool = flag("--cfg", "print the resolved settings and stop")
    settings: tuple[str, ...] = others("a setting, in Hydra's grammar; name= and out= as typed")


@dataclasses.dataclass(frozen=True)
class Sweep(OfProcesses):
    """Train all combinations of settings with several values, with `seeds` seeds each, and rank them.

    Any setting of matd3_jax.train may have several values: a list algo.lr=0.01,0.003,0.001, choice(...), range(1,4), or
    for files glob(*). With samples=N so many random draws are trained, which may come from intervals:
    algo.lr='interval(1e-4,1e-2)' (log scale where both ends are positive; tag(uniform,interval(...))).

    With pbt=true the settings are the members of a population, and each seed is a population of its own: every now and
    then its worst members go on from copies of the best, with other values of the swept hyper-parameters.

    Leaves a ranked table, table.csv, seeds.csv and sweep.png in its directory; every run is a run directory in runs/,
    for matd3_jax.evaluate, matd3_jax.render and the others.
    """

    samples: int | None = option("draw so many settings at random", default=None, least=1, otherwise="the whole grid")
    sample_seed: int = option("of the draws", default=0, least=0)
    metric: str | None = option(
        "column of the metrics table, by which settings are ranked",
        default=None, metavar="COLUMN", otherwise="return_agents",
    )  # fmt: skip
    memory: float | None = option(
        "that each process may use at once", default=None, metavar="GB", unit="gigabytes", above=0,
        otherwise="what is free",
    )  # fmt: skip
    pbt: bool = option("true: the settings are a population, whose worst members copy the best", default=False)
    pbt_every: int | None = option(
        "between selections of a population", default=None, unit="env steps", least=1,
        otherwise="a twentieth of total_steps",
    )  # fmt: skip
    pbt_start: int | None = option(
        "before which there is no selection", default=None, unit="env steps", least=0, otherwise="0"
    )
    pbt_fraction: float | None = option(
        "of the members that copy, and of those that are copied; at least one", default=None, above=0, most=0.5,
        otherwise="0.2",
    )  # fmt: skip
    pbt_explore: str | None = option(
        "what is done with the copied hyper-parameters: times 0.8 or 1.2 (in lists a neighbor), or drawn anew",
        default=None, choices=("perturb", "resample"), otherwise="perturb",
    )  # fmt: skip
    pbt_replay: bool | None = option("true: replays are copied, too", default=None, otherwise="false")
    train: bool = option("false: only plan, and say how to train the batches", default=True)
    launcher: str | None = option(
        "train the batches as jobs of a Hydra launcher, e.g. submitit_slurm", default=None, metavar="NAME"
    )
    name: str | None = option("of the sweep's directory", default=None, metavar="NAME", otherwise="made from the time")
    out: Path = option("where the sweep's directory goes", default=Path("runs"))
    resume: Path | None = option("resume this sweep", default=None, metavar="SWEEP_DIR")
    batch: int | None = option("with resume: train this batch alone", default=None, metavar="K", least=0)
    launcher_options: tuple[str, ...] = others("an option of the launcher", prefix="launcher.")
    settings: tuple[str, ...] = others("a setting, with one value or several")


def saved(texts: Sequence[str], key: str) -> int | str | None:
    """Which of a run's policies: an env step, "best", or None for the last. Raises UserError for anything else."""
    if len(texts) > 1:
        raise UserError(f"{key}= is given {len(texts)} times: {', '.join(texts)}")
    if texts[0] in ("last", "null"):
        return None
    if texts[0] == "best":
        return "best"
    step = number(texts[0], int)
    if step is None or not Bounds(least=0).admits(step):
        raise UserError(f"{key}={texts[0]}: must be the env step of a checkpoint, a whole number, or last, or best")
    return step


@dataclasses.dataclass(frozen=True)
class OfOneRun:
    """Options of commands that play with the policies of one run."""

    run: Path = option("the run directory", metavar="RUN_DIR")
    checkpoint: int | str | None = option(
        "the checkpoint of this env step; best: each seed's best evaluation", default=None, metavar="STEP|best",
        otherwise="the last", read=saved,
    )  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Evaluate(OfOneRun):
    """Play whole episodes with every seed's policies, deterministic (no noise) and sampled (as in training).

    With averaged actors (algo.actor_average) also deterministic with the online ones. Prints means over the episodes,
    and writes every number to RUN_DIR/evaluation.csv.
    """

    episodes: int = option("episodes of each seed", default=100, least=1)
    seed: int = option("of the start states", default=0, least=0, most=LARGEST_SEED)


@dataclasses.dataclass(frozen=True)
class Render(OfOneRun):
    """Play one evaluation episode with the policies of one seed and draw it, each picture with env step and return."""

    out: Path | None = option(
        "a name that ends with .gif, or with .mp4 (needs ffmpeg)", default=None, new_file=True,
        otherwise="RUN_DIR/episode.gif",
    )  # fmt: skip
    seed: int | None = option("which of the run's seeds", default=None, least=0, otherwise="the first")
    episode: int = option("which of the episodes that `evaluate` plays", default=0, least=0, most=9999)
    deterministic: bool = option("false: with exploration noise, as in training", default=True)
    max_steps: int | None = option(
        "stop after so many", default=None, unit="env steps", least=1, otherwise="the whole episode"
    )
    every: int | None = option(
        "draw every n-th env step", default=None, least=1, otherwise="the least that makes some 200 at most"
    )
    size: int = option("longer side", default=400, unit="pixels", least=100, most=2000)
    fps: int | None = option("pictures a second", default=None, least=1, most=100, otherwise="10, of robots 20")


@dataclasses.dataclass(frozen=True)
class CrossPlay:
    """Play the agents of every run against the adversaries of every run, and print the matrix of mean returns.

    All play in the same environment and from the same start states. Means have 95 % intervals over seeds. Pairs that
    were trained together (same run, same seed: "own") stand apart from all others.
    """

    runs: tuple[Path, ...] = option(
        "run directories, with commas or wildcards (runs='runs/push-*'); one alone meets itself",
        metavar="A,B,C", read=paths,
    )  # fmt: skip
    pairing: str = option(
        "every seed with every seed, or the first of one run with the first of the other, ...",
        default="all", choices=("all", "matched"),
    )  # fmt: skip
    episodes: int = option("whole episodes of each pair of seeds", default=100, least=1, most=10**6)
    deterministic: bool = option("true: no noise at all; false: sampled, as in training", default=False)
    seed: int = option("of the start states, as in `evaluate`", default=0, least=0, most=LARGEST_SEED)
    checkpoint: int | str | None = option(
        "the checkpoint of this env step, of all runs; best: each seed's best evaluation", default=None,
        metavar="STEP|best", otherwise="the last of each", read=saved,
    )  # fmt: skip
    out: Path | None = option(
        "a directory that is not there yet, or empty", default=None, otherwise="crossplay/ENV-TIME"
    )


@dataclasses.dataclass(frozen=True)
class Plot:
    """Draw a learning curve for each setting: runs whose settings differ only in their seeds are one curve.

    Runs that have not ended are drawn as far as they are.
    """

    runs: tuple[Path, ...] = option(
        "run directories; also [A,B], and patterns: runs='runs/sweep/*'", metavar="A,B", read=paths
    )
    y: tuple[str, ...] = option(
        "columns of metrics.csv, a panel for each", default=("return_agents",), metavar="COLUMN,COLUMN,..."
    )
    x: str = option("episodes: ended so far", default="step", choices=("step", "episodes", "updates"))
    out: Path = option("a name that ends with .png, .pdf or .svg", default=Path("plot.png"), new_file=True)
    average: str = option("over seeds; iqm: the interquartile mean", default="mean", choices=("mean", "median", "iqm"))
    interval: str | None = option(
        "95 % by Student's t or by the bootstrap, or a standard deviation to both sides",
        default=None, choices=("t", "bootstrap", "sd", "none"), otherwise="t for the mean, bootstrap for the others",
    )  # fmt: skip
    window: int | None = option(
        "running mean over so many (the paper's: 1000)", default=None, unit="episodes", least=1,
        otherwise="the rows as they are",
    )  # fmt: skip
    labels: tuple[str, ...] | None = option(
        "of the curves, in the order of the runs; in quotation marks with commas", default=None,
        otherwise="where the settings differ",
    )  # fmt: skip
    title: str | None = option("over the figure", default=None, otherwise="what all runs have in common")
    each: bool = option("true: every seed, too, thin", default=False)


@dataclasses.dataclass(frozen=True)
class Export(OfOneRun):
    """Write each agent's deterministic policy of one seed to files that other programs read.

    Normalization of observations, squashing to the range of actions, and argmax or probabilities of choices are in the
    files; policies.json beside them says what every entry means. Before they get their names they are read back and
    compared with JAX on 1,000 observations, to 1e-5.
    """

    format: str = option(
        "which kind of files; onnx: a model for each agent; numpy: an .npz, and a reader that needs NumPy alone; "
        "saved_fn: functions that JAX saved (StableHLO), of any network",
        choices=("onnx", "numpy", "saved_fn"),
    )  # fmt: skip
    seed: int | None = option("which of the run's seeds", default=None, least=0, otherwise="the first")
    which: str | None = option(
        "the same as checkpoint=, by name", default=None, choices=("last", "best"), otherwise="last"
    )
    out: Path | None = option(
        "a directory that is not there yet, or empty", default=None, otherwise="RUN_DIR/export/seed_N-STEP-FORMAT"
    )


@dataclasses.dataclass(frozen=True)
class Report:
    """Write one HTML page about runs: final returns with intervals and differences, learning curves, films, settings,
    machines, and the commands that train them again.

    The page needs nothing but itself: pictures and films are in it, and no scripts. Runs whose settings differ only in
    their seeds are one line; those that have not ended are shown as far as they are.
    """

    runs: tuple[Path, ...] = option(
        "run directories; also [A,B], and patterns: runs='runs/sweep/*'", metavar="A,B", read=paths
    )
    out: Path = option("a name that ends with .html", default=Path("report.html"), new_file=True)
    title: str | None = option("of the page", default=None, otherwise="what all runs have in common")
    films: str = option(
        "auto: those that there are, and of particle tasks others are made; found: those that there are",
        default="auto", choices=("auto", "found", "none"),
    )  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Check:
    """Say what a run directory holds, what of it is damaged, and how to resume it. Changes nothing.

    Exit code: 0 where nothing is damaged, 1 where something is and the run can be resumed, 2 where there is no run.
    """

    run: Path | None = option("the run directory", default=None, metavar="RUN_DIR", otherwise="none")
    sweep: Path | None = option(
        "the directory of a sweep, with its batches and runs", default=None, metavar="SWEEP_DIR", otherwise="none"
    )
