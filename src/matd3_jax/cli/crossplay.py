"""`python -m matd3_jax.crossplay runs=A,B,C`: every run's agents against every run's adversaries."""

import dataclasses
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

from matd3_jax import envs
from matd3_jax.cli import arguments
from matd3_jax.cli.arguments import CrossPlay
from matd3_jax.config import Config
from matd3_jax.envs.environment import Environment
from matd3_jax.errors import UserError
from matd3_jax.evaluation import cross_play
from matd3_jax.evaluation.cross_play import TEAMS, Team
from matd3_jax.evaluation.cross_play_table import Mean, Pairings, pairs_of
from matd3_jax.figures import heat_map
from matd3_jax.runs import divergence
from matd3_jax.runs.directory import RunDirectory
from matd3_jax.runs.divergence import Divergence
from matd3_jax.runs.paths import check_new_directory
from matd3_jax.runtime import devices, files
from matd3_jax.runtime.terminal import say, show
from matd3_jax.training import checkpoint, memory, saved_policies
from matd3_jax.training.session import TrainingSession


class Entrant(NamedTuple):
    """A run with what it sends."""

    name: str
    path: Path
    settings: Config
    steps: list[int]
    """Env step of each seed's policies."""
    teams: dict[str, Team]
    diverged: dict[int, Divergence]
    """Seeds that do not play, by their numbers."""

    @property
    def sound(self) -> list[int]:
        """Places of the seeds that play."""
        return [k for k in range(self.settings.seeds) if self.settings.seed + k not in self.diverged]


def main(argv: Sequence[str]) -> int:
    """Run the command; the exit code."""
    options = arguments.CROSSPLAY.parse(argv)
    if options.out is not None:
        check_new_directory(options.out, "out")
    devices.prepare()
    matched = options.pairing == "matched"
    entrants, env = _entrants(options.runs, options.checkpoint, matched, options.episodes)
    name = f"{entrants[0].settings.env['name']}-{time.strftime('%Y%m%d-%H%M%S')}"
    out = options.out or Path("crossplay") / name
    check_new_directory(out, "out")
    pairings = _play(entrants, env, options, matched)
    out.mkdir(parents=True, exist_ok=True)
    kind = "deterministic" if options.deterministic else "sampled"
    who = "seed with seed" if matched else "seeds x seeds"
    title = f"{entrants[0].settings.env['name']}, {who}, {options.episodes} {kind} episodes of each pair"
    for entrant in entrants:
        if entrant.diverged:
            say(f"{entrant.name}: {divergence.of_seeds(entrant.settings.seeds, entrant.diverged)}, left out")
    _print(pairings, [entrant.name for entrant in entrants], title)
    _write(out, pairings, entrants, options)
    heat_map.draw(out / "heat_map.png", [entrant.name for entrant in entrants], pairings, title)
    say(f"every pair: {out / 'pairs.csv'}\nmeans and intervals: {out / 'means.csv'}\nheat map: {out / 'heat_map.png'}")
    return 0


# ---- who plays -------------------------------------------------------------------------------------------------------


def _entrants(
    where: Sequence[Path], which: int | str | None, matched: bool, episodes: int
) -> tuple[list[Entrant], Environment]:
    """The runs, and the environment that all have in common."""
    opened = [RunDirectory.open(path) for path in where]
    for k, path in enumerate(where):
        if any(path.resolve() == other.resolve() for other in where[:k]):
            raise UserError(f"runs: {path} is there twice")
    _, first = opened[0]
    env = envs.make(**first.env)
    for run, settings in opened[1:]:
        _check_same(env, first, where[0], envs.make(**settings.env), settings, run.path)
        if matched and settings.seeds != first.seeds:
            raise UserError(
                f"pairing=matched needs equally many seeds: {where[0]} has {first.seeds}, {run.path} {settings.seeds}"
            )
    if set(env.teams) != set(TEAMS):
        raise UserError(f"{first.env['name']} has no adversaries: there is nobody to play against")
    for run, _ in opened:
        checkpoint.verify(run.checkpoints, which if isinstance(which, int) else None)
    names = [path.resolve().name for path in where]
    if len(set(names)) < len(names):
        names = [str(path) for path in where]
    entrants = []
    for name, (run, settings) in zip(names, opened, strict=True):
        training = TrainingSession(settings)
        together = cross_play.side_by_side(settings.seeds**2, episodes)
        memory.check_playing(env, training.layout, episodes, together, devices.free_memory())
        saved = saved_policies.load(run, training, which)
        teams = {team: cross_play.team_of(training, env, saved.state, team) for team in TEAMS}
        entrants.append(Entrant(name, run.path, settings, saved.steps.tolist(), teams, saved.diverged))
        if not entrants[-1].sound:
            raise UserError(f"{run.path}: all seeds diverged ({divergence.which(saved.diverged)}): nobody can play")
    if matched and not set.intersection(*(set(entrant.sound) for entrant in entrants)):
        raise UserError("pairing=matched: each of the pairs has a seed that diverged")
    return entrants, env


def _check_same(env: Environment, first: Config, a: Path, other: Environment, settings: Config, b: Path) -> None:
    """Raise UserError, naming the first key that differs, unless both runs were trained in the same environment."""
    if env == other:
        return
    names = ["name"] if type(env) is not type(other) else [field.name for field in dataclasses.fields(env)]  # type: ignore[arg-type]
    for name in names:
        one, two = (
            (s.env.get("name") if name == "name" else getattr(e, name)) for s, e in ((first, env), (settings, other))
        )
        if one != two:
            raise UserError(f"runs of different environments cannot meet: env.{name}={one} in {a}, {two} in {b}")


# ---- playing ---------------------------------------------------------------------------------------------------------


def _play(entrants: Sequence[Entrant], env: Environment, options: CrossPlay, matched: bool) -> Pairings:
    """Everybody against everybody."""
    weights = np.array([np.where(np.array(env.teams) == team, env.return_weights, 0.0) for team in TEAMS])
    cells = [(i, j) for i in range(len(entrants)) for j in range(len(entrants))]
    runs, seeds, returns = [], [], []
    console = Console(stderr=True)
    for i, j in track(cells, "playing", console=console, transient=True, disable=not console.is_terminal):
        pairs = pairs_of(entrants[i].settings.seeds, entrants[j].settings.seeds, matched)
        pairs = pairs[np.isin(pairs[:, 0], entrants[i].sound) & np.isin(pairs[:, 1], entrants[j].sound)]
        teams = [entrants[i].teams["agents"], entrants[j].teams["adversaries"]]
        played = cross_play.play(env, teams, pairs, options.episodes, options.deterministic, options.seed)
        runs.append(np.broadcast_to((i, j), pairs.shape))
        seeds.append(pairs)
        returns.append(played @ weights.T)
    return Pairings(np.concatenate(runs), np.concatenate(seeds), np.concatenate(returns), matched)


# ---- telling ---------------------------------------------------------------------------------------------------------


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


def _write(out: Path, pairings: Pairings, entrants: Sequence[Entrant], options: CrossPlay) -> None:
    names = [entrant.name for entrant in entrants]
    heading = ("agents", "agents_seed", "adversaries", "adversaries_seed", "pair")
    pairs: list[Sequence[object]] = [(*heading, *(f"return_{team}" for team in TEAMS), "episodes")]
    for runs, seeds, returns, own in zip(pairings.runs, pairings.seeds, pairings.returns, pairings.own, strict=True):
        who = [x for run, k in zip(runs, seeds, strict=True) for x in (names[run], entrants[run].settings.seed + k)]
        pairs.append((*who, _kind(own), *(f"{value:.9g}" for value in returns), options.episodes))
    files.write_csv(out / "pairs.csv", pairs)
    columns = [name for team in TEAMS for name in (f"return_{team}", f"return_{team}_half_width")]
    means: list[Sequence[object]] = [("agents", "adversaries", "pair", "pairs", *columns)]
    for row in pairings.table():
        who = ["all" if run is None else names[run] for run in (row.agents, row.adversaries)]
        values = [f"{x:.9g}" for pair in zip(row.mean.value, row.mean.half, strict=True) for x in pair]
        means.append((*who, _kind(row.own), row.mean.pairs, *values))
    files.write_csv(out / "means.csv", means)
    entered = {
        e.name: {
            "path": str(e.path),
            "checkpoint": "best" if options.checkpoint == "best" else e.steps[0],
            "steps": e.steps,
            "algorithms": {team: algo.name for team, algo in e.settings.teams().items()},
            "seeds": [e.settings.seed + k for k in range(e.settings.seeds)],
            "diverged": {str(seed): found.step for seed, found in e.diverged.items()},
        }
        for e in entrants
    }
    chosen = {key: getattr(options, key) for key in ("pairing", "episodes", "deterministic", "seed")}
    settings = {**chosen, "runs": entered}
    facts = {"env": dict(entrants[0].settings.env), **settings, **devices.versions()}
    files.write_json(out / "crossplay.json", facts)


def _kind(own: bool) -> str:
    return "own" if own else "cross"
