"""A checked `Config` from plain values."""

import dataclasses
from collections.abc import Mapping
from typing import Any

from matd3_jax.config.coerce import typed
from matd3_jax.config.schema import LOGGERS, AlgoConfig, Config, DiagnosticsConfig, MlflowConfig, WandbConfig
from matd3_jax.config.validate import check
from matd3_jax.errors import UserError


def from_dict(values: Mapping[str, Any]) -> Config:
    """A checked configuration from plain values. Raises UserError."""
    rest = dict(values)
    env = environment(rest)
    algo = typed(AlgoConfig, _algorithm(rest, "algo"), "algo.")
    adversary = None
    if rest.get("adversary") is not None:
        adversary = typed(AlgoConfig, _algorithm(rest, "adversary"), "adversary.")
    diagnostics = typed(DiagnosticsConfig, _group(rest, "diagnostics", "diagnostics.q_bias=true"), "diagnostics.")
    wandb = typed(WandbConfig, _group(rest, "wandb", "wandb.project=mine"), "wandb.")
    mlflow = typed(MlflowConfig, _group(rest, "mlflow", "mlflow.experiment=mine"), "mlflow.")
    groups = {"env": env, "algo": algo, "adversary": adversary, "diagnostics": diagnostics}
    config = typed(Config, {**rest, **groups, "wandb": wandb, "mlflow": mlflow}, "")
    check(config)
    in_effect = tuple(name for name in LOGGERS if name == "csv" or name in config.logger)
    return dataclasses.replace(config, logger=in_effect)


def _group(values: Mapping[str, Any], key: str, example: str) -> Mapping[str, Any]:
    """A group of settings. Raises UserError where it is missing, or no group."""
    if key not in values:
        raise UserError(f"the key {key!r} is missing")
    found = values[key]
    if not isinstance(found, Mapping):
        raise UserError(f"{key}={found!r}: must be a group of keys, for instance {example}")
    return found


def _algorithm(values: Mapping[str, Any], key: str) -> dict[str, Any]:
    return {name: value for name, value in _group(values, key, f"{key}.gamma=0.95").items() if name != "lr"}


def environment(values: Mapping[str, Any]) -> Mapping[str, Any]:
    """The options of the environment. Raises UserError where it has no name."""
    env = _group(values, "env", "env.name=simple_spread")
    if not isinstance(env.get("name"), str):
        raise UserError(f"env.name={env.get('name')!r}: must be the name of an environment")
    return env
