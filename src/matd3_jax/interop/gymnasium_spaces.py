"""Our action and observation spaces as gymnasium's, for environments that others' trainers step."""

import copy
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector.utils import batch_space

from matd3_jax.envs.spaces import ActionSpace, Box, Discrete, MultiDiscrete, Simplex

TOLERANCE = 1e-4
"""By how much the sum of a choice's numbers may miss 1: what float32 softmaxes of any size keep."""


class SimplexSpace(gymnasium.spaces.Box):
    """`envs.Simplex` as a gymnasium space: vectors of soft choices, each of which is at least 0 and sums to 1.

    It is a `Box` from 0 to 1 for whoever asks for shape and bounds alone; `contains` also asks for the sums, and
    `sample` draws as `envs.Simplex.sample` does. `batch`: that many vectors, [batch, entries]; None: one, [entries].
    """

    def __init__(self, sizes: tuple[int, ...], batch: int | None = None, seed: Any = None):
        self.sizes, self.batch = tuple(sizes), batch
        shape = (sum(sizes),) if batch is None else (batch, sum(sizes))
        super().__init__(0.0, 1.0, shape, np.float32, seed)

    @property
    def _starts(self) -> list[int]:
        return [sum(self.sizes[:i]) for i in range(len(self.sizes))]

    def sample(self, mask: None = None, probability: None = None) -> np.ndarray:
        """Softmax of Gumbel noise in each choice."""
        if mask is not None or probability is not None:
            raise gymnasium.error.Error("SimplexSpace.sample takes neither a mask nor probabilities")
        weights = np.exp(self.np_random.gumbel(size=self.shape))
        sums = np.add.reduceat(weights, self._starts, axis=-1)
        return (weights / np.repeat(sums, self.sizes, axis=-1)).astype(np.float32)

    def contains(self, x: Any) -> bool:
        """Whether `x` has the shape, no number below 0 or above 1, and choices that sum to 1 within `TOLERANCE`."""
        if not super().contains(x):
            return False
        return bool((np.abs(np.add.reduceat(np.asarray(x), self._starts, axis=-1) - 1) <= TOLERANCE).all())

    def __repr__(self) -> str:
        return f"SimplexSpace({self.sizes}{'' if self.batch is None else f', batch={self.batch}'})"

    def __eq__(self, other: object) -> bool:
        return isinstance(other, SimplexSpace) and (self.sizes, self.batch) == (other.sizes, other.batch)


@batch_space.register(SimplexSpace)
def _batch_simplex(space: SimplexSpace, n: int = 1) -> SimplexSpace:
    return SimplexSpace(space.sizes, n, copy.deepcopy(space.np_random))


def action_space(space: ActionSpace) -> gymnasium.Space:
    """The gymnasium space with the elements of `space`."""
    if isinstance(space, Box):
        return gymnasium.spaces.Box(space.low, space.high, space.shape, np.float32)
    if isinstance(space, Simplex):
        return SimplexSpace(space.sizes)
    if isinstance(space, Discrete):
        return gymnasium.spaces.Discrete(space.n)
    return gymnasium.spaces.MultiDiscrete(np.array(space.sizes))


def observation_space(size: int) -> gymnasium.spaces.Box:
    """Vectors of float32 without bounds, [size]."""
    return gymnasium.spaces.Box(-np.inf, np.inf, (size,), np.float32)


def as_ours(space: ActionSpace, action: Any) -> np.ndarray:
    """An element of the gymnasium space, or a batch of them, with the type that environments take."""
    return np.asarray(action, np.int32 if isinstance(space, Discrete | MultiDiscrete) else np.float32)
