"""What a run shows while it goes: a bar on a terminal, a line every now and then elsewhere."""

import sys
import time

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn

from matd3_jax.training import Row

SECONDS_BETWEEN_LINES = 10


class ProgressBar:
    """Env steps/s, updates/s (both over all seeds), time left, and each team's mean return with its spread over seeds:
    in training and, behind it, in the last evaluation.

    Rates and time left are measured from the end of the first chunk on, which holds the compilation; evaluations count.

    Args:
        row: where the run stands.
    """

    def __init__(self, total_steps: int, seeds: int, row: Row):
        self.total, self.seeds = total_steps, seeds
        step = int(row["step"][0])
        self.first = self.last = (time.monotonic(), step, int(row["updates"][0]))
        self.evaluation: Row = {}
        self._note_evaluation(row)
        self.warm = False
        self.printed = 0.0
        self.console = Console(file=sys.stdout)
        self.bar: Progress | None = None
        if self.console.is_terminal:
            columns = TextColumn("{task.percentage:>3.0f}%"), BarColumn(20), TextColumn("{task.description}")
            self.bar = Progress(*columns, console=self.console, refresh_per_second=4)
            self.task = self.bar.add_task("compiling", total=total_steps, completed=step)
            self.bar.start()

    def show(self, row: Row) -> None:
        """Tell of one more chunk."""
        now, step, updates = time.monotonic(), int(row["step"][0]), int(row["updates"][0])
        self.last = (now, step, updates)
        self._note_evaluation(row)
        text = f"{step:,}/{self.total:,} env steps"
        if self.warm:
            seconds = now - self.first[0]
            rate = (step - self.first[1]) * self.seeds / seconds
            left = (self.total - step) * seconds / max(1, step - self.first[1])
            text += f" | {rate:,.0f} env steps/s, {(updates - self.first[2]) * self.seeds / seconds:,.0f} updates/s"
            text += f" | {_duration(left)} left"
        else:
            self.warm, self.first = True, self.last
        for name in row:
            if name.startswith("return_"):
                text += f" | {name.removeprefix('return_')} {_spread(row[name])}"
                if f"eval_{name}" in self.evaluation:
                    text += f" (evaluation {_spread(self.evaluation[f'eval_{name}'])})"
        if self.bar is not None:
            self.bar.update(self.task, completed=step, description=text)
        elif now - self.printed >= SECONDS_BETWEEN_LINES or step >= self.total:
            print(f"{100 * step / self.total:3.0f}% {text}", flush=True)
            self.printed = now

    def rates(self) -> dict[str, float]:
        """Env steps/s and updates/s over all seeds since the first chunk; empty before the second."""
        seconds = self.last[0] - self.first[0]
        if seconds <= 0:
            return {}
        return {
            "env_steps_per_second": (self.last[1] - self.first[1]) * self.seeds / seconds,
            "updates_per_second": (self.last[2] - self.first[2]) * self.seeds / seconds,
        }

    def _note_evaluation(self, row: Row) -> None:
        found = {name: values for name, values in row.items() if name.startswith("eval_return_")}
        if not any(np.isnan(values).any() for values in found.values()):
            self.evaluation = found or self.evaluation

    def stop(self) -> None:
        if self.bar is not None:
            self.bar.stop()


def _spread(values: np.ndarray) -> str:
    values = values[~np.isnan(values)]
    if not len(values):
        return "-"  # no episode ended
    return f"{values.mean():.1f}" + (f" ± {values.std(ddof=1):.1f}" if len(values) > 1 else "")


def _duration(seconds: float) -> str:
    minutes, seconds = divmod(round(seconds), 60)
    return f"{minutes}:{seconds:02d}" if minutes < 60 else f"{minutes // 60}:{minutes % 60:02d}:{seconds:02d}"
