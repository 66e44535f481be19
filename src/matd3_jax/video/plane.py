"""Pictures of discs on a plane: what the drawings of the particle tasks and of point_reach share."""

import dataclasses
from collections.abc import Iterator, Sequence

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from matd3_jax.figures.style import BLACK, GREEN, PURPLE, WHITE, Color

OVERSAMPLING = 3
"""How many times larger pictures are drawn before they are shrunk: smooth edges."""
MARGIN = 1.08
"""The view reaches this much farther than what it has to show."""
LEAST_RADIUS = 0.013
"""Smallest radius drawn, as a fraction of the picture's side: a disc stays visible however far apart things get."""
OPACITY = 205
"""Of moving discs, at most 255: what they cover stays visible."""

LABEL = 1.3
"""Height of a label, in sizes of its typeface."""
BAR, CHART, WIDEST_CHART = 0.03, 0.1, 0.2
"""Width of a message's bars, their greatest height, and the most that all bars of a message take, as fractions of the
picture's side."""

GRID: Color = (236, 236, 236)
START: Color = (190, 190, 190)
"""Of the square [-1, 1]^2."""

Edges = tuple[float, float, float, float]
"""Left, top, right, bottom of a box, in pixels."""


@dataclasses.dataclass(frozen=True)
class Disc:
    """A round thing. `position`: [frames, 2] for what may move, [2] for what never does."""

    position: np.ndarray
    radius: float
    color: Color
    label: str = ""
    """Written inside if it fits there, otherwise below."""
    ringed: bool = False
    """With a ring around it, to stand out by shape as well."""
    message: np.ndarray | None = None
    """[frames, entries] between 0 and 1: a bar for each entry, next to the disc."""
    marked: int | None = None
    """The entry of the message that is green."""

    @property
    def moves(self) -> bool:
        return self.position.ndim == 2

    def position_at(self, frame: int) -> np.ndarray:
        """[2]."""
        return self.position[frame] if self.moves else self.position


@dataclasses.dataclass(frozen=True)
class Scene:
    """An episode on the plane: discs in the order they are painted, and a line of text at the bottom."""

    discs: Sequence[Disc]
    note: str = ""

    @property
    def num_frames(self) -> int:
        return max(len(disc.position) for disc in self.discs if disc.moves)

    def view(self) -> tuple[np.ndarray, float]:
        """(center [2], half the side) of a square, one for the whole episode, that holds [-1, 1]^2 and every disc."""
        low, high = np.full(2, -1.0), np.full(2, 1.0)
        for disc in self.discs:
            positions = disc.position.reshape(-1, 2)
            low = np.minimum(low, positions.min(axis=0) - disc.radius)
            high = np.maximum(high, positions.max(axis=0) + disc.radius)
        return (low + high) / 2, MARGIN * float((high - low).max()) / 2

    def images(self, side: int) -> Iterator[Image.Image]:
        """One picture of side x side pixels for each frame."""
        painter = _Painter(self, side)
        for frame in range(self.num_frames):
            yield painter.paint(frame)


class _Painter:
    """Turns the world's coordinates into pixels: x to the right, y upwards."""

    def __init__(self, scene: Scene, side: int):
        self.scene, self.side = scene, side
        self.center, self.half = scene.view()
        self.font = font(max(9, round(side * 0.034)))
        self.background = self._background()

    def pixel(self, position: np.ndarray) -> np.ndarray:
        """Pixels (right, down) of a position [2] in the world."""
        unit = (np.asarray(position, float) - self.center) / (2 * self.half)
        return np.array([0.5 + unit[0], 0.5 - unit[1]]) * self.side

    def radius(self, disc: Disc) -> float:
        """Pixels."""
        return max(disc.radius / (2 * self.half), LEAST_RADIUS) * self.side

    def paint(self, frame: int) -> Image.Image:
        layer = self.background.copy()
        pen = ImageDraw.Draw(layer, "RGBA")
        for disc in self.scene.discs:
            self._disc(pen, disc, frame)
        picture = layer.resize((self.side, self.side), Image.Resampling.BOX)
        pen = ImageDraw.Draw(picture)
        for disc in self.scene.discs:
            self._label(pen, disc, frame)
            if disc.message is not None:
                _chart(pen, disc.message[frame], disc.marked, self._chart_box(disc, frame))
        if self.scene.note:
            pen.text((4, self.side - 4), self.scene.note, fill=BLACK, font=self.font, anchor="ls")
        return picture

    def _background(self) -> Image.Image:
        """A line every half unit (farther apart where the view is wide), and the square where entities start."""
        size = self.side * OVERSAMPLING
        layer = Image.new("RGB", (size, size), WHITE)
        pen = ImageDraw.Draw(layer)
        step = 0.5 if self.half < 2.5 else 2.0 ** np.ceil(np.log2(self.half / 4))
        ends = self.center - self.half, self.center + self.half
        for axis in range(2):
            for value in np.arange(np.ceil(ends[0][axis] / step), np.floor(ends[1][axis] / step) + 1) * step:
                self._line(pen, axis, value, (ends[0][1 - axis], ends[1][1 - axis]), GRID)
        for axis in range(2):
            for value in (-1.0, 1.0):
                self._line(pen, axis, value, (-1.0, 1.0), START)
        return layer

    def _line(self, pen: ImageDraw.ImageDraw, axis: int, value: float, ends: tuple[float, float], color: Color) -> None:
        """Where coordinate `axis` has this value, the other one between `ends`: on whole pixels, hence crisp."""
        corners = [np.floor(self.pixel(np.array([value, end] if axis == 0 else [end, value]))) for end in ends]
        low, high = np.minimum(*corners) * OVERSAMPLING, (np.maximum(*corners) + 1) * OVERSAMPLING - 1
        pen.rectangle((*low, *high), fill=color)

    def _disc(self, pen: ImageDraw.ImageDraw, disc: Disc, frame: int) -> None:
        x, y = self.pixel(disc.position_at(frame)) * OVERSAMPLING
        r = self.radius(disc) * OVERSAMPLING
        pen.ellipse((x - r, y - r, x + r, y + r), fill=(*disc.color, OPACITY if disc.moves else 255))
        if disc.moves:
            edge = tuple(round(0.6 * c) for c in disc.color)
            pen.ellipse((x - r, y - r, x + r, y + r), outline=edge, width=round(1.3 * OVERSAMPLING))
        if disc.ringed:
            r += 4 * OVERSAMPLING
            pen.ellipse((x - r, y - r, x + r, y + r), outline=disc.color, width=2 * OVERSAMPLING)

    def _label(self, pen: ImageDraw.ImageDraw, disc: Disc, frame: int) -> None:
        if not disc.label:
            return
        x, y = self.pixel(disc.position_at(frame))
        r = self.radius(disc)
        if np.hypot(self.font.getlength(disc.label), 0.7 * self.font.size) < 1.9 * r:
            pen.text((x, y), disc.label, fill=WHITE, font=self.font, anchor="mm")
            return
        half = self.font.getlength(disc.label) / 2
        x = np.clip(x, half + 2, self.side - half - 2)
        below = self._label_below(disc, frame)
        pen.text((x, y + r + 2 if below else y - r - 2), disc.label, fill=BLACK, font=self.font, anchor=_ANCHOR[below])

    def _label_below(self, disc: Disc, frame: int) -> bool:
        """There is room for it there."""
        return self.pixel(disc.position_at(frame))[1] + self.radius(disc) + LABEL * self.font.size < self.side

    def _chart_box(self, disc: Disc, frame: int) -> Edges:
        """Where a message goes: above its disc, or below the label where there is no room above. In the picture."""
        assert disc.message is not None
        x, y = self.pixel(disc.position_at(frame))
        width = min(BAR * disc.message.shape[1], WIDEST_CHART) * self.side
        height, label = CHART * self.side, LABEL * self.font.size
        bottom = y - self.radius(disc) - 5 - (0 if self._label_below(disc, frame) else label)
        if bottom - height < 3:
            bottom = y + self.radius(disc) + label + 5 + height
        left = np.clip(x - width / 2, 3, self.side - width - 3)
        return left, bottom - height, left + width, bottom


_ANCHOR = {True: "ma", False: "md"}
"""Pillow's names for text that hangs below a point, and text that stands on it."""


def _chart(pen: ImageDraw.ImageDraw, heights: np.ndarray, marked: int | None, box: Edges) -> None:
    left, top, right, bottom = (round(edge) for edge in box)
    pen.rectangle((left - 2, top - 2, right + 1, bottom + 1), fill=WHITE, outline=PURPLE)
    ends = np.linspace(left, right, len(heights) + 1).round().astype(int)
    for k, height in enumerate(np.clip(heights, 0, 1)):
        tall = max(1, round(float(height) * (bottom - top)))  # an entry of zero is a line: one sees how many there are
        pen.rectangle((ends[k], bottom - tall, ends[k + 1] - 2, bottom - 1), fill=GREEN if k == marked else PURPLE)


def font(size: int) -> ImageFont.FreeTypeFont:
    """Pillow's own typeface, the same on every machine. size: pixels."""
    face = ImageFont.load_default(size)
    assert isinstance(face, ImageFont.FreeTypeFont)
    return face
