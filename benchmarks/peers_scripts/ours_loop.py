"""The whole loop of matd3_jax.

Case: {"settings": overrides of the run, "steps": env steps of each seed in a stretch}.
"""

import jax
import serve

from matd3_jax import config
from matd3_jax.runtime import devices
from matd3_jax.training.session import TrainingSession

COMMON = ("eval_every=0", "total_steps=1000000")


def prepare(case: dict) -> serve.Stretch:
    """Prefilled and compiled; a stretch is one call of the program, all seeds counted."""
    devices.prepare()
    settings = config.load([*COMMON, *case["settings"]])
    training = TrainingSession(settings)
    trainer = training.trainer
    kept = [training.start()[0]]
    cycles = max(1, round(case["steps"] / trainer.iteration_steps))
    chunk = trainer.interval(cycles)

    def stretch() -> int:
        state = kept.pop()  # the program reuses its memory
        kept.append(jax.block_until_ready(chunk(state)[0]))
        return settings.seeds * cycles * trainer.iteration_steps

    return stretch


if __name__ == "__main__":
    serve.serve(prepare, ("matd3_jax", "jax", "brax"))
