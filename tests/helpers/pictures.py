"""What figures show: lines by label, bands and bars of the figures that are written, and the colors of their files."""

from pathlib import Path

import matplotlib.colors
import matplotlib.image
import numpy as np
from matplotlib.container import BarContainer
from matplotlib.figure import Figure

from matd3_jax.figures import style


def written(monkeypatch) -> dict[Path, Figure]:
    """The figures that are written from now on, by their files."""
    found, write = {}, style.save

    def save(figure, path, dpi):
        found[Path(path)] = figure
        return write(figure, path, dpi)

    monkeypatch.setattr(style, "save", save)
    return found


def lines(axis) -> dict[str, np.ndarray]:
    """Label to [(x, y), points] of the lines with a label."""
    return {line.get_label(): np.array(line.get_data()) for line in axis.lines if not line.get_label().startswith("_")}


def bands(axis) -> list[np.ndarray]:
    """[(x, low, high), points] of each band."""
    found = []
    for band in axis.collections:
        x, y = band.get_paths()[0].vertices.T
        places = np.unique(x)
        found.append(np.array([[at, y[x == at].min(), y[x == at].max()] for at in places]).T)
    return found


def bars(axis) -> list[tuple[float, float, str]]:
    """(place, height, color) of each bar."""
    rectangles = [bar for kept in axis.containers if isinstance(kept, BarContainer) for bar in kept]
    return [
        (bar.get_x() + bar.get_width() / 2, bar.get_height(), matplotlib.colors.to_hex(bar.get_facecolor()).upper())
        for bar in rectangles
    ]


def colors(path: Path) -> set[str]:
    """The colors that at least twenty pixels of a picture have."""
    pixels = (255 * matplotlib.image.imread(path)[..., :3]).round().astype(int).reshape(-1, 3)
    found, counts = np.unique(pixels, axis=0, return_counts=True)
    return {f"#{r:02X}{g:02X}{b:02X}" for (r, g, b), n in zip(found, counts, strict=True) if n >= 20}
