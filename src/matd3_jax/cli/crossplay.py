"""`python -m matd3_jax.crossplay runs=A,B,C`: every run's agents against every run's adversaries."""

import time
from collections.abc import Iterable, Sequence
from pathlib import Path

from rich.console import Console
from rich.progress import track
from rich.table import Table

from matd3_jax.cli import catalog
from matd3_jax.cli.arguments import CrossPlay
from matd3_jax.config import diff
from matd3_jax.evaluation import entrants
from matd3_jax.evaluation.cross_play import TEAMS
from matd3_jax.evaluation.cross_play_table import Mean, Pairings
from matd3_jax.evaluation.entrants import Entrant
from matd3_jax.figures import heat_map
from matd3_jax.runs import divergence
from matd3_jax.runs.paths import as_part, check_new_directory
from matd3_jax.runtime import devices, files
from matd3_jax.runtime.terminal import say, show


def main(argv: Sequence[str]) -> int:
    """Run the command; the exit code."""
    options = catalog.CROSSPLAY.parse(argv)
    if options.out is not None:
        check_new_directory(options.out, "out")
    devices.prepare()
    matched = options.pairing == "matched"
    entered, env = entrants.load(options.runs, options.checkpoint, matched, options.episodes)
    env_name = diff.environment(entered[0].settings)
    name = f"{as_part(env_name)}-{time.strftime('%Y%m%d-%H%M%S')}"
    out = options.out or Path("crossplay") / name
    check_new_directory(out, "out")
    pairings = entrants.play(
        entered, env, matched, options.episodes, options.deterministic, options.seed, shown=_progress
    )
    out.mkdir(parents=True, exist_ok=True)
    kind = "deterministic" if options.deterministic else "sampled"
    who = "seed with seed" if matched else "seeds x seeds"
    title = f"{env_name}, {who}, {options.episodes} {kind} episodes of each pair"
    for entrant in entered:
        if entrant.diverged:
            say(f"{entrant.name}: {divergence.of_seeds(entrant.settings.seeds, entrant.diverged)}, left out")
    _print(pairings, [entrant.name for entrant in entered], title)
    _write(out, pairings, entered, options)
    heat_map.draw(out / "heat_map.png", [entrant.name for entrant in entered], pairings, title)
    say(f"every pair: {out / 'pairs.csv'}\nmeans and intervals: {out / 'means.csv'}\nheat map: {out / 'heat_map.png'}")
    return 0


def _progress(cells: Sequence[tuple[int, int]]) -> Iterable[tuple[int, int]]:
    """Show on a terminal how many of the cells have been played."""
    console = Console(stderr=True)
    return track(cells, "playing", console=console, transient=True, disable=not console.is_terminal)


# ---- output ---------------------------------------------------------------------------------------------------------


def _print(pairings: Pairings, names: Sequence[str], title: str) -> None:
    """A table for each team's return, and the means over all runs."""
    say(title)
    width = 80 + sum(len(name) + 20 for name in names)
    for t, team in enumerate(TEAMS):
        table = Table(title=f"return of {team}")
        table.add_column("agents of")
        for name in names:
            table.add_column(f"against {name}", justify="right")
        for heading in ("own pairs", "cross pairs"):
            table.add_column(heading, justify="right")
        for i, name in enumerate(names):
            cells = []
            for j in range(len(names)):
                cross = pairings.cell(i, j, own=False)
                cells.append(_words(cross, t) if cross else f"own {_words(pairings.cell(i, j, own=True), t)}")
            table.add_row(name, *cells, *(_words(pairings.summary(i, None, own), t) for own in (True, False)))
        table.add_section()
        for own in (True, False):
            cells = [_words(pairings.summary(None, j, own), t) for j in range(len(names))]
            total = [_words(pairings.summary(None, None, own), t) if own == column else "" for column in (True, False)]
            table.add_row("own pairs" if own else "cross pairs", *cells, *total)
        show(table, width)
    say("own: trained together (same run, same seed); cross: all others; ± 95 % interval over seeds")


def _words(mean: Mean | None, team: int) -> str:
    return "" if mean is None else heat_map.text(mean, team)


def _write(out: Path, pairings: Pairings, entered: Sequence[Entrant], options: CrossPlay) -> None:
    names = [entrant.name for entrant in entered]
    heading = ("agents", "agents_seed", "adversaries", "adversaries_seed", "pair")
    pairs: list[Sequence[object]] = [(*heading, *(f"return_{team}" for team in TEAMS), "episodes")]
    for runs, seeds, returns, own in zip(pairings.runs, pairings.seeds, pairings.returns, pairings.own, strict=True):
        who = [x for run, k in zip(runs, seeds, strict=True) for x in (names[run], entered[run].settings.seed + k)]
        pairs.append((*who, _kind(own), *(f"{value:.9g}" for value in returns), options.episodes))
    files.write_csv(out / "pairs.csv", pairs)
    columns = [name for team in TEAMS for name in (f"return_{team}", f"return_{team}_half_width")]
    means: list[Sequence[object]] = [("agents", "adversaries", "pair", "pairs", *columns)]
    for row in pairings.table():
        who = ["all" if run is None else names[run] for run in (row.agents, row.adversaries)]
        values = [f"{x:.9g}" for pair in zip(row.mean.value, row.mean.half, strict=True) for x in pair]
        means.append((*who, _kind(row.own), row.mean.pairs, *values))
    files.write_csv(out / "means.csv", means)
    playing = {
        e.name: {
            "path": str(e.path),
            "checkpoint": "best" if options.checkpoint == "best" else e.steps[0],
            "steps": e.steps,
            "algorithms": {team: algo.name for team, algo in e.settings.teams().items()},
            "seeds": [e.settings.seed + k for k in range(e.settings.seeds)],
            "diverged": {str(seed): found.step for seed, found in e.diverged.items()},
        }
        for e in entered
    }
    chosen = {key: getattr(options, key) for key in ("pairing", "episodes", "deterministic", "seed")}
    settings = {**chosen, "runs": playing}
    facts = {"env": dict(entered[0].settings.env), **settings, **devices.versions()}
    files.write_json(out / "crossplay.json", facts)


def _kind(own: bool) -> str:
    return "own" if own else "cross"
