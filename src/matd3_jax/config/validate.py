"""Which settings are impossible, alone or together."""

import dataclasses
from typing import TYPE_CHECKING, Any

from matd3_jax.errors import UserError

if TYPE_CHECKING:
    from matd3_jax.config.schema import AlgoConfig, Config


def check(config: "Config") -> None:
    """Raise UserError for the first value, or combination of values, that is impossible."""

    def need(ok: bool, message: str) -> None:
        if not ok:
            raise UserError(message)

    _check_bounds("", config)
    need(config.out != "", "out=: must name a directory")
    least = config.normalize_least_deviation
    need(
        not least or config.normalize_observations,
        f"normalize_least_deviation={least} goes with normalize_observations=true",
    )
    diagnostics = config.diagnostics
    for group in ("diagnostics", "wandb", "mlflow"):
        _check_bounds(f"{group}.", getattr(config, group))
    need(
        not (diagnostics.q_bias and config.eval_every == 0),
        "diagnostics.q_bias=true measures at evaluations, and eval_every=0 means none: give eval_every=, in env steps",
    )
    _check_start(config, need)
    for name, team in {"algo": config.algo, "adversary": config.adversary}.items():
        if team is not None:
            _check_team(name, team, config.updates_per_collect, need)
            _check_order(name, team, config.update_order, need)
            _check_recurrent(name, team, config, need)
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


def _check_start(config: "Config", need: Any) -> None:
    """What a run takes of others."""
    need(
        config.init is not None or (config.init_checkpoint is None and config.init_seed is None),
        "init_checkpoint= and init_seed= go with init=RUN_DIR",
    )
    need(config.init != "", "init=: must name a run directory")
    need(
        config.switch_at is None or config.hands_over,
        f"switch_at={config.switch_at} goes with algo=hybrid",
    )
    _check_checkpoint("init_checkpoint", config.init_checkpoint, need)
    for name, team in {"algo": config.algo, "adversary": config.adversary}.items():
        if team is None:
            continue
        _check_checkpoint(f"{name}.policy_checkpoint", team.policy_checkpoint, need)
        need(
            not team.frozen or bool(team.policy),
            f"{name}.frozen=true: say whose policy the team plays, with {name}.policy=RUN_DIR",
        )
        need(
            team.frozen or team.policy is None,
            f"{name}.policy={team.policy} goes with {name}.frozen=true (to train on from a run's networks: init=)",
        )
        need(
            team.frozen or (team.policy_checkpoint is None and team.policy_seed is None),
            f"{name}.policy_checkpoint= and {name}.policy_seed= go with {name}.frozen=true",
        )
    teams = config.teams()
    need(
        not all(team.frozen for team in teams.values()),
        "algo.frozen=true: nobody would learn; give the adversaries an algorithm: adversary=NAME",
    )


def _check_checkpoint(key: str, text: str | None, need: Any) -> None:
    good = text is None or text in ("last", "best") or (text.isascii() and text.isdigit() and len(text) < 20)
    need(good, f"{key}={text}: must be the env step of a checkpoint, a whole number, or last, or best")


def _check_team(name: str, team: "AlgoConfig", updates: int, need: Any) -> None:
    _check_bounds(f"{name}.", team)
    need(
        team.frozen or updates % team.policy_delay == 0 or team.policy_delay % updates == 0,
        f"updates_per_collect={updates} is not a multiple of {name}.policy_delay={team.policy_delay} (nor divides it)",
    )
    if isinstance(team.exploration_noise, tuple):
        low, high = team.exploration_noise
        need(low <= high, f"{name}.exploration_noise=[{low},{high}]: a range [low,high] must not end below its start")
    for key in ("adversarial_step", "adversarial_step_team"):
        need(
            team.critic == "central" or not getattr(team, key),
            f"{name}.{key}={getattr(team, key)} needs {name}.critic=central: {team.name}'s critics "
            + ("are the whole team's" if team.critic == "shared" else "do not see the others' actions"),
        )
    need(
        team.critic_head != "categorical" or team.critic_range is not None,
        f"{name}.critic_head=categorical needs the range of returns: {name}.critic_range=[low,high]",
    )
    need(
        team.target_critics is None or team.target_critics <= team.num_critics,
        f"{name}.target_critics={team.target_critics} is more than {name}.num_critics={team.num_critics}",
    )
    need(
        team.critic_head != "quantile" or team.dropped_quantiles < team.critic_quantiles,
        f"{name}.dropped_quantiles={team.dropped_quantiles} leaves none of {name}.critic_quantiles="
        f"{team.critic_quantiles}",
    )
    need(
        team.joint or not team.hands_over,
        f"{name}.hands_over=true needs {name}.joint=true: an agent that takes the place of several",
    )
    need(
        not team.hands_over or team.frozen or (team.share_parameters == "none" and team.critic != "shared"),
        f"{name}.hands_over=true joins networks that are each agent's own: leave {name}.share_parameters and "
        f"{name}.critic=shared out",
    )
    need(
        team.handover == "join" or team.hands_over,
        f"{name}.handover={team.handover} goes with {'algo' if name == 'algo' else 'adversary'}=hybrid",
    )
    for key, plain in (("critic_head", "scalar"), ("critic_norm", "none")):
        need(
            not team.hands_over or team.frozen or getattr(team, key) == plain,
            f"{name}.{key}={getattr(team, key)}: {team.name}'s agents hand over critics with {key}={plain} alone",
        )
    if team.critic_range is not None:
        first, last = team.critic_range
        need(first < last, f"{name}.critic_range=[{first},{last}]: the first number must be below the second")


def _check_order(name: str, team: "AlgoConfig", order: str, need: Any) -> None:
    """What of a team can be updated agent by agent."""
    need(
        team.frozen or team.share_parameters == "none" or order == "simultaneous",
        f"{name}.share_parameters=kind has one network for several agents, and no order among them: leave "
        f"update_order={order} out",
    )
    need(
        team.frozen or team.critic != "shared" or order != "sequential",
        f"{name}.critic=shared has one target for the whole team, and update_order=sequential one for each agent in "
        "its turn: take simultaneous or random_sequential",
    )


def _check_recurrent(name: str, team: "AlgoConfig", config: "Config", need: Any) -> None:
    """What goes with recurrent networks."""
    if team.actor != "gru":
        return
    key = f"{name}.actor=gru"
    need(not team.frozen, f"{name}.policy={team.policy}: its actors are recurrent, and frozen teams play others alone")
    need(config.n_step == 1, f"{key} has targets of one step: give n_step=1")
    need(team.share_parameters == "none", f"{key} has networks for each agent: leave {name}.share_parameters out")
    need(team.critic != "shared", f"{key} has critics for each agent: leave {name}.critic=shared out")
    need(
        not team.adversarial,
        f"{key}: {name}.adversarial_step moves actions that recurrent critics also remember; set it to 0",
    )
    need(not team.hands_over, f"{key}: {team.name}'s agents hand over networks with {name}.actor=mlp alone")
    need(
        config.update_order != "random_sequential",
        f"{key} learns from replayed actions: leave update_order=random_sequential out",
    )
    need(
        not config.diagnostics.q_bias,
        f"diagnostics.q_bias=true begins anywhere in an episode, and critics of {key} need what came before: leave it "
        "false",
    )
    need(
        config.batch_size % config.sequence_length == 0,
        f"batch_size={config.batch_size} is not a multiple of sequence_length={config.sequence_length}",
    )
    steps = config.burn_in + config.sequence_length
    least = config.num_envs * steps
    need(
        config.learning_starts >= least,
        f"learning_starts={config.learning_starts} is less than a sequence in each environment: num_envs="
        f"{config.num_envs} x (burn_in={config.burn_in} + sequence_length={config.sequence_length}) = {least}",
    )


def _check_bounds(prefix: str, part: Any) -> None:
    """Raise UserError for the first value that its field does not allow."""
    for field in dataclasses.fields(part):
        value, bounds = getattr(part, field.name), field.metadata["bounds"]
        members = value if isinstance(value, tuple) else (value,)
        for member in members:
            if isinstance(member, int | float) and not isinstance(member, bool) and not bounds.admits(member):
                shown = list(value) if isinstance(value, tuple) else value
                each = "each " if isinstance(value, tuple) else ""
                raise UserError(f"{prefix}{field.name}={shown}: {each}must {bounds.words()}")
            if isinstance(member, str) and bounds.choices is not None and member not in bounds.choices:
                raise UserError(f"{prefix}{field.name}={member!r}: must {bounds.words()}")
