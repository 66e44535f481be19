"""The whole loop of matd3_jax.

Case: {"settings": overrides of the run, "steps": env steps of each seed in a block}.
"""

import jax
import serve

from matd3_jax import config
from matd3_jax.runtime import devices
from matd3_jax.training.session import TrainingSession

COMMON = ("eval_every=0", "total_steps=1000000")


def prepare(case: dict) -> serve.Block:
    """Warmed up and compiled; a block is one call of the program, all seeds counted."""
    devices.prepare()
    settings = config.load([*COMMON, *case["settings"]])
    training = TrainingSession(settings)
    trainer = training.trainer
    kept = [training.start()[0]]
    iterations = max(1, round(case["steps"] / trainer.iteration_steps))
    interval = trainer.interval(iterations)

    def block() -> int:
        state = kept.pop()  # the program reuses its memory
        kept.append(jax.block_until_ready(interval(state)[0]))
        return settings.seeds * iterations * trainer.iteration_steps

    return block


if __name__ == "__main__":
    serve.serve(prepare, ("matd3_jax", "jax", "brax"))
