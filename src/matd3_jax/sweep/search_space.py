"""What a sweep tries: the grid of all combinations, or random draws, from overrides in Hydra's sweep grammar."""

import dataclasses
import fnmatch
import itertools
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from hydra.core.override_parser.types import Glob, IntervalSweep, Override
from hydra.errors import HydraException

from matd3_jax import config
from matd3_jax.errors import UserError

DIGITS = 4
"""Significant digits of a number drawn from an interval: what is written down is what was run."""

DOWN, UP = 0.8, 1.2
"""Factors of a number that is perturbed."""


@dataclasses.dataclass(frozen=True)
class Axis:
    """One swept key: listed values, or an interval of numbers."""

    key: str
    values: tuple[str, ...] = ()
    """In Hydra's grammar; empty for an interval."""
    low: float = 0.0
    high: float = 0.0
    log: bool = False
    """Draw the logarithm uniformly."""
    whole: bool = False

    def draw(self, rng: np.random.Generator) -> str:
        """One value at random, in Hydra's grammar."""
        if self.values:
            return self.values[rng.integers(len(self.values))]
        if self.whole:
            low, high = int(self.low), int(self.high)
            if not self.log:
                return str(rng.integers(low, high + 1))
            return str(min(high, int(math.exp(rng.uniform(math.log(low), math.log(high + 1))))))
        if self.log:
            return f"{math.exp(rng.uniform(math.log(self.low), math.log(self.high))):.{DIGITS}g}"
        return f"{rng.uniform(self.low, self.high):.{DIGITS}g}"

    def perturb(self, value: str, rng: np.random.Generator) -> str:
        """A value near `value`, up or down at random: 0.8 or 1.2 times it, or a neighbor of it in the list; never
        beyond the interval, or the list's ends (Jaderberg et al. 2017, section 4.1)."""
        up = bool(rng.integers(2))
        if self.values:
            ordered = self._ordered()
            place = ordered.index(value) + (1 if up else -1)
            return ordered[min(max(place, 0), len(ordered) - 1)]
        moved = float(value) * (UP if up else DOWN)
        if self.whole:
            near = round(moved) if round(moved) != int(value) else int(value) + (1 if up else -1)
            return str(min(max(near, int(self.low)), int(self.high)))
        # An end is written in full: four digits of it may lie outside.
        return repr(self.low) if moved <= self.low else repr(self.high) if moved >= self.high else f"{moved:.{DIGITS}g}"

    def _ordered(self) -> list[str]:
        """The listed values, numbers by size and others as they are listed."""
        try:
            return sorted(self.values, key=float)
        except ValueError:
            return list(self.values)


@dataclasses.dataclass(frozen=True)
class SearchSpace:
    """Swept keys, and the overrides that all settings share."""

    axes: tuple[Axis, ...]
    fixed: tuple[str, ...]

    @classmethod
    def parse(cls, overrides: Sequence[str]) -> "SearchSpace":
        """From overrides with lists (`algo.lr=0.01,0.003`), `choice(...)`, `range(...)`, `glob(...)` for files, and
        `interval(low,high)`. Raises UserError for an empty or malformed one, or a key swept twice."""
        axes: list[Axis] = []
        fixed = []
        for text, override in zip(overrides, config.parse(overrides, sweep=True), strict=True):
            if override.is_sweep_override():
                axes.append(_axis(text, override))
            else:
                fixed.append(text)
        keys = [axis.key for axis in axes]
        for key in keys:
            if keys.count(key) > 1:
                raise UserError(f"{key} is swept twice")
        return cls(tuple(axes), tuple(fixed))

    @property
    def intervals(self) -> tuple[Axis, ...]:
        return tuple(axis for axis in self.axes if not axis.values)

    @property
    def size(self) -> int:
        """Number of combinations of the listed values."""
        return math.prod(len(axis.values) for axis in self.axes if axis.values)

    def grid(self) -> list[dict[str, str]]:
        """All combinations, {key: value in Hydra's grammar}; the last key varies fastest. Raises UserError where there
        is an interval."""
        if self.intervals:
            raise UserError(f"{self.intervals[0].key} is an interval: say how many settings to draw, e.g. samples=64")
        keys = [axis.key for axis in self.axes]
        return [dict(zip(keys, c, strict=True)) for c in itertools.product(*(axis.values for axis in self.axes))]

    def sample(self, samples: int, seed: int) -> list[dict[str, str]]:
        """`samples` different settings at random. Raises UserError where there are not that many."""
        if not self.axes:
            raise UserError(
                "samples= draws values of swept keys, and there are none, e.g. algo.lr='interval(1e-4,1e-2)'"
            )
        rng = np.random.default_rng(seed)
        if not self.intervals:
            if samples > self.size:
                raise UserError(f"samples={samples}: there are only {self.size} combinations; leave samples= out")
            chosen = np.sort(rng.choice(self.size, samples, replace=False))
            grid = self.grid()
            return [grid[k] for k in chosen]
        found: dict[tuple[str, ...], dict[str, str]] = {}
        for _ in range(100 * samples):
            one = {axis.key: axis.draw(rng) for axis in self.axes}
            found.setdefault(tuple(one.values()), one)
            if len(found) == samples:
                return list(found.values())
        raise UserError(f"samples={samples}: the intervals hold only about {len(found)} different settings")


def _axis(text: str, override: Override) -> Axis:
    key, value = override.key_or_group, override.value()
    if isinstance(value, IntervalSweep):
        return _interval(text, key, value)
    if isinstance(value, Glob):
        names = config.known_names(key)
        if not names:
            raise UserError(f"{text!r}: glob() chooses among files, for {', '.join(config.GROUPS)}")
        values = [n for n in names if any(fnmatch.fnmatch(n, p) for p in value.include)]
        values = [n for n in values if not any(fnmatch.fnmatch(n, p) for p in value.exclude)]
    else:
        try:
            values = list(override.sweep_string_iterator())
        except (HydraException, ValueError) as error:
            raise UserError(f"cannot read {text!r}: {error}") from error
    if not values:
        raise UserError(f"{text!r} is empty: it names no value")
    repeated = next((v for v in values if values.count(v) > 1), None)
    if repeated is not None:
        raise UserError(f"{text!r} names {repeated} twice")
    return Axis(key, tuple(values))


def _interval(text: str, key: str, value: Any) -> Axis:
    low, high = value.start, value.end
    if not (math.isfinite(low) and math.isfinite(high) and low < high):
        raise UserError(f"{text!r} is empty: write interval(low,high) with low < high")
    unknown = value.tags - {"log", "uniform"}
    if unknown or len(value.tags) > 1:
        raise UserError(f"{text!r}: the tag of an interval must be log or uniform")
    if "log" in value.tags and low <= 0:
        raise UserError(f"{text!r}: the logarithm needs low > 0")
    return Axis(key, (), low, high, low > 0 and "uniform" not in value.tags, isinstance(low, int))


def names(axes: Sequence[Axis], settings: Sequence[dict[str, str]]) -> list[str]:
    """A short name for each setting, `lr_0.01-tau_0.005`, that can name a folder and stand on a command line."""
    last = [axis.key.rsplit(".", 1)[-1] for axis in axes]
    shorts = [short if last.count(short) == 1 else axis.key for axis, short in zip(axes, last, strict=True)]
    found = []
    for k, setting in enumerate(settings):
        name = "-".join(f"{short}_{value}" for short, value in zip(shorts, setting.values(), strict=True))
        name = "".join(c for c in name.replace(",", "x") if c.isalnum() or c in ".+-_")
        found.append(name if 0 < len(name.encode()) <= 120 else f"setting_{k:04d}")
    return found if len(set(found)) == len(found) else [f"setting_{k:04d}" for k in range(len(found))]
