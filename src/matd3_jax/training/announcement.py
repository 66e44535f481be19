"""What is said of a run before it trains, and at its end."""

from collections.abc import Mapping
from typing import Any

from matd3_jax.config import diff
from matd3_jax.runs import divergence, overestimation, summary
from matd3_jax.runs.directory import RunDirectory
from matd3_jax.runs.divergence import Divergence
from matd3_jax.runtime import devices
from matd3_jax.training import cost, memory, starting
from matd3_jax.training.session import TrainingSession

ENGINES = {"c": "C MuJoCo", "mjx": "MuJoCo in JAX", "mjx_fast": "MuJoCo in JAX with brax's approximate settings"}
"""What a robot's `physics` may be."""

SHOWN = 8
"""Seeds, at most, whose best evaluations are reported."""


def first_lines(training: TrainingSession, run: RunDirectory, done: int = 0) -> list[str]:
    """Say what is going to be trained from env step `done` on, with what, and how long it may take."""
    settings, trainer = training.config, training.trainer
    kinds = ", ".join(dict.fromkeys(device.device_kind for device in trainer.mesh.devices.flat))
    several = f" in each of {training.processes.size} processes" if training.processes.size > 1 else ""
    diagnostics = settings.diagnostics
    note = overestimation.tail_note(trainer.hyper, diagnostics.q_bias_steps) if diagnostics.q_bias else None
    return [
        f"run directory: {run.path}",
        f"{title(training)}, seeds {settings.seed} to {settings.seed + settings.seeds - 1}, "
        f"{training.total_steps:,} env steps each, on {trainer.mesh.size} x {kinds}{several}",
        *_robot_lines(training),
        *starting.lines(settings),
        f"schedule: {settings.num_envs} x {settings.rollout_length} env steps, then {settings.updates_per_collect} "
        f"updates with {settings.batch_size} transitions",
        memory.of_replay(training.trainer, training.processes),
        cost.expectation(training, done),
        *([f"note: {note}"] if note else []),
    ]


def last_lines(
    training: TrainingSession, run: RunDirectory, found: dict[str, Any], diverged: Mapping[int, Divergence]
) -> list[str]:
    """Say what a finished run's summary holds, and of which seeds."""
    settings = training.config
    lines = [f"seed {seed} diverged at env step {one.step:,}: {one.what}" for seed, one in diverged.items()]
    if not run.table().rows:
        lost = f"{run.metrics} has no rows: there are no means and no learning curve; see matd3_jax.evaluate"
        return [*lines, lost]
    left = settings.seeds - len(diverged)
    over = f"(95 % interval over {settings.seeds} seeds)"
    if diverged and not left:
        return [*lines, "all seeds diverged: there are no means", f"learning curve: {run.curve}"]
    if diverged:
        others = "the other seed" if left == 1 else f"the other {left} seeds"
        lines[-1] += f"; all means are over {others}"
        over = f"(95 % interval over {left} of {settings.seeds} seeds)"
    for team, final in found["last_tenth"].items():
        lines.append(f"mean training return of {team} over the last tenth: {summary.text(final, over)}")
    if training.eval_every:
        lines.append(f"last evaluation ({settings.eval_episodes} deterministic episodes of each seed):")
        of_agents = {f"{agent}_return" for agent in training.layout.agents}
        for name, final in found.get("last_evaluation", {}).items():
            if name not in of_agents:
                lines.append(f"  {name}: {summary.text(final, over)}")
    best = found.get("best_evaluation", {})
    if 0 < len(best) <= SHOWN:
        shown = (f"seed {seed}: {one['mean_return']:.4g} at env step {one['step']:,}" for seed, one in best.items())
        lines.append(f"best evaluation of each seed (checkpoint=best plays it): {', '.join(shown)}")
    if settings.diagnostics.q_bias:
        agents, rollouts = training.layout.learning_agents, settings.diagnostics.q_bias_rollouts
        lines += overestimation.lines(divergence.without(run.read_metrics(), diverged), agents, rollouts)
        lines.append(f"estimated and true values: {run.q_bias}")
    return [*lines, f"learning curve: {run.curve}"]


def title(training: TrainingSession) -> str:
    """The environment and the algorithms of a run in a few words."""
    teams = {team: training.config.teams()[team] for team in training.layout.teams}
    names = [f"{'frozen ' * algo.frozen}{algo.name}" for algo in teams.values()]
    return f"{diff.environment(training.config)}: " + " against ".join(dict.fromkeys(names))


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
