"""What a run shows while it goes: a bar on a terminal, a line every now and then elsewhere."""

import contextlib
import sys
import time
from collections.abc import Iterator, Mapping

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn

from matd3_jax.runs.divergence import Divergence, of_seeds
from matd3_jax.runtime.terminal import say
from matd3_jax.stats.text import plus_minus
from matd3_jax.training.clock import compiling
from matd3_jax.training.rows import Row
from matd3_jax.training.session import TrainingSession

SECONDS_BETWEEN_LINES = 10


class ProgressBar:
    """Env steps/s and updates/s of the training (both over all seeds), the share of the time that evaluations take, the
    time left, and each team's mean return with its spread over seeds: in training and, behind it, in the last
    evaluation.

    Compiling is in none of the rates. The time left has the evaluations to come in it.

    Args:
        row: where the run stands.
        diverged: seeds that are left out of the returns, by their places in the rows, with their divergences; others
            may come into it later.
    """

    def __init__(self, training: TrainingSession, row: Row, diverged: Mapping[int, Divergence] | None = None):
        self.diverged: Mapping[int, Divergence] = {} if diverged is None else diverged
        self.training, self.clock = training, training.clock
        self.total, self.seeds = training.total_steps, training.share.total
        self.step, self.updates = self.begun_step, self.begun_updates = int(row["step"][0]), int(row["updates"][0])
        self.begun = self.now = time.monotonic()
        self.compiled_before = self.compiled = compiling()
        self.trained_before = self.clock.training
        self.evaluated_before = self.clock.evaluation
        self.returns: dict[str, tuple[int, np.ndarray]] = {}
        """The last training return of each team, with its env step."""
        self.evaluation: Row = {}
        self.numbers = np.arange(self.seeds)
        """[seeds] what the seeds are called."""
        self._note(row)
        self.printed = 0.0
        self.console = Console(file=sys.stdout)
        self.bar: Progress | None = None
        if self.console.is_terminal:
            columns = TextColumn("{task.percentage:>3.0f}%"), BarColumn(20), TextColumn("{task.description}")
            self.bar = Progress(*columns, console=self.console, refresh_per_second=4)
            self.task = self.bar.add_task("compiling", total=self.total, completed=self.step)
            with _safely():
                self.bar.start()

    def log(self, row: Row) -> None:
        """Show one more interval."""
        self.now, self.compiled = time.monotonic(), compiling()
        self._note(row)
        text = self.text()
        if self.bar is not None:
            with _safely():
                self.bar.update(self.task, completed=self.step, description=text)
        elif self.now - self.printed >= SECONDS_BETWEEN_LINES or self.step >= self.total:
            say(f"{100 * self.step / self.total:3.0f}% {text}")
            self.printed = self.now

    def text(self) -> str:
        """Where the run stands, in a line."""
        parts = [f"{self.step:,}/{self.total:,} env steps"]
        if self.step > self.begun_step:
            trained = self._trained
            updates = (self.updates - self.begun_updates) * self.seeds / trained
            parts += [f"{self._env_steps / trained:,.0f} env steps/s, {updates:,.0f} updates/s"]
            if self._evaluated > 0:
                parts += [f"evaluations {100 * self._evaluated / self._seconds:.0f} %"]
            parts += [f"{_duration(self._seconds_left)} left"]
        return " | ".join(parts + self._return_texts())

    def rates(self) -> dict[str, float]:
        """Env steps/s and updates/s over all seeds, of all the time but compiling; env steps/s of the training alone;
        the share of evaluations in the time. Empty before the first interval."""
        if self.step == self.begun_step:
            return {}
        return {
            "env_steps_per_second": self._env_steps / self._seconds,
            "updates_per_second": (self.updates - self.begun_updates) * self.seeds / self._seconds,
            "training_env_steps_per_second": self._env_steps / self._trained,
            "evaluation_share": self._evaluated / self._seconds,
        }

    def close(self) -> None:
        if self.bar is not None:
            with _safely():
                self.bar.stop()

    # ---- time, since the bar began -----------------------------------------------------------------------------------

    @property
    def _env_steps(self) -> int:
        """Of all seeds."""
        return (self.step - self.begun_step) * self.seeds

    @property
    def _seconds(self) -> float:
        """All of them but those of compiling: checkpoints and files are in them."""
        return max(1e-9, self.now - self.begun - (self.compiled - self.compiled_before))

    @property
    def _trained(self) -> float:
        return max(1e-9, self.clock.training - self.trained_before)

    @property
    def _evaluated(self) -> float:
        return self.clock.evaluation - self.evaluated_before

    @property
    def _seconds_left(self) -> float:
        each = (self._seconds - self._evaluated) / (self.step - self.begun_step)
        # The evaluation before the bar counts here: the first interval knows what they take.
        evaluation = self.clock.evaluation / max(1, self.clock.evaluations)
        return max(0, self.total - self.step) * each + self.training.evaluations_after(self.step) * evaluation

    # ---- returns -----------------------------------------------------------------------------------------------------

    def _note(self, row: Row) -> None:
        self.step, self.updates = int(row["step"][0]), int(row["updates"][0])
        self.numbers = row.get("seed", self.numbers)
        for name, values in row.items():
            if name.startswith("return_") and not np.isnan(values).all():
                self.returns[name.removeprefix("return_")] = self.step, values
        evaluation = {name: values for name, values in row.items() if name.startswith("eval_")}
        if not all(np.isnan(values).all() for values in evaluation.values()):
            self.evaluation = evaluation

    def _return_texts(self) -> list[str]:
        """Of each team. Long episodes need not end in an interval: then the return of an earlier one with its env step,
        and before there is one the evaluation alone. Behind them, of which seeds, where some have diverged."""
        whose = [self._whose()] if self.diverged else []
        if len(self.diverged) == self.seeds:
            return whose
        found = []
        teams = [name.removeprefix("eval_return_") for name in self.evaluation if name.startswith("eval_return_")]
        for team in dict.fromkeys([*self.returns, *teams]):
            evaluation = self._evaluation_text(team)
            if team not in self.returns:
                found.append(f"{team}: {evaluation}")
                continue
            step, values = self.returns[team]
            earlier = f" at {step:,}" if step < self.step else ""
            found.append(f"{team} {self._spread(values)}{earlier}" + (f" ({evaluation})" if evaluation else ""))
        return (found or [f"no episode has ended since env step {self.begun_step:,}"]) + whose

    def _whose(self) -> str:
        """Of which seeds the returns are."""
        if len(set(self.numbers.tolist())) < len(self.numbers):  # of several runs side by side
            return f"{self.seeds - len(self.diverged)} of {self.seeds} seeds, {len(self.diverged)} diverged"
        by_number = {int(self.numbers[place]): found for place, found in sorted(self.diverged.items())}
        return of_seeds(self.seeds, by_number)

    def _evaluation_text(self, team: str) -> str:
        """The team's last evaluation, and how fast a robot went in it; empty before the first."""
        values = self.evaluation.get(f"eval_return_{team}")
        if values is None:
            return ""
        speed = self.evaluation.get("eval_forward_velocity")
        metres = "" if speed is None else f", {self._sound(speed).mean():.2f} m/s"
        return f"evaluation {self._spread(values)}{metres}"

    def _sound(self, values: np.ndarray) -> np.ndarray:
        """Without seeds that diverged."""
        return np.delete(values, [place for place in self.diverged if place < len(values)])

    def _spread(self, values: np.ndarray) -> str:
        """Mean, and standard deviation over the seeds that have not diverged; of how many, where an episode has not
        ended with all of them."""
        sound = self._sound(values)
        ended = sound[~np.isnan(sound)]
        if not len(ended):
            return "nan"
        fewer = f", {len(ended)} of {len(sound)} seeds" if len(ended) < len(sound) else ""
        return plus_minus(ended.mean(), ended.std(ddof=1) if len(ended) > 1 else None, ".1f", ".1f") + fewer


@contextlib.contextmanager
def _safely() -> Iterator[None]:
    """Continue where the terminal is gone or lacks the letters: showing progress ends no run."""
    with contextlib.suppress(OSError, ValueError):
        yield


def _duration(seconds: float) -> str:
    minutes, seconds = divmod(round(seconds), 60)
    return f"{minutes}:{seconds:02d}" if minutes < 60 else f"{minutes // 60}:{minutes % 60:02d}:{seconds:02d}"
