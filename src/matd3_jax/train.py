"""`python -m matd3_jax.train env=simple_spread algo=matd3 seeds=4`: train, and leave a run directory."""

import sys
import time
import types
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from matd3_jax import checkpoint, command, config, devices, outcome, overestimation, plotting
from matd3_jax import training as training_module
from matd3_jax.config import Config
from matd3_jax.errors import UserError
from matd3_jax.progress import ProgressBar
from matd3_jax.runs import RunDirectory
from matd3_jax.stopping import Stop
from matd3_jax.trainer import TrainState
from matd3_jax.training import Training

HELP = """usage: python -m matd3_jax.train [env=NAME] [algo=NAME] [adversary=NAME] [schedule=wide] [key=value ...]
       python -m matd3_jax.train resume=RUN_DIR [checkpoint=STEP] [total_steps=N]
       python -m matd3_jax.train --cfg [key=value ...]     print the resolved settings and stop

environments: {envs}
algorithms:   {algos}

settings and their defaults (those of a file: env.KEY=value, algo.KEY=value, adversary.KEY=value); robots bring others
along, which --cfg env=ant prints:

{settings}"""


def main(argv: Sequence[str]) -> int:
    """Run the command; the exit code."""
    if {"-h", "--help"} & set(argv):
        settings = (Path(__file__).parent / "conf" / "config.yaml").read_text()
        names = {"envs": ", ".join(config.known_names("env")), "algos": ", ".join(config.known_names("algo"))}
        print(HELP.format(settings=settings.split("\n\n", 2)[2], **names))
        return 0
    if "--cfg" in argv:
        print(config.text(config.load([a for a in argv if a != "--cfg"])), end="")
        return 0
    devices.prepare()
    taken, overrides = config.take(argv, ("resume", "checkpoint"))
    if taken.get("resume") is not None:
        return resume(Path(str(taken["resume"])), taken.get("checkpoint"), overrides)
    if taken.get("checkpoint") is not None:
        raise UserError("checkpoint= goes with resume=RUN_DIR")
    return start(config.load(overrides))


def start(settings: Config) -> int:
    """A fresh run."""
    training = Training(settings)
    training.check_memory()
    _tensorboard_writer(settings, None)
    path = Path(settings.out) / (settings.name or _name(settings))
    machine = {"versions": devices.versions(), **devices.description()}
    run = RunDirectory.create(path, settings, machine)
    _announce(training, run)
    stop = Stop()
    state, row = training.start()
    run.append(row)
    return _advance(training, run, state, row, stop)


def resume(path: Path, step: Any, overrides: Sequence[str]) -> int:
    """Go on with a run from a checkpoint."""
    changed, rest = config.take(overrides, ("total_steps",))
    if rest:
        raise UserError(f"cannot take {rest[0]!r} with resume=: a run keeps its settings; only total_steps may change")
    if step is not None and type(step) is not int:
        raise UserError(f"checkpoint={step!r}: must be the env step of a checkpoint")
    run, settings = RunDirectory.open(path)
    settings = config.from_dict({**settings.to_dict(), **changed})
    training = Training(settings)
    saved = checkpoint.verify(run.checkpoints, step)
    done = int(saved.name)
    if done >= training.total_steps:
        raise UserError(f"{path} is at env step {done:,} of {training.total_steps:,}: to go on, raise total_steps=")
    training.check_memory()
    _tensorboard_writer(settings, None)
    _announce(training, run)
    print(f"going on from the checkpoint of env step {done:,}", flush=True)
    stop = Stop()
    state = checkpoint.restore(saved, training.trainer)
    config.write(settings, run.path / "config.yaml")
    run.cut(done)
    row = {"step": np.array([done]), "updates": np.array([training.trainer.updates(int(state.collects))])}
    return _advance(training, run, state, row, stop)


def _advance(training: Training, run: RunDirectory, state: TrainState, row: dict[str, np.ndarray], stop: Stop) -> int:
    """Chunk after chunk to the end, or until a signal comes."""
    settings, begun = training.config, time.monotonic()
    step = int(row["step"][0])
    progress = ProgressBar(training.total_steps, settings.seeds, row)
    writer = _tensorboard_writer(settings, run)
    every = training.total_steps / 5 if settings.checkpoint_every is None else settings.checkpoint_every
    saved = step
    try:
        while step < training.total_steps and stop.signal is None:
            state, row = training.advance(state)
            step = int(row["step"][0])
            run.append(row)
            progress.show(row)
            if writer is not None:
                _to_tensorboard(writer, row)
            if every and step - saved >= every and step < training.total_steps:
                checkpoint.save(run.checkpoints, step, training.trainer, state, settings.keep_checkpoints)
                saved = step
    finally:
        progress.stop()
        if writer is not None:
            writer.close()
    checkpoint.save(run.checkpoints, step, training.trainer, state, settings.keep_checkpoints)
    metrics = run.read_metrics()
    plotting.learning_curve(run.curve, metrics, _title(training))
    if settings.diagnostics.q_bias:
        overestimation.draw(run.q_bias, metrics, training.spec.by_team(), _title(training))
    if stop.signal is not None and step < training.total_steps:
        print(f"stopped by {stop.signal.name} at env step {step:,}; go on with: "
              f"python -m matd3_jax.train resume={run.path}")  # fmt: skip
        return 128 + stop.signal
    summary = outcome.summary(metrics, row, seconds=round(time.monotonic() - begun, 1), **progress.rates())
    over = f"(95 % interval over {settings.seeds} seeds)"
    for team, final in summary["last_tenth"].items():
        print(f"mean training return of {team} over the last tenth: {outcome.text(final, over)}")
    if training.eval_every:
        print(f"last evaluation ({settings.eval_episodes} deterministic episodes of each seed):")
        for name in (name for name in row if name.startswith("eval_")):
            print(f"  {name.removeprefix('eval_')}: {outcome.text(outcome.final(row[name]), over)}")
    if settings.diagnostics.q_bias:
        summary["overestimation"] = overestimation.summary(metrics, training.spec.agents)
        for line in overestimation.lines(metrics, training.spec.agents, settings.diagnostics.q_bias_rollouts):
            print(line)
        print(f"estimated and true values: {run.q_bias}")
    run.write_summary(summary)
    print(f"learning curve: {run.curve}\nevaluate with: python -m matd3_jax.evaluate run={run.path}")
    return 0


def _announce(training: Training, run: RunDirectory) -> None:
    settings, trainer = training.config, training.trainer
    kinds = ", ".join(dict.fromkeys(device.device_kind for device in trainer.mesh.devices.flat))
    print(f"run directory: {run.path}")
    print(f"{_title(training)}, seeds {settings.seed} to {settings.seed + settings.seeds - 1}, "
          f"{training.total_steps:,} env steps each, on {trainer.mesh.size} x {kinds}")  # fmt: skip
    print(f"schedule: {settings.num_envs} x {settings.rollout_length} env steps, then {settings.updates_per_collect} "
          f"updates with {settings.batch_size} transitions")  # fmt: skip
    print(training.memory, flush=True)
    diagnostics = settings.diagnostics
    if diagnostics.q_bias and (note := overestimation.tail_note(trainer.hyper, diagnostics.q_bias_steps)):
        print(f"note: {note}", flush=True)


def _title(training: Training) -> str:
    teams = dict.fromkeys(training.spec.teams)
    names = [f"{training.config.teams()[team].name}" for team in teams]
    return f"{training.config.env['name']}: " + " against ".join(dict.fromkeys(names))


def _name(settings: Config) -> str:
    against = f"-vs-{settings.adversary.name}" if settings.adversary else ""
    return f"{settings.env['name']}-{settings.algo.name}{against}-{time.strftime('%Y%m%d-%H%M%S')}"


def _tensorboard_writer(settings: Config, run: RunDirectory | None) -> Any:
    """A writer if asked for; with run None only the check that there can be one. Raises UserError."""
    if not settings.tensorboard:
        return None
    try:
        from tensorboardX import SummaryWriter
    except ImportError:
        raise UserError("tensorboard=true needs tensorboardX: pip install 'matd3_jax[tensorboard]'") from None
    return None if run is None else SummaryWriter(str(run.tensorboard))


def _to_tensorboard(writer: Any, row: dict[str, np.ndarray]) -> None:
    for name, values in row.items():
        if name not in ("step", "seed") and not np.isnan(values).all():
            for seed, value in zip(row["seed"], values, strict=True):
                writer.add_scalar(f"{name}/seed_{seed}", value, int(row["step"][0]))


class _Callable(types.ModuleType):
    """`matd3_jax.train(...)` goes on to be the function, also where somebody has imported this module."""

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        return training_module.train(*args, **kwargs)


sys.modules[__name__].__class__ = _Callable

if __name__ == "__main__":
    command.run(main)
