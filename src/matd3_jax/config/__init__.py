"""Settings of a run: read from files and overrides in Hydra's grammar, typed, and checked before anything starts."""

import copy
import dataclasses
import functools
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_module
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException, OverrideParseException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from matd3_jax.config.coerce import plain, typed
from matd3_jax.config.validate import check
from matd3_jax.core.algorithm import Algorithm, HyperParams
from matd3_jax.errors import OptionError, UserError, nearest
from matd3_jax.runtime import files, slurm

ADDED_TO_ALGO = {
    "actor_output": "sigmoid",
    "actor_average": 0.0,
    "reward_scale": 1.0,
    "critic_norm": "none",
    "critic_head": "scalar",
    "critic_atoms": 51,
    "critic_range": None,
}
"""`ADDED_LATER` of an algorithm's group."""
ADDED_LATER = {
    "recipe": "paper",
    "eval_every": 0,
    "eval_episodes": 10,
    "n_step": 1,
    "normalize_observations": False,
    "normalize_least_deviation": 0.0,
    "diagnostics": {"q_bias": False, "q_bias_rollouts": 200, "q_bias_steps": 100},
    "algo": ADDED_TO_ALGO,
    "adversary": ADDED_TO_ALGO,
}
"""Keys that runs from before them lack, with the values that those runs had in effect; a group may lack some, too."""

RENAMED = {
    "normalise_observations": "normalize_observations",
    "normalise_least_deviation": "normalize_least_deviation",
    "logit_regulariser": "logit_regularizer",
}
"""Keys that runs from before have under other names."""

HYPER_PARAMS = tuple(name for name in HyperParams._fields if name != "exploration_noise_high")
"""Settings of an algorithm that may differ between runs of one program."""

FOLDER = Path(__file__).parent
"""Where the files of settings are."""

GROUPS = ("env", "algo", "adversary", "recipe")
"""Keys that choose a file; `adversary` takes the files of `algo`."""

NOUNS = {"env": "environment", "algo": "algorithm", "adversary": "algorithm", "recipe": "recipe"}

ROBOT_RECIPE = "fast"
"""What robots train by unless a recipe is given, on every machine."""


@dataclasses.dataclass(frozen=True)
class AlgoConfig:
    """One team's algorithm and hyper-parameters; algo/*.yaml says what each means."""

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
    logit_regularizer: float
    exploration_noise: float | tuple[float, float]
    sync_targets: bool
    adam: str
    actor_output: str
    actor_average: float
    reward_scale: float
    critic_norm: str
    critic_head: str
    critic_atoms: int
    critic_range: tuple[float, float] | None

    def algorithm(self) -> Algorithm:
        """What fixes the shape of the learner."""
        noise_range = isinstance(self.exploration_noise, tuple)
        derived: dict[str, Any] = {"smoothing": self.target_noise > 0, "noise_range": noise_range}
        shared = {field.name for field in dataclasses.fields(Algorithm)} - set(derived)
        return Algorithm(**derived, **{name: getattr(self, name) for name in shared})

    def hyper_params(self) -> HyperParams:
        """What may differ between runs of one program."""
        noise = self.exploration_noise
        low, high = noise if isinstance(noise, tuple) else (noise, noise)
        same = {name: getattr(self, name) for name in HYPER_PARAMS if name != "exploration_noise"}
        return HyperParams(**same, exploration_noise=low, exploration_noise_high=high)


@dataclasses.dataclass(frozen=True)
class DiagnosticsConfig:
    """What a run measures of itself beside its returns; config.yaml says what each means."""

    q_bias: bool
    q_bias_rollouts: int
    q_bias_steps: int


@dataclasses.dataclass(frozen=True)
class Config:
    """All settings of a run; config.yaml says what each means."""

    recipe: str
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
    n_step: int
    normalize_observations: bool
    normalize_least_deviation: float
    replay_capacity: int
    learning_starts: int
    warmup: str
    name: str | None
    out: str
    log_every: int | None
    eval_every: int | None
    eval_episodes: int
    diagnostics: DiagnosticsConfig
    checkpoint_every: int | None
    keep_checkpoints: int
    tensorboard: bool

    def teams(self) -> dict[str, AlgoConfig]:
        """The algorithm of each team."""
        return {"agents": self.algo, "adversaries": self.adversary or self.algo}

    def to_dict(self) -> dict[str, Any]:
        """Plain values, as `from_dict` takes them."""
        return plain(dataclasses.asdict(self))


# ---- reading ---------------------------------------------------------------------------------------------------------


def load(overrides: Sequence[str] = ()) -> Config:
    """The configuration that overrides in Hydra's grammar (`env=simple_tag`, `algo.lr=0.003`) give.

    Robots take their settings from a recipe (`ROBOT_RECIPE` unless one is given), all others have the paper's.

    Raises UserError, naming the key and the nearest valid ones, for whatever is not known or not possible.
    """
    parsed = parse(overrides)
    if any(o.key_or_group == "schedule" for o in parsed):
        raise UserError("there is no key 'schedule' any more: a robot's recipe has it (recipe=fast, paper or wide)")
    for group, noun in NOUNS.items():
        valid = known_names("algo" if group == "adversary" else group)
        for value in (o.value() for o in parsed if o.key_or_group == group):
            if value not in valid:
                raise UserError(f"no {noun} is called {value!r}; {nearest(value, valid)}")
    # Files first: Hydra wants them chosen before their values are changed.
    chosen = [o for o in parsed if o.key_or_group in GROUPS]
    values = [o for o in parsed if o.key_or_group not in GROUPS]
    lines = [f"{o.key_or_group}={o.value()}" for o in chosen if o.key_or_group in ("env", "algo")]
    recipe = [o.value() for o in chosen if o.key_or_group == "recipe"]
    adversary = [o.value() for o in chosen if o.key_or_group == "adversary"]
    if not adversary and any(o.key_or_group.startswith("adversary.") for o in values):
        # The same algorithm with other values: start from all that algo= and algo.* say.
        adversary = [o.value() for o in chosen if o.key_or_group == "algo"] or ["matd3"]
        values = [_renamed(o) for o in values if o.key_or_group.startswith("algo.")] + values
    if adversary:
        lines.append(f"+algo@adversary={adversary[-1]}")
    try:
        tree = _files(tuple(lines))
        if "robot" in tree:
            lines.append(f"+recipe={recipe[-1] if recipe else ROBOT_RECIPE}")
        elif recipe and recipe[-1] != "paper":
            raise UserError(f"recipe={recipe[-1]} is for robots; {tree.env.name} has the paper's settings only")
        tree = _files(tuple(lines))
        _check_keys(tree, values)
        tree = copy.deepcopy(_files(tuple(lines)))
        for override in values:
            if override.is_add() and not override.is_force_add():
                raise UserError(f"cannot add {_line(override)!r}: the key is there, write it without the +")
            OmegaConf.update(tree, override.key_or_group, override.value())
        resolved = OmegaConf.to_container(tree, resolve=True, throw_on_missing=True)
    except (HydraException, OmegaConfBaseException) as error:
        raise UserError(_one_line(error)) from error
    assert isinstance(resolved, dict)
    resolved["env"] = _with_engine(resolved["env"])
    # The command's own (see train.py), and what only serves the files.
    for key in ("resume", "checkpoint", *slurm.KEYS, "robot", "per_algorithm"):
        resolved.pop(key, None)
    return from_dict(resolved)  # type: ignore[arg-type]


def parse(overrides: Sequence[str], sweep: bool = False) -> list[Override]:
    """Overrides in Hydra's grammar; `sweep`: also with several values. Raises UserError where one is malformed."""
    parsed = []
    for text in overrides:
        try:
            override = _parser().parse_override(text)
        except (HydraException, OverrideParseException) as error:
            example = "key=value, for instance algo.lr=0.003" + (" or algo.lr=0.01,0.003" if sweep else "")
            raise UserError(f"cannot read {text!r}: write {example}") from error
        if override.is_delete() or override.is_sweep_override() and not sweep:
            raise UserError(f"cannot take {text!r} here: write key=value with one value (several: matd3_jax.sweep)")
        parsed.append(override)
    return parsed


@functools.cache
def _parser() -> OverridesParser:
    return OverridesParser.create()


@functools.cache
def _files(lines: tuple[str, ...]) -> DictConfig:
    """What the files say that `lines` choose; not to be changed."""
    with initialize_config_module("matd3_jax.config", version_base=None):
        return compose("config", list(lines))


def take(overrides: Sequence[str], keys: Sequence[str]) -> tuple[dict[str, Any], list[str]]:
    """Split off the values of `keys`: (value by key, the other overrides). Raises UserError like `parse`."""
    taken, rest = {}, []
    for text, override in zip(overrides, parse(overrides), strict=True):
        if override.key_or_group in keys:
            taken[override.key_or_group] = override.value()
        else:
            rest.append(text)
    return taken, rest


def take_text(argv: Sequence[str], keys: Sequence[str]) -> tuple[dict[str, str], list[str]]:
    """Split off what is written after `key=` for `keys`, as it stands: for paths and words, which Hydra's grammar would
    read as numbers, sweeps or not at all. (text by key, the other arguments)."""
    taken, rest = {}, []
    for argument in argv:
        key, sign, value = argument.partition("=")
        if sign and key in keys:
            taken[key] = value
        else:
            rest.append(argument)
    return taken, rest


def words(text: str) -> list[str]:
    """The words of `A,B` or `[A,B]`; quotes keep a comma in a word. Raises UserError where a quote is not closed."""
    text = text.strip()
    inside = text[1:-1] if text.startswith("[") and text.endswith("]") else text
    reader = shlex.shlex(inside, posix=True)
    reader.whitespace, reader.whitespace_split, reader.commenters = ",", True, ""
    try:
        return [word.strip() for word in reader if word.strip()]
    except ValueError as error:
        raise UserError(f"cannot read {text!r}: a quotation mark is missing") from error


def known_names(group: str) -> tuple[str, ...]:
    """The files that a group offers."""
    folder = FOLDER / group
    return tuple(sorted(path.stem for path in folder.glob("*.yaml") if not path.stem.startswith("_")))


def read(path: Path) -> Config:
    """The configuration that `write` left. Raises UserError if it cannot be read."""
    try:
        found = OmegaConf.to_container(OmegaConf.load(path))
        assert isinstance(found, dict)
        values = _with_defaults(renamed(found), ADDED_LATER)
        if "physics" in values["env"]:
            from matd3_jax.envs.robots.engines.engine import RENAMED

            physics = values["env"]["physics"]
            values["env"] = {**values["env"], "physics": RENAMED.get(physics, physics)}
        return from_dict(values)
    except (OSError, AssertionError, ValueError, OmegaConfBaseException) as error:
        raise UserError(f"cannot read the configuration {path}: {_one_line(error)}") from error


def renamed(values: Mapping[Any, Any]) -> dict[Any, Any]:
    """Plain settings with the names that keys have now, in their groups, too."""
    return {
        RENAMED.get(key, key): renamed(value) if isinstance(value, Mapping) else value for key, value in values.items()
    }


def text(config: Config) -> str:
    """Every resolved value, as YAML."""
    return OmegaConf.to_yaml(OmegaConf.create(config.to_dict()))


def write(config: Config, path: Path) -> None:
    """Leave every resolved value in a YAML file."""
    files.write_text(path, text(config))


def from_dict(values: Mapping[str, Any]) -> Config:
    """A checked configuration from plain values. Raises UserError."""
    rest = dict(values)
    env = rest.pop("env")
    algo = typed(AlgoConfig, {k: v for k, v in rest.pop("algo").items() if k != "lr"}, "algo.")
    adversary = rest.pop("adversary", None)
    if adversary is not None:
        adversary = typed(AlgoConfig, {k: v for k, v in adversary.items() if k != "lr"}, "adversary.")
    diagnostics = rest.pop("diagnostics", None)
    if not isinstance(diagnostics, Mapping):
        raise UserError(f"diagnostics={diagnostics!r}: must be a group of keys, for instance diagnostics.q_bias=true")
    diagnostics = typed(DiagnosticsConfig, diagnostics, "diagnostics.")
    groups = {"env": env, "algo": algo, "adversary": adversary, "diagnostics": diagnostics}
    config = typed(Config, {**rest, **groups}, "")
    check(config)
    return config


def _with_engine(env: Mapping[str, Any]) -> Mapping[str, Any]:
    """A robot's options with the engine that this machine takes for `physics: auto`: a run keeps it wherever it is
    resumed."""
    if "physics" not in env:
        return env
    from matd3_jax.envs.robots.engines import engine

    try:
        return {**env, "physics": engine.resolve(env["physics"])}
    except OptionError as error:
        raise UserError(f"env.{error}") from error


def _with_defaults(found: Mapping[Any, Any], defaults: Mapping[str, Any]) -> dict[Any, Any]:
    """`found` with the keys that it lacks, also within its groups."""
    values = {**defaults, **found}
    for key, default in defaults.items():
        if isinstance(default, Mapping) and isinstance(values[key], Mapping):
            values[key] = {**default, **values[key]}
    return values


def _check_keys(tree: DictConfig, values: Sequence[Override]) -> None:
    """Raise UserError for a value whose key the configuration does not have."""
    for override in values:
        node, path = tree, override.key_or_group.split(".")
        for depth, name in enumerate(path):
            if not isinstance(node, DictConfig) or name not in node:
                prefix = ".".join(path[:depth])
                keys = [str(key) for key in node] if isinstance(node, DictConfig) else []
                # A key typed without its group, or in the wrong one, is a common slip: look there, too.
                groups = ("algo", "env", "diagnostics")
                elsewhere = [f"{group}.{name}" for group in groups if name in tree.get(group, {})]
                elsewhere += [name] if depth and name in tree else []
                now = RENAMED.get(name)
                hint = f"did you mean {' or '.join(map(repr, elsewhere))}?" if elsewhere else nearest(name, keys)
                hint = f"it is called {'.'.join([*path[:-1], now])!r} now" if now else hint
                raise UserError(
                    f"there is no key {override.key_or_group!r}{f' (in {prefix})' if prefix else ''}; {hint}"
                )
            node = node[name] if OmegaConf.is_config(node) and not OmegaConf.is_missing(node, name) else node


def _line(override: Override) -> str:
    assert override.input_line is not None
    return override.input_line


def _renamed(override: Override) -> Override:
    line = _line(override)
    return _parser().parse_override(line.replace("algo.", "adversary.", 1))


def _one_line(error: BaseException) -> str:
    return " ".join(str(error).split())
