"""What teams of the competitive study got against all opponents: files, means over pairings, contrasts of them.

`cross_play.csv` has a row for each task, pairing that the team comes from, pairing that the opponent comes from, and
seed of the team, and in it the team's returns against every seed of the opponent: column sK is its seed K.
"""

import csv
import dataclasses
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from experiments.competitive import PAIRINGS
from matd3_jax.errors import UserError
from matd3_jax.evaluation.cross_play_table import Mean, Pairings
from matd3_jax.runtime import files

KEYS = ("env", "team", "team_met", "single", "single_met", "seed")


@dataclasses.dataclass
class Task:
    """All that was played in one task, one row for each pair of seeds.

    Attributes:
        facts: episodes, whether deterministic, and the runs' checkpoints and seeds.
        runs: [rows, 2] indices in `PAIRINGS` of the pairings that the team and its opponent come from.
        seeds: [rows, 2] indices of the seeds in them.
        returns: [rows] mean return of the team.
    """

    facts: dict[str, Any]
    runs: np.ndarray
    seeds: np.ndarray
    returns: np.ndarray

    def mean(self, pairs: Sequence[tuple[str, str]], own: bool) -> Mean | None:
        """Mean over (algorithm of the team, of the single agent), each run against each weighing the same.

        own: pairs that were trained together, or pairs that were not.
        """
        return self._pairings(self.returns).mean([cell for pair in pairs for cell in self._cells(pair, own)])

    def contrast(self, plus: Sequence[tuple[str, str]], minus: Sequence[tuple[str, str]]) -> tuple[float, float]:
        """Mean over `plus` less mean over `minus`, of strangers: (difference, half width of its 95 % interval).

        With equally many cells on both sides the difference is twice the mean of the cells with their signs; otherwise
        (so few seeds that there are no strangers in a cell) there is no interval: nan.
        """
        first, second = ([cell for pair in pairs for cell in self._cells(pair, False)] for pairs in (plus, minus))
        if len(first) != len(second) or not first:
            means = [
                np.mean([self.returns[cell].mean() for cell in side]) if side else np.nan for side in (first, second)
            ]
            return float(means[0] - means[1]), np.nan
        signed = self.returns.copy()
        signed[np.concatenate(second)] *= -1
        mean = self._pairings(2 * signed).mean([*first, *second])
        assert mean is not None
        return float(mean.value[0]), float(mean.half[0])

    def matrix(self) -> np.ndarray:
        """[pairings, pairings] mean returns of the team between strangers, rows by the team's pairing; nan without."""
        found = np.full((len(PAIRINGS), len(PAIRINGS)), np.nan)
        for i, j in np.ndindex(found.shape):
            rows = self._rows(i, j, False)
            if len(rows):
                found[i, j] = self.returns[rows].mean()
        return found

    def _cells(self, pair: tuple[str, str], own: bool) -> list[np.ndarray]:
        """The rows of each two runs whose team and opponent have these algorithms."""
        team, single = pair
        cells = [
            self._rows(i, j, own)
            for i, (one, _) in enumerate(PAIRINGS)
            for j, (_, other) in enumerate(PAIRINGS)
            if (one, other) == (team, single)
        ]
        return [cell for cell in cells if len(cell)]

    def _rows(self, team: int, single: int, own: bool) -> np.ndarray:
        return np.flatnonzero((self.runs == (team, single)).all(axis=1) & (self._pairings(self.returns).own == own))

    def _pairings(self, returns: np.ndarray) -> Pairings:
        return Pairings(self.runs, self.seeds, np.stack([returns, returns], axis=1), matched=False)


def write(tasks: Mapping[str, Task], table: Path, facts: Path) -> None:
    """Write both files."""
    numbers = {
        env: {pair: task.facts["runs"]["-vs-".join(pair)]["seeds"] for pair in PAIRINGS} for env, task in tasks.items()
    }
    columns = sorted({seed for task in numbers.values() for seeds in task.values() for seed in seeds})
    rows: list[Sequence[Any]] = [(*KEYS, *(f"s{seed}" for seed in columns))]
    for env, task in tasks.items():
        seeds = numbers[env]
        for i, team in enumerate(PAIRINGS):
            for j, single in enumerate(PAIRINGS):
                there = np.flatnonzero((task.runs == (i, j)).all(axis=1))
                found = {tuple(task.seeds[row]): f"{task.returns[row]:.5g}" for row in there}
                for k, seed in enumerate(seeds[team]):
                    cells = {number: found.get((k, m), "") for m, number in enumerate(seeds[single])}
                    # A pairing is (team, single): the opponent's own algorithm is the second, whom it met the first.
                    rows.append((env, *team, *reversed(single), seed, *(cells.get(number, "") for number in columns)))
    files.write_csv(table, rows, line_end="\n")
    files.write_json(facts, {env: task.facts for env, task in tasks.items()})


def of_command(folder: Path, side: int) -> Task:
    """What `python -m matd3_jax.crossplay` left in `folder` of the four pairings of a task.

    Args:
        side: 0 where the team are the agents, 1 where it is the adversaries.

    Raises UserError where it is damaged, or of other runs.
    """
    sides = ("agents", "adversaries") if side == 0 else ("adversaries", "agents")
    try:
        kept = json.loads((folder / "crossplay.json").read_text(encoding="utf-8"))
        pairing = {
            name: PAIRINGS.index((run["algorithms"][sides[0]], run["algorithms"][sides[1]]))
            for name, run in kept["runs"].items()
        }
        if sorted(pairing.values()) != list(range(len(PAIRINGS))):
            raise ValueError("not one run of each pairing")
        numbers = {name: run["seeds"] for name, run in kept["runs"].items()}
        with (folder / "pairs.csv").open(encoding="utf-8", newline="") as file:
            rows = list(csv.DictReader(file))
        runs = [[pairing[row[who]] for who in sides] for row in rows]
        seeds = [[numbers[row[who]].index(int(row[f"{who}_seed"])) for who in sides] for row in rows]
        returns = [float(row[f"return_{sides[0]}"]) for row in rows]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UserError(f"cannot read {folder} as a cross-play of the four pairings: {error!r}") from error
    named = {"-vs-".join(PAIRINGS[pairing[name]]): run for name, run in kept["runs"].items()}
    facts = {"episodes": kept["episodes"], "deterministic": kept["deterministic"]}
    order = ("-vs-".join(pair) for pair in PAIRINGS)
    ours = {name: {key: named[name][key] for key in ("checkpoint", "seeds")} for name in order}
    return Task({**facts, "runs": ours}, np.array(runs), np.array(seeds), np.array(returns))


def read(table: Path, facts: Path) -> dict[str, Task]:
    """What `write` left, by task; nothing if there are no such files. Raises UserError if they are damaged."""
    if not (table.exists() and facts.exists()):
        return {}
    try:
        kept = json.loads(facts.read_text(encoding="utf-8"))
        found: dict[str, tuple[list, list, list]] = {env: ([], [], []) for env in kept}
        with table.open(encoding="utf-8", newline="") as file:
            for row in csv.DictReader(file):
                team, single = (row["team"], row["team_met"]), (row["single_met"], row["single"])
                own, other = (kept[row["env"]]["runs"]["-vs-".join(pair)]["seeds"] for pair in (team, single))
                runs, seeds, returns = found[row["env"]]
                for m, number in enumerate(other):
                    if row[f"s{number}"]:
                        runs.append((PAIRINGS.index(team), PAIRINGS.index(single)))
                        seeds.append((own.index(int(row["seed"])), m))
                        returns.append(float(row[f"s{number}"]))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UserError(f"cannot read {table} with {facts}: {error!r}; remove both") from error
    return {env: Task(kept[env], *map(np.array, parts)) for env, parts in found.items()}
