"""Reading settings: the files of settings and overrides in Hydra's grammar into a checked `Config`."""

import copy
import dataclasses
import functools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_module
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, OverrideType, ValueType
from hydra.errors import HydraException, OverrideParseException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from matd3_jax.config.coerce import plain
from matd3_jax.config.file import omegaconf_error, read
from matd3_jax.config.plain_values import from_dict
from matd3_jax.config.schema import OF_FROZEN, RENAMED, TEXTS, Config
from matd3_jax.errors import OptionError, UserError, nearest
from matd3_jax.groups import GROUPS, known_names

FREE = ("env", "kwargs")
"""A group of settings whose keys are not ours."""

ROBOT_RECIPE = "fast"
"""What robots train by unless a recipe is given, on every machine."""


def load(overrides: Sequence[str] = (), known: Sequence[str] = ()) -> Config:
    """The configuration that overrides in Hydra's grammar (`env=simple_tag`, `algo.lr=0.003`) give.

    Robots take their settings from a recipe (`ROBOT_RECIPE` unless one is given), all others have the paper's.
    `TEXTS` (name=, out= and what names other runs) are taken as they are typed.

    Args:
        known: keys that the caller takes itself, for what an error message says about an unknown one.

    Raises UserError, naming the key and the nearest valid ones, for whatever is not known or not possible.
    """
    parsed = parse(overrides)
    if any(o.key_or_group == "schedule" for o in parsed):
        raise UserError("there is no key 'schedule' any more: a robot's recipe has it (recipe=fast, paper or wide)")
    for group, noun in GROUPS.items():
        valid = known_names(group)
        for value in (o.value() for o in parsed if o.key_or_group == group):
            if value not in valid:
                raise UserError(f"{group}: no {noun} is called {value!r}; {nearest(value, valid)}")
    # Files first: Hydra wants them chosen before their values are changed.
    chosen = [o for o in parsed if o.key_or_group in GROUPS]
    values = [o for o in parsed if o.key_or_group not in GROUPS and not _is_text(o)]
    lines = [f"{o.key_or_group}={o.value()}" for o in chosen if o.key_or_group in ("env", "algo")]
    recipe = [o.value() for o in chosen if o.key_or_group == "recipe"]
    adversary = [o.value() for o in chosen if o.key_or_group == "adversary"]
    if not adversary and any(o.key_or_group.startswith("adversary.") for o in parsed):
        # The same algorithm with other values: start from all that algo= and algo.* say.
        adversary = [o.value() for o in chosen if o.key_or_group == "algo"] or ["matd3"]
        values = [_renamed(o) for o in values if _is_of_learning_team(o)] + values
    if adversary:
        lines.append(f"+algo@adversary={adversary[-1]}")
    try:
        tree = _files(tuple(lines))
        # `robot: false`: it may be one.
        if tree.get("robot") or (recipe and recipe[-1] != "paper" and "robot" in tree):
            lines.append(f"+recipe={recipe[-1] if recipe else ROBOT_RECIPE}")
        elif recipe and recipe[-1] != "paper":
            raise UserError(f"recipe={recipe[-1]} is for robots; {tree.env.name} has the paper's settings only")
        tree = _files(tuple(lines))
        _check_keys(tree, values, known)
        tree = copy.deepcopy(_files(tuple(lines)))
        for override in values:
            if override.is_add() and not override.is_force_add():
                raise UserError(f"cannot add {_line(override)!r}: the key is there, write it without the +")
            _update(tree, override)
        resolved = OmegaConf.to_container(tree, resolve=True, throw_on_missing=True)
    except (HydraException, OmegaConfBaseException) as error:
        raise UserError(omegaconf_error(error)) from error
    assert isinstance(resolved, dict)
    resolved["env"] = _with_engine(resolved["env"])
    for key in ("robot", "per_algorithm"):  # what only serves the files
        resolved.pop(key, None)
    for text in (o for o in parsed if _is_text(o)):
        *groups, last = text.key_or_group.split(".")
        (resolved[groups[0]] if groups else resolved)[last] = _writable(text)
    return from_dict(_with_frozen_teams(resolved, parsed))  # type: ignore[arg-type]


def _is_of_learning_team(override: Override) -> bool:
    """Whether an override of algo.* holds for adversaries without an algorithm of their own, too."""
    group, _, name = override.key_or_group.partition(".")
    return group == "algo" and name not in OF_FROZEN


def _with_frozen_teams(resolved: Mapping[Any, Any], parsed: Sequence[Override]) -> dict[Any, Any]:
    """Settings in which frozen teams have those of the runs that their policies are of.

    Raises UserError where there is no such run, or such a team is given settings of its own.
    """
    found = dict(resolved)
    for group, team in {"algo": "agents", "adversary": "adversaries"}.items():
        own = found.get(group)
        if not own or own.get("frozen") is not True or not own.get("policy"):
            continue
        for override in parsed:
            key, _, name = override.key_or_group.partition(".")
            if key == group and (name not in OF_FROZEN if name else group == "adversary"):
                raise UserError(
                    f"{_line(override)}: a frozen team has the settings of {group}.policy={own['policy']}; leave it out"
                )
        path = Path(own["policy"])
        if not (path / "config.yaml").is_file():
            what = "it has no config.yaml" if path.is_dir() else "there is no such directory"
            raise UserError(f"{group}.policy={path} is no run directory: {what}")
        source = read(path / "config.yaml").teams()[team]
        found[group] = {**plain(dataclasses.asdict(source)), **{name: own[name] for name in OF_FROZEN}}
    return found


def parse(overrides: Sequence[str], sweep: bool = False) -> list[Override]:
    """Overrides in Hydra's grammar, `TEXTS` as they are typed; `sweep`: also with several values.

    Raises UserError where one is malformed.
    """
    parsed = []
    for text in overrides:
        key, sign, value = text.partition("=")
        if sign and key in TEXTS:
            parsed.append(Override(OverrideType.CHANGE, key, ValueType.ELEMENT, value, input_line=text))
            continue
        try:
            override = _parser().parse_override(text)
        except (HydraException, OverrideParseException, RecursionError, ValueError) as error:
            example = "key=value, for instance algo.lr=0.003" + (" or algo.lr=0.01,0.003" if sweep else "")
            raise UserError(f"cannot read {text!r}: write {example}") from error
        if override.is_delete() or override.is_sweep_override() and not sweep:
            raise UserError(f"cannot take {text!r} here: write key=value with one value (several: matd3_jax.sweep)")
        parsed.append(override)
    return parsed


def merge(settings: Sequence[str], overrides: Sequence[str]) -> list[str]:
    """Append overrides to settings, and leave out the settings that have their keys.

    Raises UserError where an override is malformed.
    """
    keys = {override.key_or_group for override in parse(overrides, sweep=True)}
    return [*(text for text in settings if text.partition("=")[0] not in keys), *overrides]


@functools.cache
def _parser() -> OverridesParser:
    return OverridesParser.create()


@functools.cache
def _files(lines: tuple[str, ...]) -> DictConfig:
    """What the files say that `lines` choose; not to be changed."""
    with initialize_config_module("matd3_jax.config", version_base=None):
        return compose("config", list(lines))


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


def _check_keys(tree: DictConfig, values: Sequence[Override], known: Sequence[str]) -> None:
    """Raise UserError for a value whose key the configuration does not have; `known`: others that there are."""
    for override in values:
        node, path = tree, override.key_or_group.split(".")
        if tuple(path[:2]) == FREE and isinstance(OmegaConf.select(tree, ".".join(FREE)), DictConfig):
            continue
        for depth, name in enumerate(path):
            if not isinstance(node, DictConfig) or name not in node:
                prefix = ".".join(path[:depth])
                if depth and not isinstance(node, DictConfig):
                    raise UserError(f"there is no key {override.key_or_group!r}: {prefix} has a value, no keys")
                keys = [str(key) for key in node] if isinstance(node, DictConfig) else []
                keys += known if not depth else []
                # A key typed without its group, or in the wrong one, is a common slip: look there, too.
                groups = ("algo", "env", "diagnostics", "wandb", "mlflow")
                elsewhere = [f"{group}.{name}" for group in groups if name in tree.get(group, {})]
                elsewhere += [name] if depth and name in tree else []
                now = RENAMED.get(name)
                hint = f"did you mean {' or '.join(map(repr, elsewhere))}?" if elsewhere else nearest(name, keys)
                hint = f"it is called {'.'.join([*path[:-1], now])!r} now" if now else hint
                hint = "it is logger=[csv,tensorboard] now" if path == ["tensorboard"] else hint
                raise UserError(
                    f"there is no key {override.key_or_group!r}{f' (in {prefix})' if prefix else ''}; {hint}"
                )
            node = node[name] if OmegaConf.is_config(node) and not OmegaConf.is_missing(node, name) else node


def _update(tree: DictConfig, override: Override) -> None:
    """Give a key its value; keys of a group that the value lacks stay as they are."""
    key, value = override.key_or_group, override.value()
    both = isinstance(value, Mapping) and isinstance(OmegaConf.select(tree, key), DictConfig)
    OmegaConf.update(tree, key, value, merge=both, force_add=True)  # of keys that are not ours, too


def _is_text(override: Override) -> bool:
    return override.key_or_group in TEXTS and override.type == OverrideType.CHANGE


def _writable(override: Override) -> str:
    """A text. Raises UserError where OmegaConf could not write it into a file: an interpolation without an end."""
    try:
        OmegaConf.create({override.key_or_group: override.value()})
    except OmegaConfBaseException as error:
        raise UserError(f"{_line(override)}: must not hold an unfinished ${{") from error
    return str(override.value())


def _line(override: Override) -> str:
    assert override.input_line is not None
    return override.input_line


def _renamed(override: Override) -> Override:
    line = _line(override)
    return _parser().parse_override(line.replace("algo.", "adversary.", 1))
