"""`python -m matd3_jax.render run=RUN_DIR`: a GIF or MP4 of an evaluation episode."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from matd3_jax import config
from matd3_jax.errors import UserError, nearest
from matd3_jax.evaluation import trajectory
from matd3_jax.runs.directory import RunDirectory
from matd3_jax.runtime import devices
from matd3_jax.training import checkpoint
from matd3_jax.training.session import TrainingSession
from matd3_jax.video import encode, frames

HELP = """usage: python -m matd3_jax.render run=RUN_DIR [key=value ...]

Plays one evaluation episode with the policies of one seed and draws it, each picture with the env step and the return
so far.

  out=RUN_DIR/episode.gif  where to: a name that ends with .gif, or with .mp4 (needs ffmpeg)
  seed=                    which of the run's seeds; default: the first
  checkpoint=STEP          default: the last
  episode=0                which of the episodes that `evaluate` plays
  deterministic=true       false: with exploration noise, as in training
  max_steps=               stop after so many env steps; default: the whole episode
  every=                   draw every n-th env step; default: the least that makes some 200 at most
  size=400                 pixels of the longer side
  fps=                     pictures per second; default: 10, robots 20

Robots need OpenGL, in software or not; the environment variable MUJOCO_GL (egl, osmesa, glfw) chooses which."""

DEFAULTS: dict[str, Any] = {
    "run": None,
    "out": None,
    "seed": None,
    "checkpoint": None,
    "episode": 0,
    "deterministic": True,
    "max_steps": None,
    "every": None,
    "size": 400,
    "fps": None,
}
RANGES = {
    "seed": (0, math.inf),
    "checkpoint": (0, math.inf),
    "episode": (0, 9999),
    "max_steps": (1, math.inf),
    "every": (1, math.inf),
    "size": (100, 2000),
    "fps": (1, 100),
}
"""Of what must be a whole number."""
PICTURES = 200
"""At most, besides the start, unless `every` says otherwise."""


def main(argv: Sequence[str]) -> int:
    """Run the command; the exit code."""
    if {"-h", "--help"} & set(argv):
        print(HELP)
        return 0
    devices.prepare()
    options = _options(argv)
    run, settings = RunDirectory.open(Path(options["run"]))
    seed = settings.seed if options["seed"] is None else options["seed"]
    last = settings.seed + settings.seeds - 1
    if not settings.seed <= seed <= last:
        raise UserError(f"seed={seed}: the seeds of {run.path} are {settings.seed} to {last}")
    out = run.path / "episode.gif" if options["out"] is None else Path(str(options["out"]))
    encode.check(out, options["fps"] or 1)
    training = _training(settings)
    drawing = frames.drawing_of(training.env)
    state = checkpoint.restore_actors(checkpoint.verify(run.checkpoints, options["checkpoint"]), training.trainer)
    played = trajectory.play(
        training,
        state,
        seed - settings.seed,
        options["episode"],
        options["deterministic"],
        options["max_steps"],
        keep=drawing.select,
    )
    shown = played.at(options["every"] or math.ceil(played.length / PICTURES))
    pictures = frames.compose(drawing, shown.states, shown.captions(), options["size"])
    encode.write(out, pictures, options["fps"] or drawing.fps)
    print(
        f"{out}: {len(pictures)} frames of episode {options['episode']} with seed {seed}, {played.length} env steps "
        f"({played.end}), {played.result}"
    )
    return 0


def _training(settings: config.Config) -> TrainingSession:
    try:
        return TrainingSession(settings)
    except RuntimeError as error:
        if "MUJOCO_GL" in str(error):  # MuJoCo cannot even be imported with a value that it does not know
            raise UserError(" ".join(str(error).split())) from error
        raise


def _options(argv: Sequence[str]) -> dict[str, Any]:
    taken, rest = config.take(argv, tuple(DEFAULTS))
    if rest:
        key = rest[0].split("=")[0]
        raise UserError(f"there is no key {key!r}; {nearest(key, DEFAULTS)}")
    options = {**DEFAULTS, **taken}
    if options["run"] is None:
        raise UserError("say which run to draw: run=RUN_DIR")
    options["run"] = str(options["run"])
    for key, (least, most) in RANGES.items():
        value = options[key]
        if (value is None and DEFAULTS[key] is None) or (type(value) is int and least <= value <= most):
            continue
        bounds = f"of at least {least}" if most == math.inf else f"from {least} to {most}"
        raise UserError(f"{key}={value!r}: must be a whole number {bounds}")
    if type(options["deterministic"]) is not bool:
        raise UserError(f"deterministic={options['deterministic']!r}: must be true or false")
    return options
