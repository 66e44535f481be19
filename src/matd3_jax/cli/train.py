"""`python -m matd3_jax.train env=simple_spread algo=matd3 seeds=4`: train, and leave a run directory."""

import time
from collections.abc import Sequence
from pathlib import Path

from matd3_jax import config
from matd3_jax.cli import arguments, catalog, command, options
from matd3_jax.config import Config, diff, effect
from matd3_jax.errors import UserError
from matd3_jax.runs.paths import as_part, inside
from matd3_jax.runtime import devices, multihost, slurm
from matd3_jax.runtime.terminal import say
from matd3_jax.training.recorded_run import Recorded
from matd3_jax.training.recording import Recorder

UNPICKLE = "env.pickle=true"
"""Given with resume=, it says that environments which the run pickled are to be trusted."""


def main(argv: Sequence[str]) -> int:
    """Run the command; the exit code."""
    given = catalog.TRAIN.parse(argv)
    if given.cfg:
        say(config.text(config.load(given.settings, catalog.TRAIN.keys)), end="")
        return 0
    devices.prepare()
    with multihost.start(given.processes()) as processes:
        processes.check_same(" ".join(text for text in argv if options.key(text) not in slurm.KEYS), "settings")
        recorder = Recorder(processes, heed_signals=True, say=say)
        with command.resumable("matd3_jax.train", lambda: recorder.path):
            recorded = _train(recorder, given)
        path, outcome = recorded.directory.path, recorded.outcome
        everywhere = processes.broadcast(len(outcome.diverged) == recorded.training.share.total)
        if outcome.finished:
            recorder.say(f"evaluate with: {command.line('matd3_jax.evaluate', run=path)}")
            return command.DIVERGED if everywhere else 0
        step = recorded.training.step(outcome.state)
        trusted = [UNPICKLE] if recorded.training.config.env.get("pickle") is True else []
        line = command.line("matd3_jax.train", *trusted, resume=path)
        if outcome.stopped is None:
            recorder.say(f"stopped at env step {step:,} since a seed diverged; resume with: {line}")
            return command.DIVERGED
        recorder.say(f"stopped by {outcome.stopped.name} at env step {step:,}; resume with: {line}")
        return 128 + outcome.stopped


def _train(recorder: Recorder, given: arguments.Train) -> Recorded:
    if given.resume is not None:
        others = [text for text in given.settings if text != UNPICKLE]
        unpickle = len(others) < len(given.settings)
        return recorder.resume(given.resume, given.checkpoint, _total_steps(others), unpickle=unpickle)
    if given.checkpoint is not None:
        raise UserError("checkpoint= goes with resume=RUN_DIR")
    settings = config.load(given.settings, catalog.TRAIN.keys)
    effect.check(given.settings, [settings])
    name = settings.name or _name(settings)
    return recorder.start(settings, inside(Path(settings.out), name, "name"), or_another=not settings.name)


def _total_steps(overrides: Sequence[str]) -> int | None:
    """The one setting that a resumed run may change."""
    for text in overrides:
        if options.key(text) != "total_steps":
            raise UserError(
                f"cannot take {text!r} with resume=: a run keeps its settings; only total_steps may change, and "
                f"{UNPICKLE} says that its pickled environments are to be trusted"
            )
    value = next((override.value() for override in reversed(config.parse(overrides))), None)
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float) or value % 1:
        raise UserError(f"total_steps={value}: must be a whole number")
    return int(value)


def _name(settings: Config) -> str:
    """A name for a run without one: what it trains, and when."""
    against = f"-vs-{settings.adversary.name}" if settings.adversary else ""
    return f"{as_part(diff.environment(settings))}-{settings.algo.name}{against}-{time.strftime('%Y%m%d-%H%M%S')}"
