"""From the states of an episode to captioned pictures."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
from PIL import Image, ImageDraw
from PIL.ImageFont import FreeTypeFont

from matd3_jax.envs.environment import Environment
from matd3_jax.envs.particle.task import ParticleTask
from matd3_jax.envs.point_reach import PointReach
from matd3_jax.envs.wrappers.joint_team import JointTeam
from matd3_jax.errors import UserError
from matd3_jax.figures.style import BLACK, WHITE, Color
from matd3_jax.video import plane
from matd3_jax.video.mujoco_renderer import RobotDrawing
from matd3_jax.video.scene2d import Drawing, OwnDrawing, SceneDrawing

MARGIN = 6
"""Pixels left and right of the lines of text."""


def drawing_of(env: Environment) -> Drawing:
    """How `env` is drawn: by its own `draw`, as a particle world, or by MuJoCo. Raises UserError if none can."""
    while isinstance(env, JointTeam):
        env = env.env
    if callable(getattr(env, "draw", None)):
        return OwnDrawing(env)
    if isinstance(env, ParticleTask | PointReach):
        return SceneDrawing(env)
    if all(hasattr(env, name) for name in ("mj_model", "agent_bodies", "qpos")):
        return RobotDrawing(env)
    raise UserError(f"{type(env).__name__} cannot be drawn: give it a method draw(state, size) (docs/extending.md)")


def frames(env: Environment, states: Any, captions: Sequence[str] | None = None, size: int = 400) -> list[Image.Image]:
    """A picture of each of `states`: RGB, all of one size, on white; a legend below where there is one.

    Args:
        states: states of `env`, every leaf with a leading axis [frames].
        captions: a line above each picture; default: no such line.
        size: pixels of the longer side, captions and legend included.

    Raises UserError if `env` cannot be drawn.
    """
    drawing = drawing_of(env)
    return compose(drawing, jax.vmap(drawing.select)(states), captions, size)


def compose(drawing: Drawing, selected: Any, captions: Sequence[str] | None, size: int) -> list[Image.Image]:
    """`frames` of what `scene2d.select` gave, leading axis [frames]."""
    line = max(14, round(0.055 * size))
    lines = (captions is not None) + bool(drawing.legend)
    # With the lines of text, all of it has the longer side `size`.
    height = round(size / max(1.0, drawing.aspect)) - lines * line
    width = size if drawing.aspect > 1 else round(height * drawing.aspect)
    longest = max(captions or [""], key=plane.font(20).getlength)
    found = []
    for frame, picture in enumerate(drawing.images(selected, width, height)):
        whole = Image.new("RGB", (picture.width, picture.height + lines * line), WHITE)
        whole.paste(picture, (0, line if captions is not None else 0))
        pen = ImageDraw.Draw(whole)
        if captions is not None:
            face = _fitting(lambda face: face.getlength(longest), line, picture.width)  # the same for all
            pen.text((MARGIN, line / 2), captions[frame], fill=BLACK, font=face, anchor="lm")
        if drawing.legend:
            _write_legend(pen, drawing.legend, whole.height - line, line, picture.width)
        found.append(whole)
    return found


def _write_legend(
    pen: ImageDraw.ImageDraw, legend: Sequence[tuple[str, Color]], top: int, line: int, width: int
) -> None:
    def length(face: FreeTypeFont) -> float:
        return sum(face.getlength(text) + 2 * face.size for text, _ in legend)

    face = _fitting(length, line, width)
    x, y, r = float(MARGIN), top + line / 2, 0.38 * face.size
    for text, color in legend:
        pen.rectangle((x, y - r, x + 2 * r, y + r), fill=color)
        pen.text((x + face.size, y), text, fill=BLACK, font=face, anchor="lm")
        x += face.getlength(text) + 2 * face.size


def _fitting(length: Callable[[FreeTypeFont], float], line: int, width: int) -> FreeTypeFont:
    """The largest typeface for a line of this height in which the text is short enough, but no illegible one."""
    size = round(0.68 * line)
    while size > 7 and length(plane.font(size)) > width - 2 * MARGIN:
        size -= 1
    return plane.font(size)
