"""Runs that meet in a cross-play: their teams from checkpoints, and what every two of them play."""

import dataclasses
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from matd3_jax import envs
from matd3_jax.config import Config
from matd3_jax.config.diff import text
from matd3_jax.envs.environment import Environment
from matd3_jax.errors import UserError
from matd3_jax.evaluation import cross_play
from matd3_jax.evaluation.cross_play import TEAMS, Team
from matd3_jax.evaluation.cross_play_table import Pairings, pairs_of
from matd3_jax.runs import divergence
from matd3_jax.runs.directory import RunDirectory
from matd3_jax.runs.divergence import Divergence
from matd3_jax.runtime import devices
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


def load(
    where: Sequence[Path], which: int | str | None, matched: bool, episodes: int
) -> tuple[list[Entrant], Environment]:
    """Load the teams of runs, and the environment that all have in common.

    Args:
        where: run directories.
        which: env step of the checkpoint, of all runs; None: the last of each; "best" (see `saved_policies.load`).
        matched: whether the first seed of one run is going to play the first of the other, and so on.
        episodes: that each pair is going to play, for the memory.

    Raises UserError where they cannot meet, or do not fit the memory.
    """
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
            here, there = text(one), text(two)
            raise UserError(f"runs of different environments cannot meet: env.{name}={here} in {a}, {there} in {b}")


def play(
    entrants: Sequence[Entrant],
    env: Environment,
    matched: bool,
    episodes: int,
    deterministic: bool,
    seed: int,
    shown: Callable[[Sequence[tuple[int, int]]], Iterable[tuple[int, int]]] = iter,
) -> Pairings:
    """Play every run's agents against every run's adversaries.

    Args:
        matched, episodes: as for `load`.
        deterministic, seed: as for `cross_play.play`.
        shown: goes through the pairs of runs, and may show how far it is.
    """
    weights = np.array([np.where(np.array(env.teams) == team, env.return_weights, 0.0) for team in TEAMS])
    cells = [(i, j) for i in range(len(entrants)) for j in range(len(entrants))]
    runs, seeds, returns = [], [], []
    for i, j in shown(cells):
        pairs = pairs_of(entrants[i].settings.seeds, entrants[j].settings.seeds, matched)
        pairs = pairs[np.isin(pairs[:, 0], entrants[i].sound) & np.isin(pairs[:, 1], entrants[j].sound)]
        teams = [entrants[i].teams["agents"], entrants[j].teams["adversaries"]]
        played = cross_play.play(env, teams, pairs, episodes, deterministic, seed)
        runs.append(np.broadcast_to((i, j), pairs.shape))
        seeds.append(pairs)
        returns.append(played @ weights.T)
    return Pairings(np.concatenate(runs), np.concatenate(seeds), np.concatenate(returns), matched)
