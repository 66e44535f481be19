"""`python -m matd3_jax.sweep algo.lr=0.01,0.003 seeds=4`: train all combinations, or random draws, and rank them."""

import json
import shlex
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from hydra.core.override_parser.types import Override

from matd3_jax import config
from matd3_jax.config import Config
from matd3_jax.errors import UserError
from matd3_jax.figures import sweep as sweep_figure
from matd3_jax.runtime import devices, multihost, slurm
from matd3_jax.runtime.multihost import ALONE, Processes
from matd3_jax.sweep import launcher, ranking, search_space
from matd3_jax.sweep.runner import Sweep
from matd3_jax.sweep.search_space import SearchSpace

HELP = """usage: python -m matd3_jax.sweep [env=NAME] [algo=NAME] [key=value ...] key=VALUES ... [option=value ...]
       python -m matd3_jax.sweep resume=SWEEP_DIR [piece=K] [metric=COLUMN]

Any setting of matd3_jax.train may have several values: a list algo.lr=0.01,0.003,0.001, choice(...), range(1,4), or for
files glob(*). All combinations are trained with `seeds` seeds each, or with samples=N so many random draws, which may
come from intervals: algo.lr='interval(1e-4,1e-2)' (log scale where both ends are positive; tag(uniform,interval(...))).

options:
  samples=N        draw N settings at random (sample_seed=0 says which)
  metric=COLUMN    of the metrics table, by which settings are ranked (return_agents)
  memory=GB        that may be used at once (by each process, of several); default: what is free
  train=false      only plan, and say how to train the pieces
  launcher=NAME    train the pieces as jobs of a Hydra launcher, e.g. submitit_slurm; launcher.KEY=value: its options
  name=, out=      the sweep's directory, out/name

{processes}

It ends with a ranked table, table.csv, seeds.csv and sweep.png in its directory; every run is a run directory in runs/,
for matd3_jax.evaluate, matd3_jax.render and the others."""

OPTIONS: dict[str, Any] = {
    "samples": None,
    "sample_seed": 0,
    "metric": "return_agents",
    "memory": None,
    "train": True,
    "launcher": None,
    "name": None,
    "out": "runs",
}


def main(argv: Sequence[str]) -> int:
    """Run the command; the exit code."""
    if {"-h", "--help"} & set(argv):
        print(HELP.format(processes=slurm.HELP))
        return 0
    devices.prepare()
    given, argv = config.take_text(argv, slurm.KEYS)
    parsed = config.parse(argv, sweep=True)
    with multihost.start(given) as processes:
        processes.check_same(" ".join(argv), "settings")
        if any(override.key_or_group == "resume" for override in parsed):
            return resume(argv, processes)
        return start(argv, parsed, processes)


def start(argv: Sequence[str], parsed: Sequence[Override], processes: Processes) -> int:
    """A fresh sweep."""
    launcher_options = [text for text, o in zip(argv, parsed, strict=True) if o.key_or_group.startswith("launcher.")]
    plain = ("launcher", *OPTIONS)
    mine = [text for text, o in zip(argv, parsed, strict=True) if o.key_or_group in plain]
    rest = [text for text in argv if text not in mine and text not in launcher_options]
    options = {**OPTIONS, **config.take(mine, plain)[0]}
    _check(options)
    if launcher_options and options["launcher"] is None:
        raise UserError(f"{launcher_options[0]}: say which launcher, e.g. launcher=submitit_slurm")
    if options["launcher"] is not None:
        if processes.size > 1:
            raise UserError(
                f"launcher={options['launcher']} starts processes itself: call it from one, not from {processes.size}"
            )
        launcher.check(options["launcher"], launcher_options)
    chosen, settings = read(rest, options["samples"], options["sample_seed"])
    folder = Path(str(options["out"])) / str(options["name"] or f"sweep-{time.strftime('%Y%m%d-%H%M%S')}")
    if processes.first:
        _plan(folder, argv, options, dict(zip(settings, chosen, strict=True)), settings, processes)
    folder = processes.same_directory(folder)
    sweep, facts = open_sweep(folder, processes)
    if options["launcher"] is not None:
        code = launcher.launch(folder, len(sweep.pieces), str(options["launcher"]), launcher_options)
        return code or _report_if_finished(sweep, None, facts)
    if not options["train"]:
        if processes.first:
            print(f"train a piece with: python -m matd3_jax.sweep resume={folder} piece=K "
                  f"(0 to {len(sweep.pieces) - 1})\n"
                  f"then rank with: python -m matd3_jax.sweep resume={folder}")  # fmt: skip
        return 0
    return _train(sweep, None, facts)


def _plan(
    folder: Path,
    argv: Sequence[str],
    options: Mapping[str, Any],
    chosen: Mapping[str, Mapping[str, str]],
    settings: Mapping[str, Config],
    processes: Processes,
) -> None:
    """Make the sweep's directory, and say what is in it."""
    if folder.exists():
        raise UserError(f"{folder} is there already: choose another name=, or go on with resume={folder}")
    sweep = Sweep(folder, processes)
    budget = None if options["memory"] is None else int(options["memory"] * 1e9)
    runs = sweep.add(settings, budget)
    facts = {
        "command": shlex.join(["python", "-m", "matd3_jax.sweep", *argv]),
        "metric": options["metric"],
        "settings": chosen,
        "runs": {name: [path.name for path in paths] for name, paths in runs.items()},
    }
    (folder / "sweep.json").write_text(json.dumps(facts, indent=1) + "\n")
    seeds = sum(c.seeds for c in settings.values())
    print(f"sweep directory: {folder}\n{len(settings)} settings, {seeds} seeds, {len(sweep.pieces)} pieces", flush=True)


def read(overrides: Sequence[str], samples: int | None, seed: int) -> tuple[list[dict[str, str]], dict[str, Config]]:
    """The settings of a sweep: swept values {key: value in Hydra's grammar} of each, and its checked configuration by
    name. Raises UserError, naming the setting where it is one combination that is impossible."""
    space = SearchSpace.parse(overrides)
    chosen = space.grid() if samples is None else space.sample(samples, seed)
    settings = {}
    for name, values in zip(search_space.names(space.axes, chosen), chosen, strict=True):
        try:
            settings[name or "run"] = config.load([*space.fixed, *(f"{k}={v}" for k, v in values.items())])
        except UserError as error:
            swept = ", ".join(f"{key}={value}" for key, value in values.items())
            raise UserError(f"{error} (with {swept})" if values else str(error)) from error
    return chosen, settings


def resume(argv: Sequence[str], processes: Processes) -> int:
    """Go on with a sweep: all pieces that are not finished, or one, then the table."""
    taken, rest = config.take(argv, ("resume", "piece", "metric"))
    if rest:
        raise UserError(f"cannot take {rest[0]!r} with resume=: a sweep keeps its settings")
    sweep, facts = open_sweep(Path(str(taken["resume"])), processes)
    piece = taken.get("piece")
    if piece is not None and (type(piece) is not int or not 0 <= piece < len(sweep.pieces)):
        raise UserError(f"piece={piece!r}: {sweep.folder} has the pieces 0 to {len(sweep.pieces) - 1}")
    return _train(sweep, piece, {**facts, "metric": taken.get("metric", facts["metric"])})


def open_sweep(folder: Path, processes: Processes = ALONE) -> tuple[Sweep, dict[str, Any]]:
    """A sweep and its facts (command, metric, settings). Raises UserError if there is none."""
    try:
        return Sweep(folder, processes), json.loads((folder / "sweep.json").read_text())
    except (OSError, ValueError):
        raise UserError(f"{folder} is no sweep directory: it has no sweep.json") from None


def _train(sweep: Sweep, piece: int | None, facts: Mapping[str, Any]) -> int:
    code = sweep.train(None if piece is None else [piece])
    if not sweep.processes.first:
        return sweep.processes.tell()
    if code:
        print(f"stopped; go on with: python -m matd3_jax.sweep resume={sweep.folder}")
    return sweep.processes.tell(code or _report_if_finished(sweep, piece, facts))


def _report_if_finished(sweep: Sweep, piece: int | None, facts: Mapping[str, Any]) -> int:
    left = [k for k in range(len(sweep.pieces)) if not sweep.finished(k)]
    if not left:
        report(sweep, facts)
        return 0
    print(f"not finished yet: piece {', '.join(map(str, left))}; go on with: python -m matd3_jax.sweep "
          f"resume={sweep.folder}")  # fmt: skip
    return 0 if piece is not None and piece not in left else 1


def report(sweep: Sweep, facts: Mapping[str, Any]) -> None:
    """Table, CSVs and figure of a finished sweep."""
    rows = ranking.rank(sweep.runs, facts["runs"], facts["settings"], str(facts["metric"]))
    ranking.show(rows, f"{sweep.folder}: {facts['metric']}")
    ranking.write(sweep.folder, rows)
    sweep_figure.draw(sweep.folder / "sweep.png", sweep.runs, facts["runs"], rows, str(facts["metric"]))
    print(f"all settings: {sweep.folder / 'table.csv'}, all seeds: {sweep.folder / 'seeds.csv'}\n"
          f"figure: {sweep.folder / 'sweep.png'}\nruns: {sweep.runs}")  # fmt: skip


def _check(options: Mapping[str, Any]) -> None:
    for key, least in (("samples", 1), ("sample_seed", 0)):
        value = options[key]
        if value is not None and (type(value) is not int or value < least):
            raise UserError(f"{key}={value!r}: must be a whole number of at least {least}")
    memory = options["memory"]
    if memory is not None and (isinstance(memory, bool) or not isinstance(memory, int | float) or memory <= 0):
        raise UserError(f"memory={memory!r}: must be a positive number of gigabytes")
    if not isinstance(options["train"], bool):
        raise UserError(f"train={options['train']!r}: must be true or false")
