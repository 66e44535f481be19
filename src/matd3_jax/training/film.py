"""Films of evaluation episodes while a run trains (`video_every`)."""

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from matd3_jax.config import Config
from matd3_jax.errors import one_line
from matd3_jax.runs.directory import RunDirectory
from matd3_jax.training.session import TrainingSession
from matd3_jax.training.state import TrainState

PICTURES = 100
"""Of a film, at most, besides the start."""
SIZE = 300
"""Longer side of a picture, pixels."""

Attach = Callable[[int, int, Path, int], object]
"""Takes the number of a run, an env step, a film, and the number of the seed that plays in it."""


class Filmer:
    """Plays the first evaluation episode with the first sound seed of each run, and leaves `videos/STEP.gif`.

    Training does not depend on it: the keys are those of evaluations, and the state is only read. Whatever keeps a film
    from being made (no OpenGL for a robot, an environment that cannot be drawn, a full disk) is reported once, and then
    none is tried again.

    Args:
        members: settings of the runs, and `seeds` where each run's seeds are.
        tell: gets the warning.
        attach: is handed every film.
    """

    def __init__(
        self,
        training: TrainingSession,
        runs: Sequence[RunDirectory],
        members: Sequence[Config],
        seeds: Sequence[slice],
        tell: Callable[[str], object],
        attach: Attach,
    ):
        self.training, self.tell, self.attach = training, tell, attach
        self.parts = list(enumerate(zip(runs, members, seeds, strict=True)))
        self.failed = False
        self._player: Any = None
        self._drawing: Any = None

    @staticmethod
    def wanted(members: Sequence[Config]) -> bool:
        """Whether any of the runs is filmed."""
        return any(config.video_every for config in members)

    def __call__(self, state: TrainState, before: int, step: int) -> None:
        """Film what is due between two env steps."""
        for number, (run, config, seeds) in self.parts:
            every = config.video_every
            if self.failed or not every or step // every == before // every:
                continue
            try:
                seed = self._sound(state, seeds)
                if seed is not None:
                    path = self._film(run, state, seed, step)
                    self.attach(number, step, path, config.seed + seed - seeds.start)
            except Exception as error:  # a film is never a reason to end a run
                self.failed = True
                self.tell(f"warning: no films are made any more: {one_line(error)[:300]}")

    def _sound(self, state: TrainState, seeds: slice) -> int | None:
        """The first of a run's seeds, of those in this process, whose networks are finite."""
        finite = self.training.finite(state)
        return next((place for place in range(len(finite))[seeds] if finite[place]), None)

    def _film(self, run: RunDirectory, state: TrainState, seed: int, step: int) -> Path:
        from matd3_jax.evaluation.trajectory import Player
        from matd3_jax.video import encode, frames

        if self._player is None:
            self._drawing = frames.drawing_of(self.training.env)
            self._player = Player(self.training, keep=self._drawing.select)
        played = self._player.play(state, seed)
        shown = played.at(math.ceil(played.length / PICTURES))
        captions = [f"{step:,} | {caption}" for caption in shown.captions()]
        pictures = frames.compose(self._drawing, shown.states, captions, SIZE)
        run.videos.mkdir(exist_ok=True)
        path = run.videos / f"{step}.gif"
        encode.write(path, pictures, self._drawing.fps)
        return path


def where(members: Sequence[Config]) -> list[slice]:
    """Where each run's seeds are, side by side."""
    ends = np.cumsum([config.seeds for config in members]).tolist()
    return [slice(end - config.seeds, end) for end, config in zip(ends, members, strict=True)]
