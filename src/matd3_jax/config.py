"""Settings of a run: read from files and overrides in Hydra's grammar, typed, and checked before anything starts."""

import dataclasses
import math
import typing
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_module
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException, OverrideParseException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from matd3_jax.algorithms import Algorithm, HyperParams
from matd3_jax.envs.base import nearest
from matd3_jax.errors import UserError

GROUPS = ("env", "algo", "adversary")
"""Keys that choose a file; `adversary` takes the files of `algo`."""

CHOICES = {
    "critic": ("central", "own"),
    "clip": ("variable", "network", "none"),
    "adam": ("standard", "epsilon_hat"),
    "update_order": ("simultaneous", "sequential"),
    "warmup": ("policy", "random"),
}


@dataclasses.dataclass(frozen=True)
class AlgoConfig:
    """One team's algorithm and hyper-parameters; conf/algo/*.yaml says what each means."""

    name: str
    joint: bool
    critic: str
    num_critics: int
    policy_delay: int
    target_noise: float
    target_noise_clip: float
    actor_lr: float
    critic_lr: float
    gamma: float
    tau: float
    hidden: tuple[int, ...]
    clip: str
    max_grad_norm: float
    logit_regulariser: float
    exploration_noise: float
    sync_targets: bool
    adam: str

    def algorithm(self) -> Algorithm:
        """What fixes the shape of the learner."""
        shared = {field.name for field in dataclasses.fields(Algorithm)} - {"smoothing"}
        return Algorithm(smoothing=self.target_noise > 0, **{name: getattr(self, name) for name in shared})

    def hyper_params(self) -> HyperParams:
        """What may differ between runs of one program."""
        return HyperParams(**{name: getattr(self, name) for name in HyperParams._fields})


@dataclasses.dataclass(frozen=True)
class Config:
    """All settings of a run; conf/config.yaml says what each means."""

    env: Mapping[str, Any]
    """Name and options of the environment, for `envs.make`."""
    algo: AlgoConfig
    adversary: AlgoConfig | None
    """The opponents' algorithm; None: the same as `algo`."""
    total_steps: int
    seeds: int
    seed: int
    num_envs: int
    rollout_length: int
    updates_per_collect: int
    batch_size: int
    shared_minibatch: bool
    update_order: str
    replay_capacity: int
    learning_starts: int
    warmup: str
    name: str | None
    out: str
    log_every: int | None
    checkpoint_every: int | None
    keep_checkpoints: int
    tensorboard: bool

    def teams(self) -> dict[str, AlgoConfig]:
        """The algorithm of each team."""
        return {"agents": self.algo, "adversaries": self.adversary or self.algo}

    def to_dict(self) -> dict[str, Any]:
        """Plain values, as `from_dict` takes them."""
        return _plain(dataclasses.asdict(self))


# ---- reading ---------------------------------------------------------------------------------------------------------


def load(overrides: Sequence[str] = ()) -> Config:
    """The configuration that overrides in Hydra's grammar (`env=simple_tag`, `algo.lr=0.003`) give.

    Raises UserError, naming the key and the nearest valid ones, for whatever is not known or not possible.
    """
    parsed = parse(overrides)
    valid = known_names("algo")
    for override in parsed:
        if override.key_or_group in ("algo", "adversary") and override.value() not in valid:
            raise UserError(f"no algorithm is called {override.value()!r}; {nearest(override.value(), valid)}")
        if override.key_or_group == "env" and override.value() not in known_names("env"):
            raise UserError(
                f"no environment is called {override.value()!r}; {nearest(override.value(), known_names('env'))}"
            )
    # Files first: Hydra wants them chosen before their values are changed.
    chosen = [o for o in parsed if o.key_or_group in GROUPS]
    values = [o for o in parsed if o.key_or_group not in GROUPS]
    lines = [f"{o.key_or_group}={o.value()}" for o in chosen if o.key_or_group != "adversary"]
    adversary = [o.value() for o in chosen if o.key_or_group == "adversary"]
    if not adversary and any(o.key_or_group.startswith("adversary.") for o in values):
        # The same algorithm with other values: start from all that algo= and algo.* say.
        adversary = [o.value() for o in chosen if o.key_or_group == "algo"] or ["matd3"]
        values = [_renamed(o) for o in values if o.key_or_group.startswith("algo.")] + values
    if adversary:
        lines.append(f"+algo@adversary={adversary[-1]}")
    with initialize_config_module("matd3_jax.conf", version_base=None):
        try:
            tree = compose("config", lines)
            _check_keys(tree, values)
            tree = compose("config", lines + [_line(o) for o in values])
            plain = OmegaConf.to_container(tree, resolve=True, throw_on_missing=True)
        except (HydraException, OmegaConfBaseException) as error:
            raise UserError(_one_line(error)) from error
    assert isinstance(plain, dict)
    for key in ("resume", "checkpoint"):  # the command's own, see train.py
        plain.pop(key)
    return from_dict(plain)


def parse(overrides: Sequence[str]) -> list[Override]:
    """Overrides in Hydra's grammar. Raises UserError where one is malformed."""
    parsed = []
    for text in overrides:
        try:
            override = OverridesParser.create().parse_override(text)
        except (HydraException, OverrideParseException) as error:
            raise UserError(f"cannot read {text!r}: write key=value, for instance algo.lr=0.003") from error
        if override.is_delete() or override.is_sweep_override():
            raise UserError(f"cannot take {text!r} here: write key=value with one value")
        parsed.append(override)
    return parsed


def take(overrides: Sequence[str], keys: Sequence[str]) -> tuple[dict[str, Any], list[str]]:
    """Split off the values of `keys`: (value by key, the other overrides). Raises UserError like `parse`."""
    taken, rest = {}, []
    for text, override in zip(overrides, parse(overrides), strict=True):
        if override.key_or_group in keys:
            taken[override.key_or_group] = override.value()
        else:
            rest.append(text)
    return taken, rest


def known_names(group: str) -> tuple[str, ...]:
    """The files that a group offers."""
    folder = Path(__file__).parent / "conf" / group
    return tuple(sorted(path.stem for path in folder.glob("*.yaml") if not path.stem.startswith("_")))


def read(path: Path) -> Config:
    """The configuration that `write` left. Raises UserError if it cannot be read."""
    try:
        plain = OmegaConf.to_container(OmegaConf.load(path))
        assert isinstance(plain, dict)
        return from_dict(plain)
    except (OSError, AssertionError, ValueError, OmegaConfBaseException) as error:
        raise UserError(f"cannot read the configuration {path}: {_one_line(error)}") from error


def text(config: Config) -> str:
    """Every resolved value, as YAML."""
    return OmegaConf.to_yaml(OmegaConf.create(config.to_dict()))


def write(config: Config, path: Path) -> None:
    """Leave every resolved value in a YAML file."""
    path.write_text(text(config))


def from_dict(plain: Mapping[str, Any]) -> Config:
    """A checked configuration from plain values. Raises UserError."""
    plain = dict(plain)
    env = plain.pop("env")
    algo = _typed(AlgoConfig, {k: v for k, v in plain.pop("algo").items() if k != "lr"}, "algo.")
    adversary = plain.pop("adversary", None)
    if adversary is not None:
        adversary = _typed(AlgoConfig, {k: v for k, v in adversary.items() if k != "lr"}, "adversary.")
    config = _typed(Config, {**plain, "env": env, "algo": algo, "adversary": adversary}, "")
    check(config)
    return config


def _check_keys(tree: DictConfig, values: Sequence[Override]) -> None:
    """Raise UserError for a value whose key the configuration does not have."""
    for override in values:
        node, path = tree, override.key_or_group.split(".")
        for depth, name in enumerate(path):
            if not isinstance(node, DictConfig) or name not in node:
                prefix = ".".join(path[:depth])
                keys = [str(key) for key in node] if isinstance(node, DictConfig) else []
                # A key typed without its group, or in the wrong one, is a common slip: look there, too.
                elsewhere = [f"{group}.{name}" for group in ("algo", "env") if name in tree.get(group, {})]
                elsewhere += [name] if depth and name in tree else []
                hint = f"did you mean {' or '.join(map(repr, elsewhere))}?" if elsewhere else nearest(name, keys)
                raise UserError(
                    f"there is no key {override.key_or_group!r}{f' (in {prefix})' if prefix else ''}; {hint}"
                )
            node = node[name] if OmegaConf.is_config(node) and not OmegaConf.is_missing(node, name) else node


def _line(override: Override) -> str:
    assert override.input_line is not None
    return override.input_line


def _renamed(override: Override) -> Override:
    line = _line(override)
    return OverridesParser.create().parse_override(line.replace("algo.", "adversary.", 1))


def _one_line(error: BaseException) -> str:
    return " ".join(str(error).split())


# ---- types -----------------------------------------------------------------------------------------------------------


def _typed(cls: Any, values: Mapping[str, Any], prefix: str) -> Any:
    """A dataclass of plain values, each of its field's type."""
    fields = typing.get_type_hints(cls)
    for name in values:
        if name not in fields:
            raise UserError(f"there is no key {prefix + name!r}; {nearest(name, fields)}")
    for name in fields:
        if name not in values:
            raise UserError(f"the key {prefix + name!r} is missing")
    return cls(**{name: _convert(prefix + name, values[name], hint) for name, hint in fields.items()})


def _convert(key: str, value: Any, hint: Any) -> Any:
    options = typing.get_args(hint) if not hasattr(hint, "__origin__") else ()
    if type(None) in options:
        if value is None:
            return None
        hint = next(option for option in options if option is not type(None))
    if hint is float and isinstance(value, int | float) and not isinstance(value, bool):
        return float(value)
    if hint is int and isinstance(value, float) and value.is_integer():
        return int(value)  # 1e6 reads better than 1000000
    if hint == tuple[int, ...]:
        if isinstance(value, list | tuple) and all(type(v) is int for v in value):
            return tuple(value)
        raise UserError(f"{key}={value!r}: must be a list of whole numbers, for instance [64,64]")
    plain = hint if isinstance(hint, type) else Mapping
    if not isinstance(value, plain) or (isinstance(value, bool) and hint is not bool):
        kind = {int: "a whole number", float: "a number", bool: "true or false", str: "a word"}.get(
            hint, "a group of keys"
        )
        raise UserError(f"{key}={value!r}: must be {kind}")
    return value


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {k: _plain(v) for k, v in value.items()}
    return list(value) if isinstance(value, tuple) else value


# ---- checks ----------------------------------------------------------------------------------------------------------


def check(config: Config) -> None:
    """Raise UserError for the first value, or combination of values, that is impossible."""

    def need(ok: bool, message: str) -> None:
        if not ok:
            raise UserError(message)

    for key in ("total_steps", "seeds", "num_envs", "rollout_length", "updates_per_collect", "batch_size",
                "replay_capacity", "learning_starts", "keep_checkpoints"):  # fmt: skip
        need(getattr(config, key) >= 1, f"{key}={getattr(config, key)}: must be at least 1")
    need(0 <= config.seed < 2**31, f"seed={config.seed}: must be between 0 and {2**31 - 1}")
    for key in ("log_every", "checkpoint_every"):
        value = getattr(config, key)
        need(value is None or value >= (key == "log_every"), f"{key}={value}: must be positive")
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
        f"replay_capacity={config.replay_capacity} is not a multiple of the {collect} transitions of one collect "
        f"(num_envs={config.num_envs} x rollout_length={config.rollout_length}); "
        f"nearest: {max(1, round(config.replay_capacity / collect)) * collect}",
    )
    need(
        config.total_steps >= config.learning_starts,
        f"total_steps={config.total_steps} ends before learning starts (learning_starts={config.learning_starts})",
    )


def _check_team(name: str, team: AlgoConfig, updates: int, need: Any) -> None:
    for key in ("num_critics", "policy_delay"):
        need(getattr(team, key) >= 1, f"{name}.{key}={getattr(team, key)}: must be at least 1")
    need(
        updates % team.policy_delay == 0 or team.policy_delay % updates == 0,
        f"updates_per_collect={updates} is not a multiple of {name}.policy_delay={team.policy_delay} (nor divides it)",
    )
    for key in ("actor_lr", "critic_lr", "max_grad_norm"):
        value = getattr(team, key)
        need(0 < value < math.inf, f"{name}.{key}={value}: must be positive")
    for key in ("target_noise", "target_noise_clip", "logit_regulariser", "exploration_noise"):
        value = getattr(team, key)
        need(0 <= value < math.inf, f"{name}.{key}={value}: must not be negative")
    for key in ("gamma", "tau"):
        value = getattr(team, key)
        need(0 <= value <= 1, f"{name}.{key}={value}: must lie between 0 and 1")
    need(all(width >= 1 for width in team.hidden), f"{name}.hidden={list(team.hidden)}: widths must be at least 1")
    _check_choices(name + ".", team, need)


def _check_choices(prefix: str, part: Any, need: Any) -> None:
    for key, allowed in CHOICES.items():
        value = getattr(part, key, allowed[0])
        need(value in allowed, f"{prefix}{key}={value!r}: must be one of {', '.join(allowed)}")
