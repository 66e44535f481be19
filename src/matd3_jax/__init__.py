"""MATD3 and its family, end to end on the device: `matd3_jax.train(env="simple_spread", algo="matd3", seeds=4)`."""

from matd3_jax import envs
from matd3_jax.errors import UserError
from matd3_jax.training.session import TrainingSession
from matd3_jax.training.train import Result, train

__version__ = "0.1.0"
__all__ = ["Result", "TrainingSession", "UserError", "envs", "train"]
