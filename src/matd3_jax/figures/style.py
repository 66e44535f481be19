"""How figures look: colors to distinguish with any color vision (Okabe and Ito 2008), dashes, and curves with bands."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from matd3_jax.runtime import files
from matd3_jax.stats.intervals import Estimate

if TYPE_CHECKING:  # the films take colors from here, without matplotlib
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Color = tuple[int, int, int]
"""(red, green, blue), 0 to 255."""

BLACK: Color = (0, 0, 0)
WHITE: Color = (255, 255, 255)
GREY: Color = (130, 130, 130)
DARK_GREY: Color = (77, 77, 77)

BLUE: Color = (0, 114, 178)
VERMILION: Color = (213, 94, 0)
GREEN: Color = (0, 158, 115)
PURPLE: Color = (204, 121, 167)
ORANGE: Color = (230, 159, 0)
SKY_BLUE: Color = (86, 180, 233)
YELLOW: Color = (240, 228, 66)
PALE_GREEN: Color = (166, 219, 203)
"""Green mixed with white, for what lies under everything else."""

TEAM: dict[str, Color] = {"agents": BLUE, "adversaries": VERMILION}
"""Where teams matter."""

AGENT: tuple[Color, ...] = (BLUE, VERMILION, GREEN, ORANGE, PURPLE, SKY_BLUE, YELLOW)
"""Where each agent has a color of its own; repeated beyond the last."""


def web(color: Color) -> str:
    """Write a color as "#RRGGBB", which matplotlib reads."""
    return "#{:02X}{:02X}{:02X}".format(*color)


SERIES: tuple[str, ...] = tuple(map(web, (BLUE, ORANGE, GREEN, PURPLE, VERMILION, SKY_BLUE, BLACK)))
"""Of curves in one figure, for matplotlib; without the yellow, which is faint on white."""

STYLES = ("solid", (0, (5, 1.5)), (0, (1, 1)), (0, (5, 1.5, 1, 1.5)), (0, (8, 2)))
"""As many as can be distinguished; 5 and the 7 colors have no common factor, so 35 lines differ in one or the other."""

PRINTED: dict[Any, Any] = {
    "font.size": 9,
    "axes.titlesize": 9,
    "legend.fontsize": 8,
    "pdf.fonttype": 42,
    "svg.fonttype": "none",
}
"""Sizes in points, for a picture that is printed at its own size; letters stay letters in PDF and SVG."""


DARK: dict[Any, Any] = {
    **dict.fromkeys(("figure.facecolor", "axes.facecolor", "savefig.facecolor"), "#1D2328"),
    **dict.fromkeys(("text.color", "axes.labelcolor", "axes.edgecolor", "xtick.color", "ytick.color"), "#E4E8EC"),
}
"""Over `PRINTED`, for a dark page."""


def save(figure: "Figure", path: Path, dpi: int) -> None:
    """Write a figure to `path`, in the format of its suffix, whole or not at all. dpi: dots an inch of a picture."""
    with files.replacing(path) as new:
        figure.savefig(new, dpi=dpi)


def dress(axis: "Axes") -> None:
    """Leave out the frame's upper and right sides and draw a faint grid."""
    axis.spines[["top", "right"]].set_visible(False)
    axis.grid(alpha=0.25)


def band(
    axis: "Axes",
    x: np.ndarray,
    estimate: Estimate,
    color: str,
    label: str | None = None,
    style: Any = "solid",
    seeds: np.ndarray | None = None,
    width: float = 1.5,
) -> None:
    """Draw a curve with its band, and behind it every seed's own curve.

    Args:
        x: [points]; a single one is drawn as a dot.
        estimate: [points]; no band where the ends are nan.
        color, style: as matplotlib has them.
        seeds: [seeds, points], drawn thin where there are several.
    """
    dot: dict[str, Any] = {"marker": "o", "markersize": 3} if len(x) == 1 else {}  # a line would not be seen
    if seeds is not None and len(seeds) > 1:
        axis.plot(x, seeds.T, color=color, linewidth=0.5, alpha=0.35, **dot)
    if not np.isnan(estimate.low).all():
        axis.fill_between(x, estimate.low, estimate.high, color=color, alpha=0.22, linewidth=0)
    axis.plot(x, estimate.value, color=color, linestyle=style, linewidth=width, label=label, **dot)
