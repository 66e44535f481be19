"""`python -m experiments.gpu_check out=DIR`: what a machine with an accelerator should run first, in about ten minutes.

Checks, then measures, then trains: (1) one update on the accelerator against the same update on the CPU, in float32;
(2) no copy of the replay in the compiled loop; (3) env steps/s over seeds at the paper's schedule; (4) MATD3 and MADDPG
on simple_spread, 20 seeds x 10,000 episodes, beside the authors' curves. Everything is written under `out`; a short
table comes last. `scale=0.01` tries the whole on a small machine.
"""

import json
import math
import re
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import throughput
from experiments import cooperative_navigation
from matd3_jax import command, config, devices, learner
from matd3_jax.errors import UserError
from matd3_jax.trainer import Trainer
from matd3_jax.training import Training

ROW_BYTES = 127 * 4
"""Of one simple_spread transition."""


def main(argv: Sequence[str]) -> int:
    taken, rest = config.take(argv, ("out", "scale", "seeds"))
    if rest or "out" not in taken:
        raise UserError("usage: python -m experiments.gpu_check out=DIR [scale=1.0] [seeds=[1,20,64,256]]")
    out, scale = Path(taken["out"]), float(taken.get("scale", 1.0))
    out.mkdir(parents=True, exist_ok=True)
    devices.prepare()
    report: dict[str, object] = {"machine": devices.description(), "versions": devices.versions()}
    report["update_error"] = update_error()
    report["replay_copies"] = replay_copies()
    print("checks:", {key: report[key] for key in ("update_error", "replay_copies")}, flush=True)
    assert report["update_error"] < 2e-2, "the update on this device differs from the CPU's"  # TF32 products: 1e-3
    counts = taken.get("seeds", [1, 20, 64, 256])
    free = devices.free_memory()
    fitting = [n for n in counts if n * 100_000 * ROW_BYTES < 0.8 * free]
    report["throughput"] = rows = []
    for seeds in fitting:
        begun = time.monotonic()
        rows += throughput.measure(["env=simple_spread"], seeds, repeats=3, seconds=max(0.05, 1.0 * scale))
        print(f"{seeds} seeds measured in {time.monotonic() - begun:.0f} s", flush=True)
        (out / "report.json").write_text(json.dumps(report, indent=1) + "\n")
    total = max(50_000, round(250_000 * scale))
    cooperative_navigation.main([f"seeds={20 if scale >= 1 else 2}", f"total_steps={total}", f"out={out}"])
    for row in rows:
        print(f"{row['seeds']:>5} {row['part']:<8} {row['env_steps_per_second']:>12,.0f} env steps/s")
    return 0


def update_error() -> float:
    """Largest difference in the networks after one MATD3 update between this device and a CPU, relative to the step."""
    training = Training(config.load(["seeds=1", "total_steps=100000"]))
    spec, hyper = training.spec, [training.config.algo.hyper_params()]
    results = []
    for device in (jax.devices()[0], jax.devices("cpu")[0]):
        with jax.default_device(device):
            state = learner.init(spec, jax.random.key(0))
            rows = jax.random.normal(jax.random.key(1), (spec.num_agents, 1024, spec.row_size)) * 0.3
            update = jax.jit(lambda s, r: learner.update(spec, s, hyper, r, jax.random.key(2), [True])[0])
            before, after = state[0].critic, update(state, rows)[0].critic
            results.append((jax.device_get(before), jax.device_get(after)))
    (before, ours), (_, theirs) = results
    step = max(np.abs(a - b).max() for a, b in zip(*map(jax.tree.leaves, (theirs, before)), strict=True))
    error = max(np.abs(a - b).max() for a, b in zip(*map(jax.tree.leaves, (ours, theirs)), strict=True))
    # Adam's first step is about lr in the gradient's direction: a sign that flips shows as a whole step.
    return float(error / step) if math.isfinite(error) else math.inf


def replay_copies() -> int:
    """Copies of the whole replay in the optimised program of a chunk."""
    trainer = Training(config.load(["seeds=4", "total_steps=100000"])).trainer
    state = trainer.abstract_state()
    shape = (trainer.rows, trainer.schedule.replay_capacity, trainer.spec.row_size)
    state = state._replace(replay=jax.ShapeDtypeStruct(shape, jnp.float32))
    return copies_in(trainer.chunk(3).jitted.lower(state, trainer.hyper).compile().as_text(), trainer)


def copies_in(text: str, trainer: Trainer) -> int:
    """Copies of a device's whole replay in the text of an optimised program."""
    shape = (trainer.rows, trainer.schedule.replay_capacity, trainer.spec.row_size)
    local = f"{shape[0] // trainer.mesh.size},{shape[1]},{shape[2]}"
    return len(re.findall(rf"= f32\[{local}\]\S* copy\(", text))


if __name__ == "__main__":
    sys.argv[0] = "gpu_check"
    command.run(main)
