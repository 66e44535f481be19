"""Settings of a run: read from files and overrides in Hydra's grammar, typed, and checked before anything starts."""

from matd3_jax.config.file import completed, read, text, write
from matd3_jax.config.load import ROBOT_RECIPE, load, merge, parse
from matd3_jax.config.plain_values import from_dict
from matd3_jax.config.schema import (
    ADDED_LATER,
    HYPER_PARAMS,
    AlgoConfig,
    Config,
    DiagnosticsConfig,
    MlflowConfig,
    WandbConfig,
)
from matd3_jax.groups import GROUPS, known_names

__all__ = [
    "ADDED_LATER",
    "AlgoConfig",
    "Config",
    "DiagnosticsConfig",
    "GROUPS",
    "HYPER_PARAMS",
    "MlflowConfig",
    "ROBOT_RECIPE",
    "WandbConfig",
    "completed",
    "from_dict",
    "known_names",
    "load",
    "merge",
    "parse",
    "read",
    "text",
    "write",
]
