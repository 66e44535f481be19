"""The file of a metrics table: one row an interval and seed, read without what is not whole."""

import csv
import io
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np


class MetricsTable(NamedTuple):
    """The whole rows of a table, as text."""

    header: list[str]
    """Names of the columns, "step" first; empty where the table has none."""
    rows: list[list[str]]
    """In the order of the file, without a second row of the same step and seed."""
    damaged: int
    """Lines left out: torn, blank, with other bytes than text, doubled."""

    def columns(self) -> dict[str, np.ndarray]:
        """Columns [rows] of the intervals that all seeds have."""
        seed = self.header.index("seed") if self.rows else 0
        seeds: dict[str, set[str]] = {}
        for row in self.rows:
            seeds.setdefault(row[0], set()).add(row[seed])
        most = max(map(len, seeds.values()), default=0)
        whole = [row for row in self.rows if len(seeds[row[0]]) == most]
        return {name: np.array([float(row[i]) for row in whole]) for i, name in enumerate(self.header)}

    def missing(self, steps: Sequence[int], seeds: int) -> list[int]:
        """Those of the env steps `steps` that not all of so many seeds have a row of."""
        found: dict[int, int] = {}
        for row in self.rows:
            found[int(row[0])] = found.get(int(row[0]), 0) + 1
        return [step for step in steps if found.get(step, 0) < seeds]

    def until(self, step: int) -> "MetricsTable":
        """The rows up to an env step."""
        return self._replace(rows=[row for row in self.rows if int(row[0]) <= step])

    def text(self) -> str:
        """The file's content."""
        return lines([self.header, *self.rows]) if self.header else ""


def parse(data: bytes) -> MetricsTable:
    """Read a table, and leave out every line that is not whole: whatever a kill, a full disk or a power cut left."""
    *written, rest = data.split(b"\n")
    damaged = int(bool(rest))  # a line without an end is torn, however well it reads
    header: list[str] = []
    rows: list[list[str]] = []
    known: set[tuple[str, str]] = set()
    for number, line in enumerate(written):
        fields = _fields(line)
        if number == 0 and fields and fields[0] == "step" and "seed" in fields and len(set(fields)) == len(fields):
            header = fields
        elif header and _whole(fields, len(header)) and (key := (fields[0], fields[header.index("seed")])) not in known:
            known.add(key)
            rows.append(fields)
        else:
            damaged += 1
    return MetricsTable(header, rows, damaged)


def row_lines(row: Mapping[str, np.ndarray], header: bool) -> str:
    """The lines of one interval, a line for each seed. row: columns [seeds]; header: begin with the columns' names."""
    table: list[Sequence[Any]] = [list(row)] if header else []
    return lines([*table, *zip(*(map(number, column) for column in row.values()), strict=True)])


def lines(rows: Sequence[Sequence[Any]]) -> str:
    """Rows as CSV."""
    file = io.StringIO(newline="")
    csv.writer(file).writerows(rows)
    return file.getvalue()


def number(value: Any) -> str:
    """A number as the table has it: nine digits give every float32 back exactly."""
    return str(value) if isinstance(value, int | np.integer) else f"{value:.9g}"


def _fields(line: bytes) -> list[str]:
    try:
        text = line.decode()
    except UnicodeDecodeError:
        return []
    return text.removesuffix("\r").split(",") if "\0" not in text else []


def _whole(fields: Sequence[str], count: int) -> bool:
    if len(fields) != count:
        return False
    try:
        int(fields[0])
        list(map(float, fields))
        return True
    except ValueError:
        return False
