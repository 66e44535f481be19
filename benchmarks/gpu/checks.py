"""Whether the numbers are right on this device: first of all, and compared with what other programs computed."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.gpu.report import Report, Row
from benchmarks.loop import copies_in
from matd3_jax import config, envs
from matd3_jax.core import update
from matd3_jax.training.session import TrainingSession

RECORDED = Path(__file__).parents[2] / "tests" / "data" / "ant"

PRECISIONS = {"default": None, "float32": "highest", "TF32": "tensorfloat32"}
"""Values of `jax_default_matmul_precision`. JAX leaves open what the default is; GPUs since NVIDIA's Ampere take TF32,
CPUs float32 for all three."""

PRODUCT, UPDATE, POSITION, VELOCITY = 5e-6, 1e-3, 1e-5, 2e-3
"""Errors allowed."""


def run(report: Report) -> None:
    """What is wrong goes into `Report.wrong`: measuring continues, as the machine may not come back."""
    products = report.case("check", "products", lambda: {k: product_error(value) for k, value in PRECISIONS.items()})
    if products is not None and not products["float32"] < PRODUCT:
        report.wrong.append(f"products in float32 are off by {products['float32']:.2g}")
    for name in ("float32", "default"):
        found = report.case("check", f"update, {name}", lambda name=name: update_error(PRECISIONS[name]))
        if name == "float32" and found is not None and not found["error"] < UPDATE:
            report.wrong.append(f"an update in float32 differs from the CPU's by {found['error']:.2g} of its length")
    copies = report.case("check", "replay", lambda: {"copies": replay_copies()})
    if copies is not None and copies["copies"]:
        report.wrong.append(f"the loop copies the replay {copies['copies']} times")
    step = report.case("check", "Ant", step_error)
    if step is not None and not (step["position_error"] < POSITION and step["velocity_error"] < VELOCITY):
        report.wrong.append(f"the physics differ from C MuJoCo: {step}; TF32 products?")


def product_error(precision: str | None) -> float:
    """Largest error of a product of two [256, 256] matrices of random numbers, relative to the largest entry:
    below 1e-6 in float32, about 3e-4 in TF32."""
    a, b = np.random.default_rng(0).normal(size=(2, 256, 256)).astype(np.float32)
    exact = a.astype(np.float64) @ b.astype(np.float64)
    with jax.default_matmul_precision(precision):
        found = jax.jit(jnp.matmul)(a, b)
    return float(np.abs(np.asarray(found, np.float64) - exact).max() / np.abs(exact).max())


def update_error(precision: str | None) -> Row:
    """How far one MATD3 update on this device is from the same on the CPU, as a part of the update's length: norms
    over all weights of all critics. (Adam's first step is about lr in the direction of each gradient's sign, which
    rounding may turn round where a gradient is next to 0: the largest difference would say little.)"""
    training = TrainingSession(config.load(["seeds=1", "total_steps=100000"]))
    layout, hyper = training.layout, [training.config.algo.hyper_params()]
    before, after = [], []
    for device, kind in ((jax.devices()[0], precision), (jax.devices("cpu")[0], "highest")):
        with jax.default_device(device), jax.default_matmul_precision(kind):
            state = update.init(layout, jax.random.key(0))
            rows = jax.random.normal(jax.random.key(1), (layout.num_agents, 1024, layout.row_size)) * 0.3
            program = jax.jit(lambda s, r: update.update(layout, s, hyper, r, jax.random.key(2), [True])[0])
            before.append(_flat(state[0].critic))
            after.append(_flat(program(state, rows)[0].critic))
    length = np.linalg.norm(after[1] - before[1])
    ours = after[0] - before[0] - (after[1] - before[1])
    return {"error": float(np.linalg.norm(ours) / length), "start": float(np.abs(before[0] - before[1]).max())}


def _flat(tree) -> np.ndarray:
    return np.concatenate([np.asarray(leaf, np.float64).ravel() for leaf in jax.tree.leaves(jax.device_get(tree))])


def replay_copies() -> int:
    """Copies of the whole replay in the optimized program of an interval."""
    trainer = TrainingSession(config.load(["seeds=4", "total_steps=100000"])).trainer
    state = trainer.abstract_state()
    shape = (trainer.sharding.padded_seeds, trainer.schedule.replay_capacity, trainer.layout.row_size)
    state = state._replace(replay=jax.ShapeDtypeStruct(shape, jnp.float32))
    text = trainer.interval(3).jitted.lower(state, trainer.hyper).compile().as_text()
    return copies_in(text, trainer)


def step_error() -> Row:
    """Largest errors of positions and velocities after single env steps from each recorded state, against C MuJoCo."""
    env = envs.make("ant", physics="mjx", split="single")
    data = [np.load(file) for file in sorted(RECORDED.glob("trajectory_*.npz"))]

    def columns(key: str, part: slice) -> jax.Array:
        return jnp.asarray(np.concatenate([d[key][part] for d in data]), jnp.float32)

    before, after = slice(0, -1), slice(1, None)
    step = jax.jit(jax.vmap(lambda qpos, qvel, a: env.step(None, env.state(qpos, qvel), (a,)).state))
    found = step(columns("qpos", before), columns("qvel", before), columns("action", slice(None)))
    errors = found.qpos[:, 2:] - columns("qpos", after)[:, 2:], found.qvel - columns("qvel", after)
    position, velocity = (float(jnp.abs(error).max()) for error in errors)
    return {"states": found.qpos.shape[0], "position_error": position, "velocity_error": velocity}
