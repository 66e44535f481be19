"""`matd3_jax.train`: a run from Python."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from matd3_jax import config as configuration
from matd3_jax.config import Config
from matd3_jax.envs.environment import Environment
from matd3_jax.runtime import devices
from matd3_jax.training.loggers import CallbackLogger, HistoryLogger, Logger
from matd3_jax.training.loop import TrainState
from matd3_jax.training.run import run
from matd3_jax.training.session import Row, TrainingSession


@dataclasses.dataclass
class Result:
    """What `train` returns."""

    config: Config
    training: TrainingSession
    state: TrainState
    """Everything trained, leading axis [seeds] (see `loop.TrainState`)."""
    metrics: dict[str, np.ndarray]
    """Columns of the metrics table, each [seeds, intervals]; "step" is env steps of each seed."""

    def evaluate(self, episodes: int = 100, deterministic: bool = True, seed: int = 0) -> np.ndarray:
        """Undiscounted returns [seeds, episodes, agents] of whole episodes (see `TrainingSession.evaluate`)."""
        return self.training.evaluate(self.state, episodes, deterministic, seed).episode_return


def train(
    *overrides: str,
    env: str | Environment = "simple_spread",
    algo: str = "matd3",
    callback: Callable[[Row], None] | None = None,
    loggers: Sequence[Logger] = (),
    **settings: Any,
) -> Result:
    """Train `seeds` runs side by side and return their states and metrics.

    Takes what the command line takes: `train(env="simple_tag", algo="matd3", adversary="maddpg", seeds=8)`, and
    single values as strings: `train("algo.lr=0.003", "env.num_good=2", ...)`. Writes no files.

    Args:
        env: a name, or an `Environment` of your own.
        callback: called with every interval's row (columns [seeds]) as it comes.
        loggers: get the same rows, and are closed at the end (see `training.loggers.Logger`).

    Raises UserError for settings that are unknown or impossible.

    Example:
        >>> small = dict(total_steps=300, learning_starts=100, batch_size=16, log_every=100, eval_every=0)
        >>> result = train("algo.hidden=[8]", env="simple_spread", algo="matd3", seeds=2, num_envs=2, **small)
        >>> result.metrics["step"][0].tolist()
        [50, 150, 250, 350]
        >>> result.metrics["return_agents"].shape, result.evaluate(episodes=3).shape
        ((2, 4), (2, 3, 3))
    """
    devices.prepare()
    own = None if isinstance(env, str) else env
    chosen = [f"algo={algo}", *(f"{key}={_text(value)}" for key, value in settings.items()), *overrides]
    config = configuration.load(chosen if own is not None else [f"env={env}", *chosen])
    if own is not None:
        config = dataclasses.replace(config, env={"name": type(own).__name__})
    training = TrainingSession(config, own)
    state, row = training.start()
    history = HistoryLogger(row)
    every = [history, *loggers, *([] if callback is None else [CallbackLogger(callback)])]
    for logger in every[1:]:
        logger.log(row)
    outcome = run(training, state, row, every)
    return Result(config, training, outcome.state, stack(history.rows))


def stack(rows: list[Row]) -> dict[str, np.ndarray]:
    """Columns [seeds, intervals] of rows with columns [seeds]."""
    return {name: np.stack([row[name] for row in rows], axis=1) for name in rows[0]}


def _text(value: Any) -> str:
    """A value in Hydra's grammar."""
    if value is None:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, Mapping):
        return "{" + ",".join(f"{k}:{_text(v)}" for k, v in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ",".join(map(_text, value)) + "]"
    return str(value)
