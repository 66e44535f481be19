"""`python -m matd3_jax.sweep algo.lr=0.01,0.003 seeds=4`: train all combinations, or random draws, and rank them."""

import json
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from matd3_jax import config
from matd3_jax.cli import catalog, command, options
from matd3_jax.cli.arguments import Sweep as SweepOptions
from matd3_jax.config import Config, effect
from matd3_jax.errors import UserError, nearest
from matd3_jax.figures import lineage as lineage_figure
from matd3_jax.figures import sweep as sweep_figure
from matd3_jax.runs.directory import RunDirectory
from matd3_jax.runs.paths import inside
from matd3_jax.runtime import devices, files, multihost, slurm
from matd3_jax.runtime.multihost import SINGLE_PROCESS, Processes
from matd3_jax.runtime.terminal import say
from matd3_jax.stats.intervals import mean_interval
from matd3_jax.stats.text import plus_minus
from matd3_jax.sweep import batching, launcher, population, ranking, search_space
from matd3_jax.sweep import lineage as lineages
from matd3_jax.sweep.lineage import Lineage
from matd3_jax.sweep.population import Rules
from matd3_jax.sweep.ranking import Ranked
from matd3_jax.sweep.runner import Sweep
from matd3_jax.sweep.search_space import SearchSpace
from matd3_jax.training.session import TrainingSession

SELECTIONS = 20
"""Of a population in a run, by default."""

METRIC = "return_agents"
"""By which settings are ranked."""


def main(argv: Sequence[str]) -> int:
    """Run the command; the exit code."""
    given = catalog.SWEEP.parse(argv)
    devices.prepare()
    own = [text for text in argv if options.key(text) not in slurm.KEYS]
    with multihost.start(given.processes()) as processes:
        processes.check_same(" ".join(own), "settings")
        if given.resume is not None:
            return resume(given.resume, given, own, processes)
        return start(given, own, processes)


def start(given: SweepOptions, argv: Sequence[str], processes: Processes) -> int:
    """A fresh sweep. argv: as it was typed, to be kept."""
    if given.batch is not None:
        raise UserError("batch= goes with resume=SWEEP_DIR")
    if given.launcher_options and given.launcher is None:
        raise UserError(f"{given.launcher_options[0]}: say which launcher, e.g. launcher=submitit_slurm")
    if given.launcher is not None:
        if processes.size > 1:
            raise UserError(
                f"launcher={given.launcher} starts processes itself: call it from one, not from {processes.size}"
            )
        launcher.check(given.launcher, given.launcher_options)
    chosen, settings = read(given.settings, given.samples, given.sample_seed)
    metric = given.metric or METRIC
    check_metric(settings.values(), metric)
    rules = population_rules(given, metric, dict(zip(settings, chosen, strict=True)), settings)
    folder = inside(given.out, given.name or f"sweep-{time.strftime('%Y%m%d-%H%M%S')}", "name")
    if processes.first:
        facts = {
            "command": command.line("matd3_jax.sweep", *argv),
            "metric": metric,
            "settings": dict(zip(settings, chosen, strict=True)),
        }
        if rules is not None:
            facts["pbt"] = rules.facts
        _plan(folder, facts, settings, given.memory, processes)
    folder = processes.same_directory(folder)
    sweep, facts = open_sweep(folder, processes)
    if given.launcher is not None:
        code = launcher.launch(folder, len(sweep.batches), given.launcher, given.launcher_options)
        return code or _report_if_finished(sweep, None, facts)
    if not given.train:
        if processes.first:
            say(f"train a batch with: {_resume_line(folder)} batch=K (0 to {len(sweep.batches) - 1})\n"
                  f"then rank with: {_resume_line(folder)}")  # fmt: skip
        return 0
    return _train(sweep, None, facts)


def _plan(
    folder: Path, facts: Mapping[str, Any], settings: Mapping[str, Config], memory: float | None, processes: Processes
) -> None:
    """Make the sweep's directory, and say what is in it."""
    sweep = Sweep(folder, processes, Rules.of(facts))
    empty = folder.is_dir() and not any(folder.iterdir())  # a process was killed just as it had made it
    if not empty and not sweep.unfinished_plan():
        RunDirectory.check_new(folder)
    with sweep.planning():
        if (folder / "sweep.json").exists():  # another process was quicker
            RunDirectory.check_new(folder)
        sweep.discard_plan()
        runs = sweep.add(settings, None if memory is None else int(memory * 1e9))
        facts = {**facts, "runs": {name: [path.name for path in paths] for name, paths in runs.items()}}
        files.write_json(folder / "sweep.json", facts)
    seeds = sum(c.seeds for c in settings.values())
    say(f"sweep directory: {folder}\n{len(settings)} settings, {seeds} seeds, {len(sweep.batches)} batches")


def population_rules(
    given: SweepOptions, metric: str, chosen: Mapping[str, Mapping[str, str]], settings: Mapping[str, Config]
) -> Rules | None:
    """How a sweep's population is selected and explored; None where it is none. chosen: swept values by setting.

    Raises UserError for options of populations without one, and for settings that cannot be one.
    """
    if not given.pbt:
        for name in ("pbt_every", "pbt_start", "pbt_fraction", "pbt_explore", "pbt_replay"):
            if getattr(given, name) is not None:
                raise UserError(f"{name}= goes with pbt=true")
        return None
    total = next(iter(settings.values())).total_steps
    rules = Rules(
        every=given.pbt_every or max(1, total // SELECTIONS),
        fraction=given.pbt_fraction or 0.2,
        explore=given.pbt_explore or "perturb",
        replay=bool(given.pbt_replay),
        seed=given.sample_seed,
        overrides=given.settings,
        metric=metric,
        settings=chosen,
        start=given.pbt_start or 0,
    )
    population.check(rules, settings)
    return rules


def check_metric(settings: Iterable[Config], metric: str) -> None:
    """Raise UserError where the metrics table of one of the settings will have no such column."""
    programs = {batching.program(one): one for one in settings}
    for one in programs.values():
        columns = TrainingSession(one).columns
        if metric not in columns:
            raise UserError(f"metric={metric}: the metrics table has no such column; {nearest(metric, columns)}")


def read(
    overrides: Sequence[str], samples: int | None, seed: int, known: Sequence[str] = catalog.SWEEP.keys
) -> tuple[list[dict[str, str]], dict[str, Config]]:
    """The settings of a sweep: swept values {key: value in Hydra's grammar} of each, and its checked configuration by
    name. known: keys that the command takes itself (see `config.load`).

    Raises UserError, naming the setting where it is one combination that is impossible."""
    space = SearchSpace.parse(overrides)
    chosen = space.grid() if samples is None else space.sample(samples, seed)
    settings = {}
    for name, values in zip(search_space.names(space.axes, chosen), chosen, strict=True):
        try:
            settings[name or "run"] = config.load([*space.fixed, *(f"{k}={v}" for k, v in values.items())], known)
        except UserError as error:
            swept = ", ".join(f"{key}={value}" for key, value in values.items())
            raise UserError(f"{error} (with {swept})" if values else str(error)) from error
    effect.check(overrides, settings.values())
    batching.check_seeds(settings)
    return chosen, settings


def resume(folder: Path, given: SweepOptions, argv: Sequence[str], processes: Processes) -> int:
    """Resume a sweep: all batches that are not finished, or one, then the table."""
    for text in argv:
        if options.key(text) not in ("resume", "batch", "metric"):
            raise UserError(f"cannot take {text!r} with resume=: a sweep keeps its settings")
    sweep, facts = open_sweep(folder, processes)
    if given.batch is not None and given.batch >= len(sweep.batches):
        raise UserError(f"batch={given.batch}: {sweep.folder} has the batches 0 to {len(sweep.batches) - 1}")
    if given.metric is not None:
        check_metric([member for k in range(len(sweep.batches)) for member in sweep.members(k)], given.metric)
    return _train(sweep, given.batch, {**facts, "metric": given.metric or facts["metric"]})


def open_sweep(folder: Path, processes: Processes = SINGLE_PROCESS) -> tuple[Sweep, dict[str, Any]]:
    """A sweep and its facts (command, metric, settings). Raises UserError if there is none."""
    try:
        facts = json.loads((folder / "sweep.json").read_text(encoding="utf-8"))
        return Sweep(folder, processes, Rules.of(facts)), facts
    except (OSError, ValueError, LookupError, TypeError, AttributeError) as error:
        if isinstance(error, UserError):
            raise
        if Sweep(folder).unfinished_plan():
            raise UserError(
                f"{folder}: its planning was cut short; start the sweep again, with the same name="
            ) from None
        raise UserError(f"{folder} is no sweep directory: it has no sweep.json") from None


def _train(sweep: Sweep, batch: int | None, facts: Mapping[str, Any]) -> int:
    code = sweep.train(None if batch is None else [batch])
    if not sweep.processes.first:
        return sweep.processes.broadcast()
    if code:
        say(f"stopped; resume with: {_resume_line(sweep.folder)}")
    return sweep.processes.broadcast(code or _report_if_finished(sweep, batch, facts))


def _report_if_finished(sweep: Sweep, batch: int | None, facts: Mapping[str, Any]) -> int:
    left = [k for k in range(len(sweep.batches)) if not sweep.finished(k)]
    if not left:
        return command.DIVERGED if report(sweep, facts) else 0
    say(f"not finished yet: batch {', '.join(map(str, left))}; resume with: {_resume_line(sweep.folder)}")
    return 0 if batch is not None and batch not in left else 1


def _resume_line(folder: Path) -> str:
    return command.line("matd3_jax.sweep", resume=folder)


def report(sweep: Sweep, facts: Mapping[str, Any]) -> bool:
    """Table, CSVs and figure of a finished sweep; whether all its seeds diverged."""
    lineage = _lineage(sweep)
    copied = lineage.copied() if lineage else {}
    rows = ranking.rank(sweep.runs, facts["runs"], facts["settings"], str(facts["metric"]), copied)
    ranking.show(rows, f"{sweep.folder}: {facts['metric']}")
    ranking.write(sweep.folder, rows)
    sweep_figure.draw(sweep.folder / "sweep.png", sweep.runs, facts["runs"], rows, str(facts["metric"]))
    say(f"all settings: {sweep.folder / 'table.csv'}, all seeds: {sweep.folder / 'seeds.csv'}\n"
          f"figure: {sweep.folder / 'sweep.png'}\nruns: {sweep.runs}")  # fmt: skip
    if lineage:
        assert sweep.population is not None
        _report_population(sweep.folder, lineage, rows, sweep.population.metric)
    return all(row.diverged.all() for row in rows)


def _lineage(sweep: Sweep) -> Lineage | None:
    """Of a sweep's populations; None where it has none, or their file is lost."""
    if sweep.population is None:
        return None
    try:
        return Lineage.read(sweep.folder / lineages.FILE)
    except UserError as error:
        say(f"note: {error}")
        return None


def _report_population(folder: Path, lineage: Lineage, rows: Sequence[Ranked], metric: str) -> None:
    """Figure of the lineage, the best member of each population, and the schedule that the best of all had."""
    lineage_figure.draw(folder / "pbt.png", lineage, metric)
    say(f"lineage: {folder / lineages.FILE}, {folder / 'pbt.png'}")
    best = ranking.best_members(rows)
    if not best:
        return
    mean, half = mean_interval(np.array([value for value, _ in best.values()]))
    say(f"best member of each population ({len(best)}), final: {plus_minus(mean, half)}")
    seed, (value, name) = max(best.items(), key=lambda one: one[1][0])
    say(f"hyper-parameters of the best, {name} seed {seed} ({value:.4g}), or of those that it copied:")
    stages = lineage.schedule(lineage.settings.index(name), lineage.seeds.index(seed))
    say("\n".join(f"  {line}" for line in lineages.lines(stages, lineage.keys)))
