"""Compiled iterations of training."""

from typing import Any, NamedTuple

from matd3_jax.core.algorithm import HyperParams
from matd3_jax.training.state import TrainState


class Program(NamedTuple):
    """Compiled iterations of training: call it with a state, which is donated."""

    jitted: Any
    hyper: tuple[HyperParams, ...]
    iterations: int

    def __call__(self, state: TrainState) -> tuple[TrainState, Any]:
        return self.jitted(state, self.hyper)
