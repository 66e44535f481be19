"""`python -m matd3_jax.evaluate run=RUN_DIR`: play whole episodes with the trained policies of every seed."""

from collections.abc import Sequence

import numpy as np
from rich.table import Table

from matd3_jax.cli import catalog
from matd3_jax.core.rollout import Evaluation
from matd3_jax.runs import divergence
from matd3_jax.runs.directory import RunDirectory
from matd3_jax.runtime import devices, files
from matd3_jax.runtime.terminal import show
from matd3_jax.stats.intervals import mean_interval
from matd3_jax.stats.text import plus_minus
from matd3_jax.training import memory, saved_policies
from matd3_jax.training.session import TrainingSession
from matd3_jax.training.state import TrainState


def main(argv: Sequence[str]) -> int:
    """Run the command; the exit code."""
    options = catalog.EVALUATE.parse(argv)
    devices.prepare()
    run, settings = RunDirectory.open(options.run)
    training = TrainingSession(settings)
    seeds_played = training.trainer.sharding.padded_seeds * training.trainer.sharding.devices_per_seed
    memory.check_playing(training.env, training.layout, options.episodes, seeds_played, devices.free_memory())
    saved = saved_policies.load(run, training, options.checkpoint)
    state, diverged, numbers = saved.state, saved.diverged, np.array(settings.seed_numbers)
    sound = ~np.isin(numbers, list(diverged))
    whose = f", of {divergence.of_seeds(settings.seeds, diverged)}" if diverged else ""
    table = Table(title=f"{run.path}, {saved.when}: means of {options.episodes} episodes a seed{whose}")
    seeds = (f"seed {seed}" + (" (diverged)" if seed in diverged else "") for seed in numbers)
    for heading in ("policy", "quantity", *seeds, "mean ± 95 %"):
        table.add_column(heading, justify="left" if heading in ("policy", "quantity") else "right")
    rows = []
    policies = {"deterministic": state, "sampled": state}
    if any(group.actor_average is not None for group in state.groups):
        policies = {"deterministic": state, "online": _online(state), "sampled": state}
    for policy, played in policies.items():
        found = training.evaluate(played, options.episodes, policy != "sampled", options.seed)
        for quantity, by_episode in _quantities(training, found):
            by_seed = by_episode.mean(axis=1)
            interval = plus_minus(*mean_interval(by_seed[sound]), ".2f", ".2f") if sound.any() else "-"
            table.add_row(policy, quantity, *(f"{value:.2f}" for value in by_seed), interval)
            spread = by_episode.std(axis=1, ddof=1) if options.episodes > 1 else np.full(settings.seeds, np.nan)
            rows += [
                (policy, quantity, seed, by_seed[i], spread[i], options.episodes, int(not sound[i]))
                for i, seed in enumerate(numbers)
            ]
        table.add_section()
    show(table, 200)
    columns = ("policy", "quantity", "seed", "mean", "std", "episodes", "diverged")
    files.write_csv(run.path / "evaluation.csv", [columns, *rows])
    return 0


def _online(state: TrainState) -> TrainState:
    """The state with its online actors in the place of the averaged ones."""
    return state._replace(groups=tuple(group._replace(actor_average=None) for group in state.groups))


def _quantities(training: TrainingSession, found: Evaluation) -> list[tuple[str, np.ndarray]]:
    """(name, values [seeds, episodes]): returns by team and agent, length, measures; names as in the metrics table."""
    layout, returns = training.layout, np.asarray(found.episode_return)
    teams = [(f"return_{team}", returns @ training.team_weights(team)) for team in dict.fromkeys(layout.teams)]
    agents = [(f"{agent}_return", returns[:, :, i]) for i, agent in enumerate(layout.agents)]
    measures = [(name, np.asarray(found.measures)[:, :, k]) for k, name in enumerate(training.env.measures)]
    return [*teams, *agents, ("episode_length", np.asarray(found.length)), *measures]
