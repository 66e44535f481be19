"""point_reach as a scene on the plane."""

import numpy as np

from matd3_jax.envs.point_reach import PointReach, PointState
from matd3_jax.errors import OptionError
from matd3_jax.figures.style import BLUE, GREEN, Color
from matd3_jax.video.plane import Disc, Scene

RADIUS, TARGET_RADIUS = 0.06, 0.05
"""Points have no size; their drawings have."""

LEGEND: tuple[tuple[str, Color], ...] = (("agent", BLUE), ("target", GREEN))


def scene(env: PointReach, states: PointState) -> Scene:
    """The episode of `states`, every leaf with a leading axis [frames]; a line is drawn as y = 0.

    Raises OptionError for more than two dimensions.
    """
    if env.dim > 2:
        raise OptionError(f"dim={env.dim}: only a line or a plane can be drawn")
    pos, target = (_on_plane(np.asarray(points)) for points in (states.pos, states.target[0]))
    discs = [Disc(target, TARGET_RADIUS, GREEN, ringed=True)]
    discs += [Disc(pos[:, i], RADIUS, BLUE, label=str(i)) for i in range(env.num_agents)]
    return Scene(discs)


def _on_plane(points: np.ndarray) -> np.ndarray:
    """[..., 2] from [..., dim]."""
    return np.pad(points, [(0, 0)] * (points.ndim - 1) + [(0, 2 - points.shape[-1])])
