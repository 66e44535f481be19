"""`python -m experiments.gpu_ant out=DIR`: the Ant on an accelerator: checked, measured, trained.

    python -m experiments.gpu_ant out=DIR [algos=[matd3]] [total_steps=1000000] [scale=1.0] [key=value ...]

(1) Single env steps from the recorded states against C MuJoCo, on this device: its products must be full float32 within
the physics. (2) Env steps/s of the physics, exact and fast, over numbers of environments, and of the whole loop with
six seeds and the wide schedule. (3) `experiments.ant`: six seeds of each algorithm with physics=exact. Everything is
written under `out`; a short table comes last. Other keys are settings of the training; `scale=0.01` tries the whole on
a small machine.
"""

import json
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import robots, throughput
from experiments import ant
from matd3_jax import command, config, devices, envs
from matd3_jax.errors import UserError

RECORDED = Path(__file__).parents[1] / "tests" / "data" / "ant"
DEFAULTS: dict[str, Any] = {"out": None, "algos": ["matd3"], "total_steps": 1_000_000, "scale": 1.0}


def main(argv: Sequence[str]) -> int:
    taken, overrides = config.take(argv, tuple(DEFAULTS))
    options = {**DEFAULTS, **taken}
    if options["out"] is None:
        raise UserError("usage: python -m experiments.gpu_ant out=DIR [algos=[matd3]] [total_steps=N] [scale=1.0]")
    out, scale = Path(options["out"]), float(options["scale"])
    out.mkdir(parents=True, exist_ok=True)
    devices.prepare()
    report: dict[str, Any] = {"machine": devices.description(), "versions": devices.versions(), "rows": []}

    def save() -> None:
        (out / "report.json").write_text(json.dumps(report, indent=1) + "\n")

    report["step_error"] = step_error()
    print("largest errors of single steps (positions, velocities):", report["step_error"], flush=True)
    assert report["step_error"][0] < 1e-5 and report["step_error"][1] < 2e-3, "physics differ from C: TF32 products?"
    counts = [1, 16, 256, 4096] if scale >= 1 else [1, 16]
    for physics in ("exact", "fast"):
        for n in counts:
            settings = ["env=ant", f"env.physics={physics}", *robots.schedule(n)]
            rows = throughput.measure(settings, 1, 3, max(0.05, scale), ("environment",))
            report["rows"] += [{"physics": physics, "num_envs": n, **row} for row in rows]
            save()
    seeds = 6 if scale >= 1 else 1
    wide = ["env=ant", "schedule=wide", f"learning_starts={10_000 if scale >= 1 else 1000}", *overrides]
    rows = throughput.measure(wide, seeds, 3, max(0.05, scale))
    report["rows"] += [{"physics": "exact", "num_envs": 20, **row} for row in rows]
    save()
    for row in report["rows"]:
        where = f"{row['physics']:<6} {row['num_envs']:>5} environments x {row['seeds']} seeds, {row['part']}:"
        print(f"{where:<55} {row['env_steps_per_second']:>12,.0f} env steps/s")
    total = max(2000, round(options["total_steps"] * scale))
    begun = time.monotonic()
    code = ant.main([
        "algos=[" + ",".join(options["algos"]) + "]", f"runs={out / 'runs'}", f"out={out}", "schedule=wide",
        f"seeds={seeds}", f"total_steps={total}", f"learning_starts={min(10_000, total // 2)}", *overrides,
    ])  # fmt: skip
    print(f"trained in {time.monotonic() - begun:.0f} s")
    return code


def step_error() -> tuple[float, float]:
    """Largest error of positions and velocities after one env step from each recorded state, against C MuJoCo."""
    env = envs.make("ant", split="single")
    data = [np.load(file) for file in sorted(RECORDED.glob("trajectory_*.npz"))]

    def columns(key: str, part: slice) -> jax.Array:
        return jnp.asarray(np.concatenate([d[key][part] for d in data]), jnp.float32)

    before, after = slice(0, -1), slice(1, None)
    step = jax.jit(jax.vmap(lambda qpos, qvel, a: env.step(None, env.state(qpos, qvel), (a,)).state))
    found = step(columns("qpos", before), columns("qvel", before), columns("action", slice(None)))
    errors = found.qpos[:, 2:] - columns("qpos", after)[:, 2:], found.qvel - columns("qvel", after)
    return float(jnp.abs(errors[0]).max()), float(jnp.abs(errors[1]).max())


if __name__ == "__main__":
    sys.argv[0] = "gpu_ant"
    command.run(main)
