"""How an environment is drawn, and the drawings that need nothing but Pillow."""

import abc
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import jax
import numpy as np
from PIL import Image

from matd3_jax.envs.particle.task import ParticleTask
from matd3_jax.envs.point_reach import PointReach
from matd3_jax.errors import UserError
from matd3_jax.figures.style import Color
from matd3_jax.video import particle as particle_drawing
from matd3_jax.video import point_reach


class Drawing(abc.ABC):
    """Draws the states of an environment."""

    aspect: float = 1.0
    """Width over height."""
    fps: int = 10
    """Pictures per second that look natural."""
    legend: Sequence[tuple[str, Color]] = ()
    """(what, its color)."""

    def select(self, state: Any) -> Any:
        """What of one state the pictures need: traceable."""
        return state

    @abc.abstractmethod
    def images(self, selected: Any, width: int, height: int) -> Iterable[Image.Image]:
        """A picture for each frame. `selected`: what `select` gives, leading axis [frames]."""


class SceneDrawing(Drawing):
    """Draws the particle tasks and point_reach. Their time step is 0.1 s: ten pictures per second are real time."""

    def __init__(self, env: ParticleTask | PointReach):
        self.env = env
        self.legend = point_reach.LEGEND if isinstance(env, PointReach) else particle_drawing.legend(env)

    def images(self, selected: Any, width: int, height: int) -> Iterator[Image.Image]:
        env = self.env
        if isinstance(env, PointReach):
            return point_reach.scene(env, selected).images(min(width, height))
        return particle_drawing.scene(env, selected).images(min(width, height))


class OwnDrawing(Drawing):
    """Leaves it to the environment: to its method `draw(state, size)`.

    It gets one state and the pixels of the longer side, and returns an array, uint8 [height, width, 3], or a PIL
    image, of the same size every time.
    """

    def __init__(self, env: Any):
        self.env = env

    def images(self, selected: Any, width: int, height: int) -> Iterator[Image.Image]:
        size = None
        for frame in range(len(jax.tree.leaves(selected)[0])):
            found = self.env.draw(jax.tree.map(lambda leaf, f=frame: leaf[f], selected), max(width, height))
            picture = found if isinstance(found, Image.Image) else Image.fromarray(_checked(found))
            size = size or picture.size
            if picture.size != size:
                raise UserError(
                    f"draw(state, size) gave pictures of {size} and of {picture.size} pixels: must be one size"
                )
            yield picture.convert("RGB")


def _checked(pixels: Any) -> np.ndarray:
    found = np.asarray(pixels)
    if found.dtype != np.uint8 or found.ndim != 3 or found.shape[2] != 3:
        raise UserError(
            f"draw(state, size) gave {found.dtype} {list(found.shape)}: must be uint8 [height, width, 3] or a PIL image"
        )
    return found
