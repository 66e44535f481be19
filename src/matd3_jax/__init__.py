"""MATD3 and its family, end to end on the device: `matd3_jax.train(env="simple_spread", algo="matd3", seeds=4)`."""

import importlib
from typing import TYPE_CHECKING, Any

from matd3_jax.errors import UserError

if TYPE_CHECKING:
    from matd3_jax import envs
    from matd3_jax.training.session import TrainingSession
    from matd3_jax.training.train import Result, resume, train

__version__ = "0.1.0"
__all__ = ["Result", "TrainingSession", "UserError", "envs", "resume", "train"]

_MODULES = {
    "Result": "training.train",
    "TrainingSession": "training.session",
    "envs": "envs",
    "resume": "training.train",
    "train": "training.train",
}
"""Imported when they are first asked for: a command's --help and what needs no JAX do not wait for it."""


if not TYPE_CHECKING:  # or any name would pass

    def __getattr__(name: str) -> Any:
        if name not in _MODULES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        module = importlib.import_module(f"{__name__}.{_MODULES[name]}")
        globals()[name] = found = module if name == "envs" else getattr(module, name)
        return found
