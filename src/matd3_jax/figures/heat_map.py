"""The matrix of a cross-play as a picture: one panel for each team's return."""

import itertools
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib import colormaps
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from matd3_jax.evaluation.cross_play import TEAMS
from matd3_jax.evaluation.cross_play_table import Mean, Pairings
from matd3_jax.figures import style
from matd3_jax.stats.text import plus_minus


def draw(path: Path, names: Sequence[str], pairings: Pairings, title: str) -> None:
    """Write the picture: rows are the runs of the agents, columns those of the adversaries.

    In each cell stands the mean return with its interval; a run against itself is framed, and the pairs trained
    together stand there apart. A cell's color is the mean over the others, where there are others. The colors can
    be distinguished with any color vision, and in grey.
    """
    n = len(names)
    longest = max(len(name) for name in names)
    panel = max(2.6, 1.25 * n)
    size = 2 * (panel + 1.4 + 0.08 * longest), panel + 1.4 + 0.06 * longest
    figure = Figure(figsize=size, layout="constrained")
    FigureCanvasAgg(figure)
    axes = np.atleast_1d(np.asarray(figure.subplots(1, 2), dtype=object))
    for t, (axis, team) in enumerate(zip(axes, TEAMS, strict=True)):
        values = np.full((n, n), np.nan)
        texts: dict[tuple[int, int], str] = {}
        for i in range(n):
            for j in range(n):
                own, cross = (pairings.cell(i, j, own) for own in (True, False))
                shown = own if cross is None else cross
                assert shown is not None
                values[i, j] = shown.value[t]
                words = [text(cross, t)] if cross is not None else []
                words += ["own " + text(own, t)] if own is not None else []
                texts[i, j] = "\n".join(words).replace(" ± ", "\n± ")
        image = axis.imshow(np.ma.masked_invalid(values), cmap=colormaps["cividis"].with_extremes(bad="lightgrey"))
        for (i, j), label in texts.items():
            red, green, blue, _ = image.cmap(image.norm(values[i, j])) if np.isfinite(values[i, j]) else (1, 1, 1, 1)
            dark = 0.299 * red + 0.587 * green + 0.114 * blue < 0.5
            axis.text(j, i, label, ha="center", va="center", fontsize=8, color="white" if dark else "black")
        for i, (color, width) in itertools.product(range(n), (("white", 4.0), ("black", 1.8))):
            corner = (i - 0.47, i - 0.47)
            axis.add_patch(Rectangle(corner, 0.94, 0.94, fill=False, edgecolor=color, linewidth=width))
        axis.set_xticks(range(n), names, rotation=30, ha="right", rotation_mode="anchor")
        axis.set_yticks(range(n), names)
        axis.set_xlabel("adversaries of")
        axis.set_ylabel("agents of")
        axis.set_title(f"return of {team}", fontsize=10)
        axis.spines[:].set_visible(False)
        figure.colorbar(image, ax=axis, fraction=0.05)
    figure.suptitle(f"{title}\nframed: a run against itself; own: trained together (same run, same seed)", fontsize=10)
    style.save(figure, path, dpi=120)


def text(mean: Mean, team: int) -> str:
    """Write a team's mean return with the half width of its interval."""
    return plus_minus(mean.value[team], mean.half[team], ".2f", ".2f")
