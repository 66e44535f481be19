"""Write pictures as a moving one: GIF with Pillow, MP4 with ffmpeg."""

import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from matd3_jax.errors import UserError
from matd3_jax.runtime import files

LAST_FRAME_SECONDS = 1.0
"""How much longer a GIF shows its last frame, before it starts again."""
SAMPLES = 16
"""Frames from which a GIF's one palette is drawn."""
FASTEST_GIF = 50
"""Frames per second: viewers slow down what is faster."""


def check(path: Path, fps: float) -> None:
    """Raise UserError where `write` could not: another suffix, no folder, no ffmpeg, a rate that GIF cannot have."""
    if path.suffix not in (".gif", ".mp4"):
        raise UserError(f"out={path}: the name must end with .gif or .mp4")
    if path.is_dir() or not path.parent.is_dir():
        raise UserError(f"out={path}: " + ("is a folder" if path.is_dir() else f"there is no folder {path.parent}"))
    if path.suffix == ".gif" and fps > FASTEST_GIF:
        raise UserError(f"fps={fps}: a GIF shows at most {FASTEST_GIF} frames a second; choose less, or .mp4")
    if path.suffix == ".mp4" and shutil.which("ffmpeg") is None:
        raise UserError(f"out={path}: MP4 needs ffmpeg on the PATH; install it, or choose a name that ends with .gif")


def write(path: Path, frames: Sequence[Image.Image], fps: float, colors: int = 64) -> None:
    """Write `frames`, all of one size, to `path` (.gif or .mp4), an existing file included.

    fps: frames per second; GIF rounds the time of a frame to hundredths of a second. colors: of a GIF, at most 256.

    Raises UserError as `check` does, and where writing fails.
    """
    check(path, fps)
    try:
        with files.replacing(path) as new:
            if path.suffix == ".gif":
                _write_gif(new, frames, fps, colors)
            else:
                _write_mp4(new, frames, fps)
    except OSError as error:
        raise UserError(f"cannot write {path}: {error.strerror or error}") from error


def _write_gif(path: Path, frames: Sequence[Image.Image], fps: float, colors: int) -> None:
    palette = _palette(frames, colors)
    # Without dithering: what stands still stays the same from frame to frame, and is not stored again.
    flat = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    duration = 10 * round(100 / fps)
    durations = [duration] * (len(flat) - 1) + [duration + round(1000 * LAST_FRAME_SECONDS)]
    flat[0].save(path, save_all=True, append_images=flat[1:], duration=durations, loop=0, optimize=True)


def _palette(frames: Sequence[Image.Image], colors: int) -> Image.Image:
    """One palette for all frames, from some of them side by side."""
    picked = [frames[i] for i in np.unique(np.linspace(0, len(frames) - 1, SAMPLES).round().astype(int))]
    width, height = picked[0].size
    strip = Image.new("RGB", (width * len(picked), height))
    for k, frame in enumerate(picked):
        strip.paste(frame, (k * width, 0))
    # Not by how often a color occurs: an agent is small on a large background. Then the means of what is nearest to
    # each: white stays white.
    return strip.quantize(colors, method=Image.Quantize.MAXCOVERAGE, kmeans=2)


def _write_mp4(path: Path, frames: Sequence[Image.Image], fps: float) -> None:
    width, height = frames[0].size
    # Raw pictures in; out what every player takes: 4:2:0 color, hence even sides.
    command = [
        "ffmpeg", "-y", "-loglevel", "error",
        "-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", str(fps), "-i", "-",
        "-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2:color=white", "-pix_fmt", "yuv420p", str(path.absolute()),
    ]  # fmt: skip
    data = b"".join(frame.convert("RGB").tobytes() for frame in frames)
    done = subprocess.run(command, input=data, stderr=subprocess.PIPE, check=False)
    if done.returncode:
        lines = done.stderr.decode(errors="replace").strip().splitlines() or ["no message"]
        raise UserError(f"ffmpeg could not write the film: {lines[-1]}")
