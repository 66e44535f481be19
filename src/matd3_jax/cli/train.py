"""`python -m matd3_jax.train env=simple_spread algo=matd3 seeds=4`: train, and leave a run directory."""

import time
from collections.abc import Sequence
from pathlib import Path

from matd3_jax import config
from matd3_jax.cli import arguments, command, options
from matd3_jax.config import Config
from matd3_jax.errors import UserError
from matd3_jax.runtime import devices, multihost, slurm
from matd3_jax.runtime.terminal import say
from matd3_jax.training.recording import Recorder


def main(argv: Sequence[str]) -> int:
    """Run the command; the exit code."""
    given = arguments.TRAIN.parse(argv)
    if given.cfg:
        print(config.text(config.load(given.settings, arguments.TRAIN.keys)), end="")
        return 0
    devices.prepare()
    with multihost.start(given.processes()) as processes:
        processes.check_same(" ".join(text for text in argv if options.key(text) not in slurm.KEYS), "settings")
        recorder = Recorder(processes, heed_signals=True, say=say)
        if given.resume is not None:
            recorded = recorder.resume(given.resume, given.checkpoint, _total_steps(given.settings))
        elif given.checkpoint is not None:
            raise UserError("checkpoint= goes with resume=RUN_DIR")
        else:
            settings = config.load(given.settings, arguments.TRAIN.keys)
            recorded = recorder.start(settings, Path(settings.out) / (settings.name or _name(settings)))
        path, outcome = recorded.directory.path, recorded.outcome
        everywhere = processes.broadcast(len(outcome.diverged) == recorded.training.share.total)
        if outcome.finished:
            recorder.say(f"evaluate with: {command.line('matd3_jax.evaluate', run=path)}")
            return command.DIVERGED if everywhere else 0
        step = recorded.training.step(outcome.state)
        line = command.line("matd3_jax.train", resume=path)
        if outcome.stopped is None:
            recorder.say(f"stopped at env step {step:,} since a seed diverged; go on with: {line}")
            return command.DIVERGED
        recorder.say(f"stopped by {outcome.stopped.name} at env step {step:,}; resume with: {line}")
        return 128 + outcome.stopped


def _total_steps(overrides: Sequence[str]) -> int | None:
    """The one setting that a resumed run may change."""
    for text in overrides:
        if options.key(text) != "total_steps":
            raise UserError(f"cannot take {text!r} with resume=: a run keeps its settings; only total_steps may change")
    value = next((override.value() for override in reversed(config.parse(overrides))), None)
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float) or value % 1:
        raise UserError(f"total_steps={value}: must be a whole number")
    return int(value)


def _name(settings: Config) -> str:
    """A name for a run without one: what it trains, and when; another one where a run has it already."""
    against = f"-vs-{settings.adversary.name}" if settings.adversary else ""
    name = f"{settings.env['name']}-{settings.algo.name}{against}-{time.strftime('%Y%m%d-%H%M%S')}"
    found, number = name, 2
    while (Path(settings.out) / found).exists():
        found, number = f"{name}-{number}", number + 1
    return found
