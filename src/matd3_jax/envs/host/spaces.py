"""gymnasium's spaces: what our learners play in their place, and how what they play is taken back."""

import dataclasses
from typing import Any

import numpy as np
from gymnasium import spaces

from matd3_jax.envs.spaces import ActionSpace, Box, Discrete, MultiDiscrete
from matd3_jax.errors import OptionError


@dataclasses.dataclass(frozen=True)
class Actions:
    """An action space of gymnasium's, and ours for it."""

    theirs: Any
    ours: ActionSpace

    @classmethod
    def of(cls, space: Any, whose: str) -> "Actions":
        """Boxes become boxes of [-1, 1]; choices stay choices.

        Raises OptionError for an infinite bound and for other kinds.
        """
        if isinstance(space, spaces.Box):
            if not np.issubdtype(space.dtype, np.floating):
                raise OptionError(f"the action space of {whose} is a Box of {space.dtype}; must be one of real numbers")
            if not (np.isfinite(space.low).all() and np.isfinite(space.high).all()):
                raise OptionError(f"the action space of {whose} has infinite bounds; actors need finite ones: wrap it")
            if not space.low.size:
                raise OptionError(f"the action space of {whose} has no entries")
            return cls(space, Box(int(space.low.size), -1.0, 1.0))
        if isinstance(space, spaces.Discrete):
            return cls(space, Discrete(int(space.n)))
        if isinstance(space, spaces.MultiDiscrete):
            return cls(space, MultiDiscrete(tuple(int(n) for n in space.nvec.ravel())))
        if isinstance(space, spaces.MultiBinary):
            return cls(space, MultiDiscrete((2,) * int(np.prod(space.shape))))
        kinds = "Box, Discrete, MultiDiscrete or MultiBinary"
        raise OptionError(f"the action space of {whose} is {type(space).__name__}; must be {kinds}")

    @property
    def width(self) -> int:
        """Numbers of one action."""
        return int(np.prod(self.ours.shape))

    def back(self, played: np.ndarray) -> Any:
        """What the environment takes, of what was played: int32 [width], a box's entries as their float32 bits."""
        space = self.theirs
        if isinstance(space, spaces.Box):
            unit = played.view(np.float32).astype(np.float64)
            unit = np.where(np.isfinite(unit), np.clip(unit, -1.0, 1.0), 0.0)
            low, high = (bound.ravel().astype(np.float64) for bound in (space.low, space.high))
            # Symmetric bounds without rounding: [-1, 1] stays as it is.
            scaled = np.where(low == -high, unit * high, low + (unit + 1) / 2 * (high - low))
            return np.clip(scaled.astype(space.dtype), space.low.ravel(), space.high.ravel()).reshape(space.shape)
        if isinstance(space, spaces.Discrete):
            return space.dtype.type(int(played[0]) + int(space.start))
        start = getattr(space, "start", np.zeros(space.shape, space.dtype))
        return (played.reshape(space.shape) + start).astype(space.dtype)


def flat_size(space: Any, whose: str) -> int:
    """Entries of an observation, flattened. Raises OptionError for spaces without a fixed size, and for masks."""
    if isinstance(space, spaces.Dict) and "action_mask" in space.spaces:
        raise OptionError(f"the observations of {whose} have an action_mask, which is not supported: wrap it away")
    if not isinstance(space, spaces.Space) or not space.is_np_flattenable:
        raise OptionError(f"the observation space of {whose} is {type(space).__name__}, which has no flat form")
    return int(spaces.flatdim(space))


def flatten(space: Any, observation: Any) -> np.ndarray:
    """An observation as a vector of float32; choices one-hot."""
    return np.asarray(spaces.flatten(space, observation), np.float32).ravel()
