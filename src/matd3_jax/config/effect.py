"""Settings that count only beside another: given alone they would change nothing, in silence."""

from collections.abc import Callable, Iterable, Sequence
from typing import Any

from matd3_jax.config.load import parse
from matd3_jax.config.schema import Config
from matd3_jax.errors import UserError

OF_TEAM: dict[tuple[str, ...], tuple[str, Callable[[Any], bool]]] = {
    ("gru_units",): ("{group}.actor=gru", lambda team: team.actor == "gru"),
    ("critic_atoms", "critic_range"): (
        "{group}.critic_head=categorical",
        lambda team: team.critic_head == "categorical",
    ),
    ("critic_quantiles", "dropped_quantiles"): (
        "{group}.critic_head=quantile",
        lambda team: team.critic_head == "quantile",
    ),
    ("distillation_updates",): ("{group}.handover=distill", lambda team: team.handover == "distill"),
    ("target_noise_clip",): ("{group}.target_noise above 0", lambda team: team.target_noise > 0),
}
"""Of `algo` and `adversary`: keys, what they go with, and whether a team has that."""

OF_RUN: dict[tuple[str, ...], tuple[str, Callable[[Config], bool]]] = {
    ("sequence_length", "burn_in"): ("algo.actor=gru", lambda config: config.recurrent),
    ("diagnostics.q_bias_rollouts", "diagnostics.q_bias_steps"): (
        "diagnostics.q_bias=true", lambda config: config.diagnostics.q_bias,
    ),
    ("wandb.project", "wandb.entity", "wandb.mode"): ("logger=[csv,wandb]", lambda config: "wandb" in config.logger),
    ("mlflow.tracking_uri", "mlflow.experiment"): ("logger=[csv,mlflow]", lambda config: "mlflow" in config.logger),
}  # fmt: skip


def check(overrides: Sequence[str], settings: Iterable[Config]) -> None:
    """Raise UserError for a key that changes nothing in any of some settings.

    Args:
        overrides: what was typed, `key=value`, of a sweep also with several values.
    """
    each = list(settings)
    for override in parse(overrides, sweep=True):
        key = override.key_or_group
        partners = [_partner(key, config) for config in each]
        if each and all(partners):
            raise UserError(f"{override.input_line}: goes with {partners[0]}")


def _partner(key: str, config: Config) -> str | None:
    """What a key would have to go with to count; None where it counts."""
    group, _, name = key.partition(".")
    for keys, (partner, there) in OF_RUN.items():
        if key in keys:
            return None if there(config) else partner
    both = [team for team in (config.algo, config.adversary) if team is not None]
    teams = {"algo": both, "adversary": both[1:]}.get(group)  # algo.* may hold for the adversaries, too
    for keys, (partner, of_team) in OF_TEAM.items():
        if name in keys and teams:
            return None if any(map(of_team, teams)) else partner.format(group=group)
    return None
