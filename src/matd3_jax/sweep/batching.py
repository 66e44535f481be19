"""Settings into runs, and runs into batches: what is trained together in one program and fits the memory."""

import dataclasses
import json
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from matd3_jax import config as configuration
from matd3_jax.config import HYPER_PARAMS, AlgoConfig, Config
from matd3_jax.config.schema import UNSHARED
from matd3_jax.errors import UserError


def program(config: Config) -> str:
    """A text that is the same for all settings whose runs can share one program: all but hyper-parameters, seeds, and
    where and how often files are written."""

    def shape(team: AlgoConfig) -> AlgoConfig:
        free: dict[str, Any] = dict.fromkeys(HYPER_PARAMS, 0.0)
        if isinstance(team.exploration_noise, tuple):
            free["exploration_noise"] = (0.0, 0.0)
        free["target_noise"] = float(team.algorithm().smoothing)  # without noise a program has no smoothing in it
        free["adversarial_step"] = float(team.adversarial)
        return dataclasses.replace(team, **free)

    adversary = None if config.adversary is None else shape(config.adversary)
    return json.dumps(dataclasses.replace(bare(config), algo=shape(config.algo), adversary=adversary).to_dict())


def bare(config: Config) -> Config:
    """The settings without `UNSHARED` (seeds, places), which are None: equal for runs that differ in nothing else."""
    return dataclasses.replace(config, **dict.fromkeys(UNSHARED))  # type: ignore[arg-type]


def missing(config: Config, existing: Mapping[str, Config]) -> tuple[list[str], list[int]]:
    """Which of the `existing` runs have seeds of these settings, and the seeds that none has.

    Raises UserError where two of them have the same seed.
    """
    wanted = config.seed_numbers
    names: list[str] = []
    there: set[int] = set()
    for name, other in existing.items():
        seeds = range(other.seed, other.seed + other.seeds)
        if bare(other) == bare(config) and set(seeds) & set(wanted):
            if there & set(seeds):
                raise UserError(
                    f"several runs have seed {min(there & set(seeds))} of the same settings, {name} among them"
                )
            names.append(name)
            there |= set(seeds)
    return names, [seed for seed in wanted if seed not in there]


def check_seeds(settings: Mapping[str, Config]) -> None:
    """Raise UserError where two settings, given by name, differ in nothing but their seeds and share some."""
    owners: dict[tuple[str, int], str] = {}
    for name, config in settings.items():
        same = json.dumps(bare(config).to_dict())
        for seed in config.seed_numbers:
            owner = owners.setdefault((same, seed), name)
            if owner != name:
                raise UserError(
                    f"{owner} and {name} are the same settings and both have seed {seed}: sweep another key, or give "
                    "values of seed= that are at least seeds= apart"
                )


def consecutive(seeds: Sequence[int], longest: int) -> list[tuple[int, int]]:
    """(first seed, number of seeds) of runs of consecutive seeds, of nearly equal length and none above `longest`."""
    found: list[tuple[int, int]] = []
    for seed in seeds:
        if found and found[-1][0] + found[-1][1] == seed:
            found[-1] = (found[-1][0], found[-1][1] + 1)
        else:
            found.append((seed, 1))
    cut = []
    for first, number in found:
        parts = math.ceil(number / longest)
        ends = [first + number * k // parts for k in range(parts + 1)]
        cut += [(a, b - a) for a, b in zip(ends, ends[1:], strict=False)]
    return cut


def batches(
    settings: Mapping[str, Config], existing: Mapping[str, Config], folder: Path, fitting: Callable[[Config], int]
) -> list[list[Config]]:
    """Runs yet to be trained, grouped into batches: each a program of its own, that fits the memory.

    A setting whose seeds do not fit at once becomes several runs; otherwise it stays whole.

    Args:
        settings: by name; a run's name is its setting's, with its seeds where there are several.
        existing: runs already there, or planned, by name.
        folder: where the runs will be (their `out`).
        fitting: how many seeds of such settings fit into the memory.
    """
    by_program: dict[str, list[Config]] = {}
    most: dict[str, int] = {}
    for name, config in settings.items():
        found, seeds = missing(config, existing)
        if not seeds:
            continue
        key = program(config)
        if key not in most:
            most[key] = fitting(config)
        cut = consecutive(seeds, most[key])
        for first, number in cut:
            label = name if not found and len(cut) == 1 else f"{name}-seeds_{first}_to_{first + number - 1}"
            run = dataclasses.replace(config, seed=first, seeds=number, name=label, out=str(folder))
            by_program.setdefault(key, []).append(run)
    return [batch for key, runs in by_program.items() for batch in packed(runs, most[key])]


def packed(runs: Sequence[Config], most: int) -> list[list[Config]]:
    """Runs in order, whole, in as few batches as hold at most `most` seeds each, evenly filled."""

    def filled(limit: int) -> list[list[Config]]:
        found: list[list[Config]] = []
        for run in runs:
            if not found or sum(other.seeds for other in found[-1]) + run.seeds > limit:
                found.append([])
            found[-1].append(run)
        return found

    number = len(filled(most))
    least = max(math.ceil(sum(run.seeds for run in runs) / number), *(run.seeds for run in runs))
    return next(found for limit in range(least, most + 1) if len(found := filled(limit)) == number)


def existing_runs(folder: Path) -> dict[str, Config]:
    """Settings of the run directories in a folder, by name."""
    if not folder.is_dir():
        return {}
    found = sorted(path for path in folder.iterdir() if (path / "config.yaml").is_file())
    return {path.name: configuration.read(path / "config.yaml") for path in found}
