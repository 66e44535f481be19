"""What a metrics table lacks, in words."""

from collections.abc import Sequence
from typing import NamedTuple

from matd3_jax.runs.metrics_table import MetricsTable


class Expected(NamedTuple):
    """What the table of a run should have up to an env step."""

    columns: Sequence[str]
    seeds: range
    first: int
    """Env step of the first row."""
    interval: int
    """Env steps between rows; 0: not known."""

    def seen(self, table: MetricsTable) -> MetricsTable:
        """The table without rows of seeds that the run does not have."""
        return table.of_seeds(self.seeds)

    def gaps(self, table: MetricsTable, done: int) -> list[tuple[int, int]]:
        """Pairs of env steps up to `done` between which rows are missing."""
        if not done or (table.rows and not self.interval):
            return []
        return self.seen(table).until(done).gaps(self.first, done, self.interval, len(self.seeds))

    def lines(self, table: MetricsTable, done: int) -> list[str]:
        """Say what the table has lost up to env step `done`, a line for each kind of loss."""
        table, lines = self.seen(table), []
        if table.damaged:
            lines.append(f"{table.damaged} damaged line{'s' * (table.damaged > 1)}, left out")
        unknown = [name for name in self.columns if name not in table.header]
        if table.rows and unknown:
            shown = ", ".join(unknown[:3]) + (", ..." if len(unknown) > 3 else "")
            lines.append(f"no column{'s' * (len(unknown) > 1)} {shown}: nan in the rows so far")
        gaps = self.gaps(table, done)
        if gaps:
            shown = ", ".join(f"{a:,} and {b:,}" for a, b in gaps[:3]) + (", ..." if len(gaps) > 3 else "")
            lines.append(f"lacks rows between env steps {shown}: they are lost, the training is not")
        return lines
