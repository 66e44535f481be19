"""The file of a metrics table: one row an interval and seed, read without what is not whole."""

import bisect
import itertools
import re
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

COUNTS = ("step", "seed", "updates", "episodes")
"""Columns of whole numbers."""

_COUNT = re.compile(r"0|[1-9][0-9]{0,17}")
_NUMBER = re.compile(r"-?(0|[1-9][0-9]*)(\.[0-9]+)?([eE][+-][0-9]{2,3})?|-?inf|nan")
"""As numbers are written, here and in spreadsheets; Python's `float` also takes " 1", "1_0" and "1e5", which a changed
byte makes of other numbers."""


class MetricsTable(NamedTuple):
    """The whole rows of a table, as text."""

    header: list[str]
    """Names of the columns, "step" first; empty where the table has none."""
    rows: list[list[str]]
    """Ascending by step, then by seed."""
    damaged: int
    """Lines left out: torn, blank, with other bytes than text, doubled, in no place where they can be right."""

    def columns(self) -> dict[str, np.ndarray]:
        """Columns [rows] of the intervals that all seeds have: as many as there are at most, the same in most of them.
        Where it cannot be said which seeds these are, there is no row."""
        seed = self.header.index("seed") if self.rows else 0
        seeds: dict[str, frozenset[str]] = {}
        for step, rows in itertools.groupby(self.rows, key=lambda row: row[0]):
            seeds[step] = frozenset(row[seed] for row in rows)
        most = max(map(len, seeds.values()), default=0)
        often = Counter(found for found in seeds.values() if len(found) == most).most_common(2)
        known = often and (len(often) == 1 or often[0][1] > often[1][1])
        whole = [row for row in self.rows if known and seeds[row[0]] == often[0][0]]
        return {name: np.array([float(row[i]) for row in whole]) for i, name in enumerate(self.header)}

    def of_seeds(self, seeds: Collection[int]) -> "MetricsTable":
        """The rows of these seeds; those of others are damaged."""
        seed = self.header.index("seed") if self.rows else 0
        rows = [row for row in self.rows if int(row[seed]) in seeds]
        return self._replace(rows=rows, damaged=self.damaged + len(self.rows) - len(rows))

    def with_columns(self, names: Sequence[str]) -> "MetricsTable":
        """The same rows with these columns, in this order; nan where the table has none of a name."""
        places = [self.header.index(name) if name in self.header else None for name in names]
        rows = [["nan" if place is None else row[place] for place in places] for row in self.rows]
        return self._replace(header=list(names), rows=rows)

    def gaps(self, first: int, last: int, interval: int, seeds: int) -> list[tuple[int, int]]:
        """Pairs of env steps between which rows are missing: from the step of the last row before to the next.

        A run that was lengthened has intervals of several lengths; a gap is longer than all that are usual.

        Args:
            first, last: the steps that the first and the last row should have.
            interval: env steps between rows now.
            seeds: how many there are; an interval that not all have a row of is missing.
        """
        found: dict[int, int] = {}
        for row in self.rows:
            found[int(row[0])] = found.get(int(row[0]), 0) + 1
        steps = sorted(step for step, count in found.items() if count >= seeds and first <= step <= last)
        usual = max(interval, int(np.median(np.diff(steps))) if len(steps) > 1 else 0)
        if not steps:
            return [(0, last)]
        gaps = [(0, steps[0])] if steps[0] > first else []
        gaps += [(a, b) for a, b in itertools.pairwise(steps) if b - a > usual]
        return gaps + ([(steps[-1], last)] if steps[-1] < last else [])

    def until(self, step: int) -> "MetricsTable":
        """The rows up to an env step."""
        return self._replace(rows=[row for row in self.rows if int(row[0]) <= step])

    def text(self) -> str:
        """The file's content."""
        return lines([self.header, *self.rows]) if self.header else ""


def parse(data: bytes) -> MetricsTable:
    """Read a table, and leave out every line that is not whole: whatever a kill, a full disk or a power cut left.

    Rows ascend by step, then by seed. Of lines that cannot all be right, as they do not ascend, those are left out that
    any of the ways to leave out fewest leaves out.
    """
    *written, rest = data.split(b"\n")
    damaged = int(bool(rest))  # a line without an end is torn, however well it reads
    header: list[str] = []
    rows: list[list[str]] = []
    known: set[bytes] = set()
    counts: list[int] = []
    end = True
    """Whether lines end with a carriage return, too."""
    for number, line in enumerate(written):
        fields = _fields(line)
        if number == 0:
            end = line[-1:] == b"\r"
        if number == 0 and fields and fields[0] == "step" and "seed" in fields and len(set(fields)) == len(fields):
            header = fields
            counts = [header.index(name) for name in COUNTS if name in header]
        elif header and (line[-1:] == b"\r") == end and line not in known and _whole(fields, len(header), counts):
            known.add(line)
            rows.append(fields)
        else:
            damaged += 1
    seed = header.index("seed") if header else 0
    keep = _ascending([(int(row[0]), int(row[seed])) for row in rows])
    return MetricsTable(header, list(itertools.compress(rows, keep)), damaged + keep.count(False))


def row_lines(row: Mapping[str, np.ndarray], header: bool) -> str:
    """The lines of one interval, a line for each seed. row: columns [seeds]; header: begin with the columns' names."""
    table: list[Sequence[Any]] = [list(row)] if header else []
    return lines([*table, *zip(*(map(number, column) for column in row.values()), strict=True)])


def lines(rows: Sequence[Sequence[Any]]) -> str:
    """Rows as CSV; no field needs quotation marks (`envs.check` sees to the names of agents)."""
    return "".join(",".join(map(str, row)) + "\r\n" for row in rows)


def number(value: Any) -> str:
    """A number as the table has it: nine digits give every float32 back exactly."""
    return str(value) if isinstance(value, int | np.integer) else f"{value:.9g}"


def _fields(line: bytes) -> list[str]:
    try:
        text = line.decode()
    except UnicodeDecodeError:
        return []
    return text.removesuffix("\r").split(",") if "\0" not in text else []


def _whole(fields: Sequence[str], count: int, counts: Sequence[int]) -> bool:
    """Whether these are the fields of a row of `count` columns, with whole numbers in the columns `counts`."""
    if len(fields) != count or not all(map(_NUMBER.fullmatch, fields)):
        return False
    return all(_COUNT.fullmatch(fields[place]) for place in counts)


def _ascending(keys: Sequence[tuple[int, int]]) -> list[bool]:
    """Which keys are in every longest strictly ascending subsequence."""
    if all(a < b for a, b in itertools.pairwise(keys)):
        return [True] * len(keys)
    before = _lengths(keys)
    after = _lengths([(-step, -seed) for step, seed in reversed(keys)])[::-1]
    longest = max(before)
    on_one = [a + b == longest + 1 for a, b in zip(before, after, strict=True)]
    alternatives = Counter(itertools.compress(before, on_one))
    return [on and alternatives[length] == 1 for on, length in zip(on_one, before, strict=True)]


def _lengths(keys: Sequence[tuple[int, int]]) -> list[int]:
    """Of the longest strictly ascending subsequence that ends with each key."""
    ends: list[tuple[int, int]] = []  # the least last key of the subsequences of each length
    found = []
    for key in keys:
        place = bisect.bisect_left(ends, key)
        ends[place : place + 1] = [key]
        found.append(place + 1)
    return found
