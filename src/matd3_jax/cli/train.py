"""`python -m matd3_jax.train env=simple_spread algo=matd3 seeds=4`: train, and leave a run directory."""

import time
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from matd3_jax import config
from matd3_jax.cli import arguments, command, options
from matd3_jax.config import Config
from matd3_jax.errors import UserError
from matd3_jax.figures import learning_curves, q_bias
from matd3_jax.runs import overestimation, summary
from matd3_jax.runs.directory import RunDirectory
from matd3_jax.runtime import devices, multihost, slurm
from matd3_jax.runtime.multihost import Processes
from matd3_jax.runtime.signals import Stop
from matd3_jax.training import checkpoint, cost
from matd3_jax.training import run as training_run
from matd3_jax.training.loggers import Logger, TableLogger, TensorBoardLogger
from matd3_jax.training.loop import TrainState
from matd3_jax.training.progress import ProgressBar
from matd3_jax.training.session import Row, TrainingSession

ENGINES = {"c": "C MuJoCo", "mjx": "MuJoCo in JAX", "mjx_fast": "MuJoCo in JAX with brax's approximate settings"}
"""What a robot's `physics` may be."""


def main(argv: Sequence[str]) -> int:
    """Run the command; the exit code."""
    given = arguments.TRAIN.parse(argv)
    if given.cfg:
        print(config.text(config.load(given.settings, arguments.TRAIN.keys)), end="")
        return 0
    devices.prepare()
    with multihost.start(given.processes()) as processes:
        processes.check_same(" ".join(text for text in argv if options.key(text) not in slurm.KEYS), "settings")
        if given.resume is not None:
            return resume(given.resume, given.checkpoint, given.settings, processes)
        if given.checkpoint is not None:
            raise UserError("checkpoint= goes with resume=RUN_DIR")
        return start(config.load(given.settings, arguments.TRAIN.keys), processes)


def start(settings: Config, processes: Processes) -> int:
    """A fresh run."""
    training = TrainingSession(settings, processes=processes)
    training.check_memory()
    if settings.tensorboard:
        TensorBoardLogger.check()
    path = Path(settings.out) / (settings.name or _name(settings))
    if processes.first:
        RunDirectory.check_new(path)
    # The descriptions come from processes that have found that they can train: nothing is written before.
    machine = {"versions": devices.versions(), **processes.description()}
    if processes.first:
        run = RunDirectory.create(path, settings, machine)
        _announce(training, run)
    run = RunDirectory(processes.same_directory(path))
    stop = Stop()
    state, row = training.start()
    if processes.first:
        run.append(row)
    return _advance(training, run, state, row, stop)


def resume(path: Path, step: int | None, overrides: Sequence[str], processes: Processes) -> int:
    """Go on with a run from a checkpoint."""
    for text in overrides:
        if options.key(text) != "total_steps":
            raise UserError(f"cannot take {text!r} with resume=: a run keeps its settings; only total_steps may change")
    changed = {override.key_or_group: override.value() for override in config.parse(overrides)}
    run, settings = RunDirectory.open(path)
    settings = config.from_dict({**settings.to_dict(), **changed})
    training = TrainingSession(settings, processes=processes)
    saved = Path(processes.tell(str(checkpoint.verify(run.checkpoints, step)) if processes.first else None))
    done = int(saved.name)
    if done >= training.total_steps:
        raise UserError(f"{path} is at env step {done:,} of {training.total_steps:,}: to go on, raise total_steps=")
    training.check_memory()
    if settings.tensorboard:
        TensorBoardLogger.check()
    if processes.first:
        _announce(training, run, done)
        print(f"going on from the checkpoint of env step {done:,}", flush=True)
    stop = Stop()
    state = checkpoint.restore(saved, training.trainer, training.share)
    processes.barrier()  # the files are changed only when all have what they need
    if processes.first:
        config.write(settings, run.path / "config.yaml")
        run.cut(done)
    row = {"step": np.array([done]), "updates": np.array([training.trainer.updates(int(state.rollouts))])}
    return _advance(training, run, state, row, stop)


def _advance(training: TrainingSession, run: RunDirectory, state: TrainState, row: Row, stop: Stop) -> int:
    """Train to the end, or until a signal comes, and say what came of it. Of several processes the first alone speaks,
    in files and on the terminal."""
    settings, begun, first = training.config, time.monotonic(), training.processes.first
    loggers: list[Logger] = []
    if first:
        progress = ProgressBar(training, row)
        loggers = [TableLogger([run]), progress, *([TensorBoardLogger([run])] if settings.tensorboard else [])]

    def save(state: TrainState, step: int) -> None:
        keep = settings.keep_checkpoints
        checkpoint.save(run.checkpoints, step, training.trainer, state, keep, share=training.share)

    outcome = training_run.run(training, state, row, loggers, save, stop)
    step = int(outcome.row["step"][0])
    save(outcome.state, step)
    if first:
        _draw(training, run)
    if outcome.stopped is not None:
        if first:
            line = command.line("matd3_jax.train", resume=run.path)
            print(f"stopped by {outcome.stopped.name} at env step {step:,}; go on with: {line}")
        return 128 + outcome.stopped
    if first:
        _finish(training, run, outcome.row, {"seconds": round(time.monotonic() - begun, 1), **progress.rates()})
    return 0


def _draw(training: TrainingSession, run: RunDirectory) -> None:
    """The figures of a run."""
    metrics = run.read_metrics()
    learning_curves.learning_curve(run.curve, metrics, _title(training))
    if training.config.diagnostics.q_bias:
        q_bias.draw(run.q_bias, metrics, training.layout.by_team(), _title(training))


def _finish(training: TrainingSession, run: RunDirectory, row: Row, times: Mapping[str, float]) -> None:
    """The summary of a run, in its file and on the terminal."""
    settings, metrics = training.config, run.read_metrics()
    facts = summary.summary(metrics, row, **times)
    over = f"(95 % interval over {settings.seeds} seeds)"
    for team, final in facts["last_tenth"].items():
        print(f"mean training return of {team} over the last tenth: {summary.text(final, over)}")
    if training.eval_every:
        print(f"last evaluation ({settings.eval_episodes} deterministic episodes of each seed):")
        for name in (name for name in row if name.startswith("eval_")):
            print(f"  {name.removeprefix('eval_')}: {summary.text(summary.final(row[name]), over)}")
    if settings.diagnostics.q_bias:
        facts["overestimation"] = overestimation.summary(metrics, training.layout.agents)
        for line in overestimation.lines(metrics, training.layout.agents, settings.diagnostics.q_bias_rollouts):
            print(line)
        print(f"estimated and true values: {run.q_bias}")
    run.write_summary(facts)
    print(f"learning curve: {run.curve}\nevaluate with: {command.line('matd3_jax.evaluate', run=run.path)}")


def _announce(training: TrainingSession, run: RunDirectory, done: int = 0) -> None:
    """What is going to be trained, from env step `done` on."""
    settings, trainer = training.config, training.trainer
    kinds = ", ".join(dict.fromkeys(device.device_kind for device in trainer.mesh.devices.flat))
    several = f" in each of {training.processes.size} processes" if training.processes.size > 1 else ""
    print(f"run directory: {run.path}")
    print(f"{_title(training)}, seeds {settings.seed} to {settings.seed + settings.seeds - 1}, "
          f"{training.total_steps:,} env steps each, on {trainer.mesh.size} x {kinds}{several}")  # fmt: skip
    for line in _robot_lines(training):
        print(line)
    print(f"schedule: {settings.num_envs} x {settings.rollout_length} env steps, then {settings.updates_per_collect} "
          f"updates with {settings.batch_size} transitions")  # fmt: skip
    print(training.memory, flush=True)
    print(cost.expectation(training, done), flush=True)
    diagnostics = settings.diagnostics
    if diagnostics.q_bias and (note := overestimation.tail_note(trainer.hyper, diagnostics.q_bias_steps)):
        print(f"note: {note}", flush=True)


def _robot_lines(training: TrainingSession) -> list[str]:
    """What is chosen for robots alone: the recipe of the settings, and the engine."""
    lines, recipe = [], getattr(training.config, "recipe", None)
    if recipe is not None and "forward_velocity" in training.env.measures:
        others = {"paper": "for the paper's settings", "wide": "for many environments at a time"}
        if not devices.accelerated():
            del others["wide"]
        hints = "".join(f"; {what}: recipe={name}" for name, what in others.items() if name != recipe)
        lines.append(f"recipe: {recipe}{hints}")
    physics = getattr(cost.innermost(training.env), "physics", None)
    if physics is not None:
        meaning = ENGINES.get(str(physics))
        lines.append(f"physics: {physics}" + (f" ({meaning})" if meaning else ""))
    return lines


def _title(training: TrainingSession) -> str:
    teams = dict.fromkeys(training.layout.teams)
    names = [f"{training.config.teams()[team].name}" for team in teams]
    return f"{training.config.env['name']}: " + " against ".join(dict.fromkeys(names))


def _name(settings: Config) -> str:
    against = f"-vs-{settings.adversary.name}" if settings.adversary else ""
    return f"{settings.env['name']}-{settings.algo.name}{against}-{time.strftime('%Y%m%d-%H%M%S')}"
