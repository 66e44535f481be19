"""Which settings are impossible, alone or together."""

import math
from typing import TYPE_CHECKING, Any

from matd3_jax.errors import UserError

if TYPE_CHECKING:
    from matd3_jax.config import AlgoConfig, Config

CHOICES = {
    "critic": ("central", "own"),
    "critic_norm": ("none", "layer"),
    "critic_head": ("scalar", "categorical"),
    "clip": ("variable", "network", "none"),
    "adam": ("standard", "epsilon_hat"),
    "actor_output": ("sigmoid", "tanh"),
    "update_order": ("simultaneous", "sequential"),
    "warmup": ("policy", "random"),
}


def check(config: "Config") -> None:
    """Raise UserError for the first value, or combination of values, that is impossible."""

    def need(ok: bool, message: str) -> None:
        if not ok:
            raise UserError(message)

    for key in ("total_steps", "seeds", "num_envs", "rollout_length", "updates_per_collect", "batch_size",
                "n_step", "replay_capacity", "learning_starts", "eval_episodes", "keep_checkpoints"):  # fmt: skip
        need(getattr(config, key) >= 1, f"{key}={getattr(config, key)}: must be at least 1")
    need(0 <= config.seed < 2**31, f"seed={config.seed}: must be between 0 and {2**31 - 1}")
    need(config.log_every is None or config.log_every >= 1, f"log_every={config.log_every}: must be positive")
    for key in ("eval_every", "checkpoint_every"):
        value = getattr(config, key)
        need(value is None or value >= 0, f"{key}={value}: must not be negative")
    least = config.normalize_least_deviation
    need(0 <= least < math.inf, f"normalize_least_deviation={least}: must not be negative")
    need(
        not least or config.normalize_observations,
        f"normalize_least_deviation={least} goes with normalize_observations=true",
    )
    diagnostics = config.diagnostics
    for key in ("q_bias_rollouts", "q_bias_steps"):
        value = getattr(diagnostics, key)
        need(value >= 1, f"diagnostics.{key}={value}: must be at least 1")
    need(
        not (diagnostics.q_bias and config.eval_every == 0),
        "diagnostics.q_bias=true measures at evaluations, and eval_every=0 means none: give eval_every=, in env steps",
    )
    for name, team in {"algo": config.algo, "adversary": config.adversary}.items():
        if team is not None:
            _check_team(name, team, config.updates_per_collect, need)
    _check_choices("", config, need)
    collect = config.num_envs * config.rollout_length
    need(
        config.batch_size <= config.replay_capacity,
        f"batch_size={config.batch_size} is larger than replay_capacity={config.replay_capacity}",
    )
    need(
        config.learning_starts <= config.replay_capacity,
        f"learning_starts={config.learning_starts} is larger than replay_capacity={config.replay_capacity}: "
        "learning would never start",
    )
    need(
        config.replay_capacity % collect == 0,
        f"replay_capacity={config.replay_capacity} is not a multiple of the {collect} transitions of one rollout "
        f"(num_envs={config.num_envs} x rollout_length={config.rollout_length}); "
        f"nearest: {max(1, round(config.replay_capacity / collect)) * collect}",
    )
    need(
        config.n_step <= config.replay_capacity // config.num_envs,
        f"n_step={config.n_step} is more than the {config.replay_capacity // config.num_envs} env steps that "
        f"replay_capacity={config.replay_capacity} holds of each of num_envs={config.num_envs} environments",
    )
    need(
        config.total_steps >= config.learning_starts,
        f"total_steps={config.total_steps} ends before learning starts (learning_starts={config.learning_starts})",
    )


def _check_team(name: str, team: "AlgoConfig", updates: int, need: Any) -> None:
    for key in ("num_critics", "policy_delay"):
        need(getattr(team, key) >= 1, f"{name}.{key}={getattr(team, key)}: must be at least 1")
    need(team.critic_atoms >= 2, f"{name}.critic_atoms={team.critic_atoms}: must be at least 2")
    need(
        team.critic_head != "categorical" or team.critic_range is not None,
        f"{name}.critic_head=categorical needs the range of returns: {name}.critic_range=[low,high]",
    )
    if team.critic_range is not None:
        first, last = team.critic_range
        text = f"{name}.critic_range={list(team.critic_range)}"
        need(-math.inf < first < last < math.inf, f"{text}: the first number must be below the second, both finite")
    need(
        updates % team.policy_delay == 0 or team.policy_delay % updates == 0,
        f"updates_per_collect={updates} is not a multiple of {name}.policy_delay={team.policy_delay} (nor divides it)",
    )
    for key in ("actor_lr", "critic_lr", "max_grad_norm"):
        value = getattr(team, key)
        need(0 < value < math.inf, f"{name}.{key}={value}: must be positive")
    for key in ("target_noise", "target_noise_clip", "logit_regularizer"):
        value = getattr(team, key)
        need(0 <= value < math.inf, f"{name}.{key}={value}: must not be negative")
    noise = team.exploration_noise
    low, high = noise if isinstance(noise, tuple) else (noise, noise)
    shown = list(noise) if isinstance(noise, tuple) else noise
    need(0 <= low < math.inf and high < math.inf, f"{name}.exploration_noise={shown}: must not be negative")
    need(low <= high, f"{name}.exploration_noise={shown}: a range [low,high] must not end below its start")
    need(0 < team.reward_scale < math.inf, f"{name}.reward_scale={team.reward_scale}: must be positive")
    for key in ("gamma", "tau", "actor_average"):
        value = getattr(team, key)
        need(0 <= value <= 1, f"{name}.{key}={value}: must lie between 0 and 1")
    need(all(width >= 1 for width in team.hidden), f"{name}.hidden={list(team.hidden)}: widths must be at least 1")
    _check_choices(name + ".", team, need)


def _check_choices(prefix: str, part: Any, need: Any) -> None:
    for key, allowed in CHOICES.items():
        value = getattr(part, key, allowed[0])
        need(value in allowed, f"{prefix}{key}={value!r}: must be one of {', '.join(allowed)}")
