"""Population-based training (Jaderberg et al. 2017): members that do worst go on from copies of those that do best.

The settings of a sweep are the members of a population, and each of its seeds is a population of its own, in which
nothing depends on the others. At a selection the worst members of a population copy one of the best (`training.copying`
says what) and explore its hyper-parameters. All members are trained in one compiled program, which takes the
hyper-parameters as an argument.
"""

import dataclasses
import functools
import json
from collections.abc import Mapping, MutableMapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from matd3_jax import config
from matd3_jax.config import HYPER_PARAMS, Config
from matd3_jax.config.schema import UNSHARED
from matd3_jax.errors import UserError
from matd3_jax.runs.divergence import Divergence
from matd3_jax.runtime import files
from matd3_jax.sweep import batching
from matd3_jax.sweep.lineage import Lineage
from matd3_jax.sweep.search_space import Axis, SearchSpace
from matd3_jax.training.copying import Copier
from matd3_jax.training.rows import Row
from matd3_jax.training.session import TrainingSession
from matd3_jax.training.state import TrainState

CHECKPOINT = "population.json"
"""In a checkpoint: the lineage up to there, and the latest scores."""


@dataclasses.dataclass(frozen=True)
class Rules:
    """How a population is selected and explored.

    Attributes:
        every: env steps between selections.
        fraction: of the members that copy, and of those that are copied; at least one.
        explore: "perturb" the copied values, or "resample" them from the search space.
        replay: members that copy take the replay rows, too.
        seed: of the random choices.
        overrides: search space and settings, as they were given.
        metric: column of the metrics table by which is selected; the more the better.
        settings: the members' values of the swept keys at the start, by name.
        start: env steps before which there is no selection (the paper's members are not *ready* before).
    """

    every: int
    fraction: float
    explore: str
    replay: bool
    seed: int
    overrides: tuple[str, ...]
    metric: str
    settings: Mapping[str, Mapping[str, str]]
    start: int = 0

    def due(self, before: int, step: int) -> bool:
        """Whether a selection comes after an interval from env step `before` to `step`."""
        return step // self.every != before // self.every and step >= self.start

    @property
    def facts(self) -> dict[str, Any]:
        """What sweep.json keeps under "pbt"."""
        own = ("every", "fraction", "explore", "replay", "seed", "start")
        return {**{name: getattr(self, name) for name in own}, "overrides": list(self.overrides)}

    @classmethod
    def of(cls, facts: Mapping[str, Any]) -> "Rules | None":
        """Those of a sweep's facts; None where it has no populations."""
        if not facts.get("pbt"):
            return None
        own = {**facts["pbt"], "overrides": tuple(facts["pbt"]["overrides"])}
        return cls(**own, metric=str(facts["metric"]), settings=facts["settings"])


def select(
    scores: np.ndarray, diverged: np.ndarray, fraction: float, rng: np.random.Generator
) -> list[tuple[int, int]]:
    """Choose by truncation which members copy which: pairs (member, the one that it copies).

    The worst `fraction` copy, each a random one of the best `fraction`, of those with a higher score. A member without
    a score ranks below all that have one, one that diverged below these; all that diverged copy. Nobody copies where
    nobody has a score, or all have the same: before learning starts members play alike.

    Args:
        scores: [members], the more the better; nan where there is none.
        diverged: [members].
    """
    number = max(1, int(fraction * len(scores) + 1e-9))
    standing = np.where(diverged, 0, np.where(np.isnan(scores), 1, 2))
    ascending = np.lexsort((scores, standing))
    losers = ascending[: max(number, int(diverged.sum()))].tolist()
    best = [m for m in ascending[::-1][:number].tolist() if standing[m] == 2 and m not in losers]
    pairs = []
    for loser in losers:
        better = [m for m in best if standing[loser] < 2 or scores[m] > scores[loser]]
        if better:
            pairs.append((loser, better[rng.integers(len(better))]))
    return pairs


def explored(axes: Sequence[Axis], values: Sequence[str], how: str, rng: np.random.Generator) -> tuple[str, ...]:
    """Values of the swept keys near `values` ("perturb"), or anywhere in the search space ("resample")."""
    if how == "resample":
        return tuple(axis.draw(rng) for axis in axes)
    return tuple(axis.perturb(value, rng) for axis, value in zip(axes, values, strict=True))


class Population:
    """The populations of a batch, while it trains.

    Args:
        training: the batch; its seeds are those of the first setting, then those of the second, ...
        diverged: the places of the seeds that have diverged; those that copy others leave it.
        path: of the lineage's table.
    """

    def __init__(self, rules: Rules, training: TrainingSession, diverged: MutableMapping[int, Divergence], path: Path):
        self.rules, self.training, self.diverged, self.path = rules, training, diverged, path
        space = SearchSpace.parse(rules.overrides)
        self.axes = space.axes
        names, seeds = tuple(str(member.name) for member in training.members), tuple(training.config.seed_numbers)
        self.lineage = Lineage(tuple(axis.key for axis in self.axes), names, seeds)
        self.scores = np.full((len(names), len(seeds)), np.nan)
        """[settings, seeds] the latest of each member; nan where there was none yet."""
        self.copier = Copier(training.trainer)
        self._settings = functools.cache(functools.partial(load, space))

    @property
    def shape(self) -> tuple[int, int]:
        """(settings, seeds)."""
        return self.scores.shape  # type: ignore[return-value]

    def begin(self, row: Row) -> None:
        """Start the lineage with the values that the settings have; row: of the untrained networks."""
        self._note(row)
        seeds = len(self.lineage.seeds)
        values = [[tuple(self.rules.settings[name].values())] * seeds for name in self.lineage.settings]
        self.lineage.add(int(row["step"][0]), self._own(), values, self.scores.copy())
        self.lineage.write(self.path)

    def __call__(self, state: TrainState, row: Row, before: int) -> TrainState:
        """The state after an interval, with copies where a selection is due; row: of the interval, from env step
        `before` on. At the end of the run there is none: it would change what is ranked and nothing would follow."""
        self._note(row)
        step = int(row["step"][0])
        if not self.rules.due(before, step) or step >= self.training.total_steps:
            return state
        settings, seeds = self.shape
        lost = np.isin(np.arange(settings * seeds), list(self.diverged)).reshape(self.shape)
        parents, values = self._own(), [list(one) for one in self.lineage.values[-1]]
        for s, number in enumerate(self.lineage.seeds):
            # From the seed and the env step alone: a run that is resumed makes the same choices.
            rng = np.random.default_rng([self.rules.seed, step, number])
            for member, parent in select(self.scores[:, s], lost[:, s], self.rules.fraction, rng):
                parents[member, s] = parent
                values[member][s] = explored(self.axes, values[parent][s], self.rules.explore, rng)
        self.lineage.add(step, parents, values, np.where(lost, np.nan, self.scores))
        self.lineage.write(self.path)
        self.scores = np.take_along_axis(self.scores, parents, axis=0)
        sources = {
            int(k) * seeds + int(s): int(parents[k, s]) * seeds + int(s)
            for k, s in np.argwhere(parents != self._own())
        }  # fmt: skip
        return self._copied(state, sources)

    def _copied(self, state: TrainState, sources: Mapping[int, int]) -> TrainState:
        if not sources:
            return state
        # What networks that were not finite did may stand in the replay and in the environments.
        lost = [place for place in sources if place in self.diverged]
        replay = list(sources) if self.rules.replay else lost
        state = self.copier.copy(state, sources, replay, () if self.training.env.on_host else lost)
        for place in lost:
            del self.diverged[place]
        self._apply()
        return state

    def _apply(self) -> None:
        """Train on with the values that the lineage ends with."""
        values = self.lineage.values[-1]
        self.training.change_hyper([self._settings(own) for member in values for own in member])

    def _note(self, row: Row) -> None:
        found = np.asarray(row[self.rules.metric], np.float64).reshape(self.shape)
        self.scores = np.where(np.isnan(found), self.scores, found)

    def _own(self) -> np.ndarray:
        settings, seeds = self.shape
        return np.tile(np.arange(settings)[:, None], (1, seeds))

    # ---- checkpoints -------------------------------------------------------------------------------------------------

    def write(self, folder: Path) -> Path:
        """Leave what resuming needs in a checkpoint's folder."""
        files.write_json(folder / CHECKPOINT, {"lineage": self.lineage.table(), "scores": self.scores.tolist()})
        return folder / CHECKPOINT

    def restore(self, folder: Path) -> None:
        """Go on from a checkpoint. Raises UserError where it does not fit."""
        try:
            found = json.loads((folder / CHECKPOINT).read_text(encoding="utf-8"))
            lineage = Lineage.of_table(found["lineage"])
            scores = np.array(found["scores"], np.float64)  # null is nan
        except (OSError, ValueError, LookupError, TypeError) as error:
            raise UserError(f"cannot read the population in {folder}: {error}") from error
        same = (lineage.keys, lineage.settings, lineage.seeds) == (
            self.lineage.keys, self.lineage.settings, self.lineage.seeds
        )  # fmt: skip
        if not same or scores.shape != self.shape:
            raise UserError(f"the population in {folder} does not fit this sweep")
        self.lineage, self.scores = lineage, scores
        self.lineage.write(self.path)
        self._apply()

    def facts(self, setting: int) -> dict[str, Any]:
        """What summary.json says of a setting: for each seed the schedule of the networks that it ended with."""
        keys, seeds = self.lineage.keys, self.lineage.seeds
        schedules = {str(seed): self.lineage.schedule(setting, s) for s, seed in enumerate(seeds)}
        return {"population": {seed: [stage.facts(keys) for stage in stages] for seed, stages in schedules.items()}}


def load(space: SearchSpace, values: Sequence[str]) -> Config:
    """The settings of a member with these values of the swept keys. Raises UserError."""
    swept = (f"{axis.key}={value}" for axis, value in zip(space.axes, values, strict=True))
    return config.load([*space.fixed, *swept])


# ---- what can be a population ----------------------------------------------------------------------------------------


def check(rules: Rules, settings: Mapping[str, Config]) -> None:
    """Raise UserError where the settings, by name, cannot be the members of a population."""
    space = SearchSpace.parse(rules.overrides)
    if len(settings) < 2:
        raise UserError("pbt=true: a population has several members: sweep a hyper-parameter, e.g. algo.lr=0.01,0.003")
    first = next(iter(settings))
    begun = tuple(rules.settings[first].values())
    for place, axis in enumerate(space.axes):
        # All that a member may come to: the list, or the ends of the interval.
        values = axis.values or tuple(repr(int(end) if axis.whole else end) for end in (axis.low, axis.high))
        for value in values:
            shown = f"{axis.key}={value}"
            try:
                found = load(space, [*begun[:place], value, *begun[place + 1 :]])
            except UserError as error:
                raise UserError(f"pbt=true: members may come to {shown}: {error}") from error
            if _apart(found) != _apart(settings[first]):
                raise UserError(
                    f"pbt=true: {shown} is not trained in one program with {axis.key}={begun[place]}: members may "
                    f"differ in {', '.join(HYPER_PARAMS)} alone, and not in whether there is any target noise, "
                    "adversarial step or range of exploration noise"
                )
    session = TrainingSession(settings[first])
    interval = session.interval_steps
    ends = range(session.trainer.schedule.warmup_steps, session.total_steps, interval)  # none at the end of the run
    if not any(rules.due(before, step) for before, step in zip(ends, ends[1:], strict=False)):
        which = f"pbt_every={rules.every}" + (f" pbt_start={rules.start}" if rules.start else "")
        raise UserError(
            f"{which}: nobody would ever copy: of the logging intervals of {interval:,} env steps the last but one "
            f"ends at {ends[-1]:,}"
        )


def _apart(config: Config) -> tuple[Any, ...]:
    """What all members have in common: their program, seeds and files."""
    return batching.program(config), *(getattr(config, name) for name in UNSHARED)
