"""`python -m matd3_jax.report runs=A,B`: one HTML page about any set of runs."""

import math
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from matd3_jax.cli import catalog, command
from matd3_jax.errors import UserError, one_line
from matd3_jax.figures import learning_curves
from matd3_jax.figures.learning_curves import Line, Panel
from matd3_jax.reporting import facts, page, sections
from matd3_jax.reporting.facts import Run, Setting
from matd3_jax.runs import alike, curves, divergence
from matd3_jax.runtime import devices, files
from matd3_jax.runtime.terminal import say
from matd3_jax.stats import intervals

LARGEST_FILM = 10 * 10**6
"""Bytes; a larger one is named, and left out of the page."""
PICTURES = 100
"""Of a film that is made for the page, at most, besides the start."""


def main(argv: Sequence[str]) -> int:
    """Run the command; the exit code."""
    options = catalog.REPORT.parse(argv)
    if options.out.suffix.lower() not in (".html", ".htm"):
        raise UserError(f"out={options.out}: must end with .html")
    if len(set(options.runs)) < len(options.runs):
        raise UserError(f"runs={','.join(map(str, options.runs))}: names a run twice")
    settings = facts.read(options.runs)
    title = options.title or alike.common([one.settings for one in settings]) or "Comparison of runs"
    made, line = time.strftime("%Y-%m-%d %H:%M %Z"), command.line("matd3_jax.report", *argv)
    with tempfile.TemporaryDirectory() as folder:
        figures = [_figure(settings, name, Path(folder)) for name in facts.columns(settings)]
        films, without = _films(settings, options.films, Path(folder))
        pictures = page.Pictures([one for one in figures if one is not None], films, without)
        text = page.write(settings, pictures, title, made, line)
    files.write_text(options.out, text)
    runs = sum(len(one.runs) for one in settings)
    say(f"{options.out}: {runs} run{'s' * (runs > 1)}, {len(text.encode()) / 1e6:.1f} MB")
    for one in settings:
        if one.diverged:
            say(f"  {one.label}: {divergence.which(one.diverged)}, left out of all means")
    return 0


# ---- figures ---------------------------------------------------------------------------------------------------------


def _figure(settings: Sequence[Setting], name: str, folder: Path) -> tuple[str, Path, Path] | None:
    """Draw the learning curves of a column for light and dark pages; None where there is nothing to draw."""
    lines = []
    for one in settings:
        found = _curve(one, name)
        lines.append(Line(one.label, found.x, intervals.t_interval(found.values), found.values) if found else None)
    if not any(lines):
        return None
    light, dark = (
        folder / f"{len(list(folder.iterdir()))}_light.png",
        folder / f"{len(list(folder.iterdir()))}_dark.png",
    )
    for path in (light, dark):
        panel = Panel("return", lines)
        learning_curves.compare(path, [panel], "env steps of each seed", legend=False, dark=path is dark)
    return sections.words(name), light, dark


def _curve(one: Setting, name: str) -> curves.Curves | None:
    """The curve of a setting, up to where its first seed ends or diverges."""
    if name not in one.table:
        return None
    try:
        return curves.of_table(divergence.cut(one.table, one.diverged), name)
    except ValueError:
        pass
    try:  # a seed that diverged at once has no curve: draw the others
        return curves.of_table(divergence.without(one.table, one.diverged), name)
    except ValueError:
        return None


# ---- films -----------------------------------------------------------------------------------------------------------


def _films(settings: Sequence[Setting], which: str, folder: Path) -> tuple[dict[str, Path], dict[str, str]]:
    """Films by the names of runs, and why other runs have none."""
    found: dict[str, Path] = {}
    without: dict[str, str] = {}
    for run in (run for one in settings for run in one.runs) if which != "none" else ():
        path = _there(run)
        if path is None and which == "auto":
            path = folder / f"film_{len(found)}.gif"
            why = _played(run, path)
            if why is not None:
                without[run.name] = why
                continue
        if path is not None and path.stat().st_size > LARGEST_FILM:
            without[run.name] = f"{path} has {path.stat().st_size / 1e6:.0f} MB, too many for this page"
        elif path is not None:
            found[run.name] = path
    return found, without


def _there(run: Run) -> Path | None:
    """The last film of a run, of those made while it trained and by `render`."""
    made = [path for path in run.directory.videos.glob("*") if path.stem.isdecimal()]
    made = sorted(made, key=lambda path: int(path.stem))
    made += [run.directory.path / f"episode{suffix}" for suffix in (".mp4", ".gif")]
    there = [path for path in made if path.suffix in (".gif", ".mp4") and path.is_file() and not path.is_symlink()]
    return there[-1] if there else None


def _played(run: Run, path: Path) -> str | None:
    """Make a film with the last checkpoint of a run where that is quick, of tasks that are drawn in the plane; why not
    otherwise."""
    from matd3_jax.evaluation import trajectory
    from matd3_jax.training import checkpoint
    from matd3_jax.training.session import TrainingSession
    from matd3_jax.video import encode, frames
    from matd3_jax.video.scene2d import SceneDrawing

    line = f"make one with: {command.line('matd3_jax.render', run=run.name)}"
    if "physics" in run.settings.env:  # a robot, whose episode takes long to compile and to draw
        return line
    try:
        devices.prepare()
        training = TrainingSession(run.settings)
        drawing = frames.drawing_of(training.env)
        if not isinstance(drawing, SceneDrawing):
            return line
        state = checkpoint.restore_actors(checkpoint.verify(run.directory.checkpoints), training.trainer)
        finite = training.finite(state)
        if not finite.any():
            return "all its seeds diverged"
        played = trajectory.play(training, state, int(finite.argmax()), keep=drawing.select)
        shown = played.at(math.ceil(played.length / PICTURES))
        encode.write(path, frames.compose(drawing, shown.states, shown.captions(), 320), drawing.fps)
    except Exception as error:  # whatever is wrong with its checkpoint, the page has the rest
        return one_line(error)
    return None
