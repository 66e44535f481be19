"""`python -m matd3_jax.render run=RUN_DIR`: a GIF or MP4 of an evaluation episode."""

import math
from collections.abc import Sequence

import numpy as np

from matd3_jax.cli import catalog
from matd3_jax.errors import UserError
from matd3_jax.evaluation import trajectory
from matd3_jax.runs.directory import RunDirectory
from matd3_jax.runtime import devices
from matd3_jax.runtime.terminal import say
from matd3_jax.training import memory, saved_policies
from matd3_jax.training.session import TrainingSession
from matd3_jax.video import encode, frames

PICTURES = 200
"""At most, besides the start, unless `every` says otherwise."""


def main(argv: Sequence[str]) -> int:
    """Run the command; the exit code."""
    options = catalog.RENDER.parse(argv)
    devices.prepare()
    run, settings = RunDirectory.open(options.run)
    seed = settings.seed if options.seed is None else options.seed
    last = settings.seed + settings.seeds - 1
    if not settings.seed <= seed <= last:
        raise UserError(f"seed={seed}: the seeds of {run.path} are {settings.seed} to {last}")
    out = options.out or run.path / "episode.gif"
    encode.check(out, options.fps or 1)
    training = TrainingSession(settings)
    longest = training.env.episode_length
    steps = longest if options.max_steps is None else min(options.max_steps, longest)
    kept = memory.Part(steps * memory.playing_bytes(training.env, training.layout), "its env steps", "max_steps", steps)
    memory.check([kept], devices.free_memory())
    drawing = frames.drawing_of(training.env)
    saved = saved_policies.load(run, training, options.checkpoint)
    state, finite, place = saved.state, saved.finite, seed - settings.seed
    if not finite[place]:
        others = ", ".join(str(settings.seed + i) for i in np.flatnonzero(finite))
        raise UserError(
            f"seed={seed} of {run.path} diverged: its networks are not finite at env step {saved.steps[place]:,}"
            + (f"; they are with seed={others}" if others else ", and so with all others; try an earlier checkpoint=")
        )
    played = trajectory.play(
        training,
        state,
        place,
        options.episode,
        options.deterministic,
        options.max_steps,
        keep=drawing.select,
    )
    shown = played.at(options.every or math.ceil(played.length / PICTURES))
    pictures = frames.compose(drawing, shown.states, shown.captions(), options.size)
    encode.write(out, pictures, options.fps or drawing.fps)
    say(
        f"{out}: {len(pictures)} frames of episode {options.episode} with seed {seed}, {played.length} env steps "
        f"({played.end}), {played.result}"
    )
    return 0
