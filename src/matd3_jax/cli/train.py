"""`python -m matd3_jax.train env=simple_spread algo=matd3 seeds=4`: train, and leave a run directory."""

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from matd3_jax import config
from matd3_jax.config import Config
from matd3_jax.errors import UserError
from matd3_jax.figures import learning_curves, q_bias
from matd3_jax.runs import overestimation, summary
from matd3_jax.runs.directory import RunDirectory
from matd3_jax.runtime import devices, multihost, slurm
from matd3_jax.runtime.multihost import Processes
from matd3_jax.runtime.signals import Stop
from matd3_jax.training import checkpoint, cost
from matd3_jax.training.loop import TrainState
from matd3_jax.training.progress import ProgressBar
from matd3_jax.training.session import Row, TrainingSession

HELP = """usage: python -m matd3_jax.train [env=NAME] [algo=NAME] [adversary=NAME] [recipe=NAME] [key=value ...]
       python -m matd3_jax.train resume=RUN_DIR [checkpoint=STEP] [total_steps=N]
       python -m matd3_jax.train --cfg [key=value ...]     print the resolved settings and stop

environments: {envs}
algorithms:   {algos}
recipes:      {recipes} (of robots; fast by default)

{processes}

settings and their defaults (those of a file: env.KEY=value, algo.KEY=value, adversary.KEY=value); robots bring others
along, which --cfg env=ant prints:

{settings}"""


ENGINES = {"c": "C MuJoCo", "mjx": "MuJoCo in JAX", "mjx_fast": "MuJoCo in JAX with brax's approximate settings"}
"""What a robot's `physics` may be."""


def main(argv: Sequence[str]) -> int:
    """Run the command; the exit code."""
    if {"-h", "--help"} & set(argv):
        settings = (config.FOLDER / "config.yaml").read_text()
        names = {"envs": ", ".join(config.known_names("env")), "algos": ", ".join(config.known_names("algo"))}
        names["recipes"] = ", ".join(config.known_names("recipe"))
        print(HELP.format(settings=settings.split("\n\n", 2)[2], processes=slurm.HELP, **names))
        return 0
    if "--cfg" in argv:
        print(config.text(config.load([a for a in argv if a != "--cfg"])), end="")
        return 0
    devices.prepare()
    given, argv = config.take_text(argv, slurm.KEYS)
    taken, overrides = config.take(argv, ("resume", "checkpoint"))
    with multihost.start(given) as processes:
        processes.check_same(" ".join(argv), "settings")
        if taken.get("resume") is not None:
            return resume(Path(str(taken["resume"])), taken.get("checkpoint"), overrides, processes)
        if taken.get("checkpoint") is not None:
            raise UserError("checkpoint= goes with resume=RUN_DIR")
        return start(config.load(overrides), processes)


def start(settings: Config, processes: Processes) -> int:
    """A fresh run."""
    training = TrainingSession(settings, processes=processes)
    training.check_memory()
    _tensorboard_writer(settings, None)
    path = Path(settings.out) / (settings.name or _name(settings))
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


def resume(path: Path, step: Any, overrides: Sequence[str], processes: Processes) -> int:
    """Go on with a run from a checkpoint."""
    changed, rest = config.take(overrides, ("total_steps",))
    if rest:
        raise UserError(f"cannot take {rest[0]!r} with resume=: a run keeps its settings; only total_steps may change")
    if step is not None and type(step) is not int:
        raise UserError(f"checkpoint={step!r}: must be the env step of a checkpoint")
    run, settings = RunDirectory.open(path)
    settings = config.from_dict({**settings.to_dict(), **changed})
    training = TrainingSession(settings, processes=processes)
    saved = Path(processes.tell(str(checkpoint.verify(run.checkpoints, step)) if processes.first else None))
    done = int(saved.name)
    if done >= training.total_steps:
        raise UserError(f"{path} is at env step {done:,} of {training.total_steps:,}: to go on, raise total_steps=")
    training.check_memory()
    _tensorboard_writer(settings, None)
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
    """Interval after interval to the end, or until a signal comes. Of several processes the first alone tells of the
    run, in files and on the terminal."""
    settings, processes, begun = training.config, training.processes, time.monotonic()
    step = saved = int(row["step"][0])
    report = Report(training, run, row) if processes.first else None
    every = training.total_steps / 5 if settings.checkpoint_every is None else settings.checkpoint_every

    def save() -> None:
        keep = settings.keep_checkpoints
        checkpoint.save(run.checkpoints, step, training.trainer, state, keep, share=training.share)

    try:
        stopped = stop.agreed(processes)
        while step < training.total_steps and stopped is None:
            state, row = training.advance(state)
            step = int(row["step"][0])
            if report is not None:
                report.add(row)
            if every and step - saved >= every and step < training.total_steps:
                save()
                saved = step
            stopped = stop.agreed(processes)
    finally:
        if report is not None:
            report.close()
    save()
    if report is None:
        return 128 + stopped if stopped is not None and step < training.total_steps else 0
    metrics = run.read_metrics()
    learning_curves.learning_curve(run.curve, metrics, _title(training))
    if settings.diagnostics.q_bias:
        q_bias.draw(run.q_bias, metrics, training.layout.by_team(), _title(training))
    if stopped is not None and step < training.total_steps:
        print(f"stopped by {stopped.name} at env step {step:,}; go on with: "
              f"python -m matd3_jax.train resume={run.path}")  # fmt: skip
        return 128 + stopped
    facts = summary.summary(metrics, row, seconds=round(time.monotonic() - begun, 1), **report.progress.rates())
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
    print(f"learning curve: {run.curve}\nevaluate with: python -m matd3_jax.evaluate run={run.path}")
    return 0


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


class Report:
    """What a run tells while it goes: rows of the metrics table, progress, TensorBoard files where asked for."""

    def __init__(self, training: TrainingSession, run: RunDirectory, row: Row):
        self.run, self.progress = run, ProgressBar(training, row)
        self.writer = _tensorboard_writer(training.config, run)

    def add(self, row: Row) -> None:
        """One more interval."""
        self.run.append(row)
        self.progress.show(row)
        if self.writer is not None:
            _to_tensorboard(self.writer, row)

    def close(self) -> None:
        self.progress.stop()
        if self.writer is not None:
            self.writer.close()


def _tensorboard_writer(settings: Config, run: RunDirectory | None) -> Any:
    """A writer if asked for; with run None only the check that there can be one. Raises UserError."""
    if not settings.tensorboard:
        return None
    try:
        from tensorboardX import SummaryWriter
    except ImportError:
        raise UserError("tensorboard=true needs tensorboardX: pip install 'matd3_jax[tensorboard]'") from None
    return None if run is None else SummaryWriter(str(run.tensorboard))


def _to_tensorboard(writer: Any, row: Row) -> None:
    for name, values in row.items():
        if name not in ("step", "seed") and not np.isnan(values).all():
            for seed, value in zip(row["seed"], values, strict=True):
                writer.add_scalar(f"{name}/seed_{seed}", value, int(row["step"][0]))
