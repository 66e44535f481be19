"""`matd3_jax.train` and `matd3_jax.resume`: runs from Python."""

import dataclasses
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from matd3_jax import config as configuration
from matd3_jax.config import Config, effect
from matd3_jax.config.schema import TEXTS
from matd3_jax.envs.check import check
from matd3_jax.envs.environment import Environment
from matd3_jax.runs.directory import RunDirectory
from matd3_jax.runtime import devices
from matd3_jax.training import outputs
from matd3_jax.training.given_environment import check_options, check_same, recorded
from matd3_jax.training.loggers import CallbackLogger, DivergenceLogger, HistoryLogger, Logger, warn
from matd3_jax.training.rows import Row
from matd3_jax.training.run import Outcome, run
from matd3_jax.training.session import TrainingSession
from matd3_jax.training.state import TrainState

if TYPE_CHECKING:
    from matd3_jax.export.write import Exported
    from matd3_jax.training.recorded_run import Recorded
    from matd3_jax.training.recording import Recorder


@dataclasses.dataclass
class Result:
    """What `train` and `resume` return."""

    config: Config
    training: TrainingSession
    state: TrainState
    """Everything trained, leading axis [seeds] (see `loop.TrainState`)."""
    metrics: dict[str, np.ndarray]
    """Columns of the metrics table, each [seeds, intervals]; "step" is env steps of each seed."""
    run_dir: Path | None = None
    """Where the run has its files, if it has."""
    diverged: dict[int, int] = dataclasses.field(default_factory=dict)
    """Seeds whose losses, values, returns or networks were not finite, with the env step at which they first were."""

    @devices.standard_numerics()
    def evaluate(self, episodes: int = 100, deterministic: bool = True, seed: int = 0) -> np.ndarray:
        """Undiscounted returns [seeds, episodes, agents] of whole episodes (see `TrainingSession.evaluate`)."""
        return self.training.evaluate(self.state, episodes, deterministic, seed).episode_return

    @devices.standard_numerics()
    def export(self, out: str | Path, format: str = "numpy", seed: int | None = None) -> "Exported":
        """Write each agent's deterministic policy of one seed (default: the first) into a new directory, as the command
        `export` does (see `export.write.export`)."""
        from matd3_jax.export.write import export
        from matd3_jax.training.saved_policies import SavedPolicies

        steps = self.metrics["step"][:, -1].astype(int)
        saved = SavedPolicies(self.state, steps, self.training.finite(self.state), {})
        return export(self.training, saved, self.config.seed if seed is None else seed, format, Path(out))


@devices.standard_numerics()
def train(
    *overrides: str,
    env: str | Environment = "simple_spread",
    algo: str = "matd3",
    run_dir: str | Path | None = None,
    callback: Callable[[Row], None] | None = None,
    loggers: Sequence[Logger] = (),
    **settings: Any,
) -> Result:
    """Train `seeds` runs side by side and return their states and metrics.

    Takes what the command line takes: `train(env="simple_tag", algo="matd3", adversary="maddpg", seeds=8)`, and
    single values as strings: `train("algo.lr=0.003", "env.num_good=2", ...)`.

    Args:
        env: a name, or an `Environment` of your own, which has its options already.
        run_dir: a directory to be made, with everything that the command leaves in one: settings, metrics, checkpoints,
            figures, summary; `resume` trains the run on. None: no files are written.
        callback: called with every interval's row (columns [seeds]) as it comes.
        loggers: get the same rows, and are closed at the end (see `training.loggers.Logger`). An error of theirs is a
            RuntimeWarning and ends no run; one of `callback` does.

    A seed that diverges is reported by a RuntimeWarning, and is in the result's `diverged`.

    Raises UserError for settings that are unknown or impossible, and for an environment that breaks the contract
    (`envs.check`).

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
    if own is not None:
        check(own)
    given = {key: value for key, value in settings.items() if value is not None or key not in TEXTS}
    chosen = [f"algo={algo}", *(f"{key}={_text(value)}" for key, value in given.items()), *overrides]
    if own is not None:
        check_options(own, chosen)
    config = configuration.load(chosen if own is not None else [f"env={env}", *chosen])
    effect.check(chosen, [config])
    if own is not None:
        config = dataclasses.replace(config, env=recorded(own))
    if run_dir is not None:
        return _result(_recorder(loggers, callback).start(config, Path(run_dir), own))
    if config.hands_over:  # the one agent begins with a checkpoint of the agents
        with tempfile.TemporaryDirectory() as folder:
            found = _result(_recorder(loggers, callback).start(config, Path(folder) / "run", own))
        return dataclasses.replace(found, run_dir=None)
    outputs.check(config, recorded=False)
    every: list[Logger] = [outputs.Harmless(logger, warn) for logger in loggers]
    every += [] if callback is None else [CallbackLogger(callback)]
    training = TrainingSession(config, own)
    state, row = training.start()
    history = HistoryLogger(row)
    for logger in every:
        logger.log(row)
    watch = DivergenceLogger(training, warn)
    watch.log(row)
    outcome = run(training, state, row, [history, watch, *every])
    return Result(config, training, outcome.state, stack(history.rows), diverged=_diverged(config, outcome))


@devices.standard_numerics()
def resume(
    run_dir: str | Path,
    *,
    checkpoint: int | None = None,
    total_steps: int | None = None,
    env: Environment | None = None,
    unpickle: bool = False,
    callback: Callable[[Row], None] | None = None,
    loggers: Sequence[Logger] = (),
) -> Result:
    """Train a run on from its last checkpoint, as if it had never been stopped, and return its state and metrics.

    Args:
        run_dir: the run's directory, made by `train(run_dir=...)` or by the command.
        checkpoint: the env step of an older checkpoint to resume from.
        total_steps: env steps of each seed from now on; None: as before.
        env: the environment of a run that was given one as an object, with the same options.
        unpickle: let environments on the host go on from what the run pickled (`env.pickle=true`); what is unpickled
            can run any program, so that the directory must be one to trust. Otherwise they start new episodes.
        callback, loggers: get the rows to come (see `train`).

    Raises UserError where there is no run, it has come to its end, or the checkpoint is damaged.
    """
    devices.prepare()
    if env is not None:
        check(env)
    check_same(RunDirectory.open(Path(run_dir))[1].env, env, run_dir)
    return _result(_recorder(loggers, callback).resume(Path(run_dir), checkpoint, total_steps, env, unpickle))


def _recorder(loggers: Sequence[Logger], callback: Callable[[Row], None] | None) -> "Recorder":
    """Imported here: figures and checkpoints are for runs that leave a directory."""
    from matd3_jax.training.recording import Recorder

    return Recorder(loggers=loggers, callback=callback)


def _result(recorded: "Recorded") -> Result:
    table = recorded.directory.read_metrics()
    seeds = np.unique(table["seed"])
    columns = {name: np.stack([column[table["seed"] == seed] for seed in seeds]) for name, column in table.items()}
    training = recorded.training
    diverged = _diverged(training.config, recorded.outcome)
    return Result(training.config, training, recorded.outcome.state, columns, recorded.directory.path, diverged)


def _diverged(config: Config, outcome: Outcome) -> dict[int, int]:
    return {config.seed + place: found.step for place, found in sorted(outcome.diverged.items())}


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
