"""Robots in C MuJoCo: the numbers of a plain simulator, to the bit, whatever runs before, next to or around them."""

import dataclasses
import functools
import os
import queue
import subprocess
import sys
import threading
import time

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from jax.sharding import Mesh, PartitionSpec

from matd3_jax.envs import OptionError, make
from matd3_jax.envs.robots.engines import c, engine, models
from matd3_jax.envs.robots.quiet import quiet_mujoco

FILES = ("ant", "half_cheetah", "hopper", "walker2d_v5", "humanoid", "swimmer")
FIELDS = ("xpos", "qfrc_actuator", "cfrc_ext")
SKIP = 5
BATCH = 24


@functools.cache
def played(file):
    """[BATCH, ...] positions, velocities, solver starts and controls of random play, as the engine takes them."""
    model = engine.load(f"{file}.xml", "c").mj_model
    data, rng, rows = mujoco.MjData(model), np.random.default_rng(0), []
    while len(rows) < BATCH:
        if len(rows) % 8 == 0:
            mujoco.mj_resetData(model, data)
            data.qpos[:] += rng.uniform(-0.1, 0.1, model.nq)
        control = rng.uniform(*model.actuator_ctrlrange.T)
        for _ in range(5):
            data.ctrl[:] = rng.uniform(*model.actuator_ctrlrange.T)
            mujoco.mj_step(model, data, SKIP)
        rows.append((data.qpos.copy(), data.qvel.copy(), data.qacc_warmstart.copy(), control))
    return tuple(np.array(column, np.float32) for column in zip(*rows, strict=True))


@functools.cache
def single(file, physics=None):
    """One robot's step in the engine: inputs as of `played` -> arrays. `physics`: instead of the one that is loaded."""
    simulation = physics or engine.load(f"{file}.xml", "c")
    return lambda *inputs: simulation.advance(*inputs, SKIP, FIELDS)


@functools.cache
def batched(file):
    return jax.jit(jax.vmap(single(file)))


def step(file, inputs):
    return jax.device_get(batched(file)(*inputs))


def assert_equal_bits(found, wanted):
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
        a, b = np.asarray(a), np.asarray(b)
        assert (a.dtype, a.shape) == (b.dtype, b.shape)
        np.testing.assert_array_equal(a.view(np.uint32), b.view(np.uint32))


def take(inputs, rows):
    return tuple(part[rows] for part in inputs)


def at_once(*work):
    """What each function returns, each on a thread of its own, all at the same time. Fails where one does not end."""
    results, start = [None] * len(work), threading.Barrier(len(work))

    def run(k):
        start.wait()
        results[k] = work[k]()

    threads = [threading.Thread(target=run, args=(k,), daemon=True) for k in range(len(work))]
    for thread in threads:
        thread.start()
    deadline = time.monotonic() + 120  # for all together; takes 2 s
    for thread in threads:
        thread.join(timeout=max(0.0, deadline - time.monotonic()))
    assert not any(thread.is_alive() for thread in threads), "a deadlock"
    return results


# ---- the numbers -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("file", FILES)
def test_a_step_is_mujocos_own_to_the_bit(file):
    """A new simulator for each state, of gymnasium's file with halved margins and nothing else changed."""
    with quiet_mujoco():
        model = mujoco.MjModel.from_xml_path(str(models.assets() / f"{file}.xml"))
    model.geom_margin /= 2
    wanted = []
    for qpos, qvel, warmstart, control in zip(*played(file), strict=True):
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:], data.qacc_warmstart[:], data.ctrl[:] = qpos, qvel, warmstart, control
        for _ in range(SKIP):
            mujoco.mj_step(model, data)
        mujoco.mj_rnePostConstraint(model, data)
        parts = (data.qpos, data.qvel, data.qacc_warmstart, data.xpos, data.qfrc_actuator, data.cfrc_ext)
        wanted.append([np.array(part, np.float32) for part in parts])
    found = step(file, played(file))
    parts = (found.qpos, found.qvel, found.qacc_warmstart, *(found.fields[name] for name in FIELDS))
    assert_equal_bits(parts, [np.stack(column) for column in zip(*wanted, strict=True)])
    assert np.abs(found.qpos - played(file)[0]).max() > 0.01


def test_large_accelerations_are_no_blow_up():
    # The solver's start counts as little as where it starts: an impact's accelerations are no reason to end an episode.
    qpos, qvel, warmstart, control = played("walker2d_v5")
    hard = warmstart.copy()
    hard[:, -1] = 3e5
    found = step("walker2d_v5", (qpos, qvel, hard, control))
    wanted = step("walker2d_v5", played("walker2d_v5"))
    # Measured: no difference. A robot that were taken for blown up would be NaN.
    np.testing.assert_allclose(found.qvel, wanted.qvel, atol=1e-5)


def test_placing_computes_what_hangs_on_the_state_alone():
    qpos, qvel, *_ = played("humanoid")
    simulation = engine.load("humanoid.xml", "c")
    fields = ("cinert", "cvel", "xipos", "qfrc_actuator", "cfrc_ext")
    place = jax.jit(jax.vmap(lambda qpos, qvel: simulation.place(qpos, qvel, fields)))
    step("humanoid", played("humanoid"))  # leaves forces behind in the simulators
    found = jax.device_get(place(qpos, qvel))
    for k in range(BATCH):
        data = mujoco.MjData(simulation.mj_model)
        data.qpos[:], data.qvel[:] = qpos[k], qvel[k]
        mujoco.mj_forward(simulation.mj_model, data)
        for name in ("cinert", "cvel", "xipos"):
            np.testing.assert_array_equal(found.fields[name][k], getattr(data, name).astype(np.float32))
    assert not found.fields["qfrc_actuator"].any() and not found.fields["cfrc_ext"].any()
    assert not found.qacc_warmstart.any()
    np.testing.assert_array_equal(found.qpos, qpos)


# ---- the same whatever runs before, next to or around ---------------------------------------------------------------


@pytest.mark.parametrize("file", FILES)
def test_what_was_simulated_before_does_not_matter(file):
    inputs, rng = played(file), np.random.default_rng(1)
    wanted = step(file, inputs)
    for k in range(min(8, 2 * (os.cpu_count() or 1))):  # simulators take turns
        order = rng.permutation(BATCH)
        qpos, qvel, warmstart, control = take(inputs, order)
        if k % 2:  # a third blows up within the step, more or less
            qvel[::3] *= 9e4 / np.abs(qvel[::3]).max()
        else:
            qvel[1::3] = np.nan
        blown = step(file, (qpos, qvel, -10 * warmstart, -control))
        assert not (np.abs(blown.qvel) < 1e5).all()
        step(FILES[FILES.index(file) - 1], played(FILES[FILES.index(file) - 1]))
        assert_equal_bits(step(file, take(inputs, order)), jax.tree.map(lambda x: x[order], wanted))  # noqa: B023


@pytest.mark.parametrize("file", ["ant", "humanoid"])
def test_batches_of_any_shape_are_single_steps(file):
    inputs = take(played(file), slice(6))
    one = jax.jit(single(file))
    wanted = jax.tree.map(lambda *parts: np.stack(parts), *(one(*take(inputs, k)) for k in range(6)))
    assert_equal_bits(step(file, inputs), wanted)
    nested = jax.jit(jax.vmap(jax.vmap(single(file))))(*(part.reshape(2, 3, -1) for part in inputs))
    assert_equal_bits(jax.tree.map(lambda x: np.asarray(x).reshape(6, *x.shape[2:]), nested), wanted)
    rows = jax.jit(lambda *columns: jax.lax.map(lambda row: single(file)(*row), columns))(*inputs)
    assert_equal_bits(rows, wanted)
    # Controls batched, the state shared by all.
    shared = jax.jit(jax.vmap(single(file), in_axes=(None, None, None, 0)))(*take(inputs, 0)[:3], inputs[3])
    same = step(file, (*(np.repeat(part[:1], 6, axis=0) for part in inputs[:3]), inputs[3]))
    assert_equal_bits(shared, same)


def test_threads_do_not_disturb_each_other():
    wanted = {file: step(file, played(file)) for file in ("ant", "half_cheetah")}
    files = ["ant", "half_cheetah"] * 4
    rows = [np.roll(np.arange(BATCH), k) for k in range(len(files))]

    def work(file, rows):
        return lambda: [step(file, take(played(file), rows)) for _ in range(10)]

    for file, order, found in zip(files, rows, at_once(*map(work, files, rows)), strict=True):
        for again in found:
            assert_equal_bits(again, jax.tree.map(lambda x: x[order], wanted[file]))  # noqa: B023


def test_more_calls_than_simulators_wait_for_each_other():
    """One simulator, eight threads, and batches so large that JAX hands them over in another way than small ones."""
    plenty = engine.load("hopper.xml", "c")
    scarce = dataclasses.replace(plenty, simulators=queue.SimpleQueue())
    scarce.simulators.put(mujoco.MjData(plenty.mj_model))
    program = jax.jit(jax.vmap(single("hopper", scarce)))
    inputs = tuple(np.tile(part, (40, 1)) for part in played("hopper"))
    wanted = jax.tree.map(lambda x: np.tile(x, (40,) + (1,) * (x.ndim - 1)), step("hopper", played("hopper")))
    for found in at_once(*(lambda: [jax.device_get(program(*inputs)) for _ in range(3)] for _ in range(8))):
        for again in found:
            assert_equal_bits(again, wanted)
    assert scarce.simulators.qsize() == 1


def test_a_simulator_comes_back_from_a_call_that_fails(monkeypatch):
    plenty = engine.load("hopper.xml", "c")
    scarce = dataclasses.replace(plenty, simulators=queue.SimpleQueue())
    scarce.simulators.put(mujoco.MjData(plenty.mj_model))

    def fail(*args):
        raise ArithmeticError("went wrong")

    monkeypatch.setattr(mujoco, "mj_step", fail)
    with pytest.raises(Exception, match="went wrong"):
        jax.block_until_ready(single("hopper", scarce)(*take(played("hopper"), 0)))
    assert scarce.simulators.qsize() == 1


@pytest.mark.parametrize("name", ["ant", "humanoid"])
def test_two_devices_are_one(name):
    devices = jax.devices()[:2]
    assert len(devices) == 2
    mesh, spec = Mesh(np.array(devices), ("seeds",)), PartitionSpec("seeds")
    sharded = jax.jit(
        jax.shard_map(jax.vmap(single(name)), mesh=mesh, in_specs=spec, out_specs=spec, check_vma=False),
    )
    for _ in range(5):
        assert_equal_bits(jax.device_get(sharded(*played(name))), step(name, played(name)))


SCRIPT = """
import sys, numpy as np, jax
from matd3_jax.envs.robots.engines import engine
simulation = engine.load("humanoid.xml", "c")
inputs = [np.load(sys.argv[1])[k] for k in ("qpos", "qvel", "warmstart", "control")]
step = jax.jit(jax.vmap(lambda *row: simulation.advance(*row, 5, ("xpos", "qfrc_actuator", "cfrc_ext"))))
print("ready", flush=True)
sys.stdin.readline()
for _ in range(10):
    found = step(*inputs)
sys.stdout.write(b"".join(np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(found)).hex())
"""


def test_two_processes_at_the_same_time_compute_the_same(tmp_path):
    inputs = played("humanoid")
    np.savez(tmp_path / "in.npz", **dict(zip(("qpos", "qvel", "warmstart", "control"), inputs, strict=True)))
    words = [sys.executable, "-c", SCRIPT, str(tmp_path / "in.npz")]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    both = [subprocess.Popen(words, cwd=tmp_path, **pipes) for _ in range(2)]
    assert [process.stdout.readline() for process in both] == ["ready\n"] * 2
    for process in both:
        process.stdin.write("go\n")
        process.stdin.flush()
    wanted = b"".join(leaf.tobytes() for leaf in jax.tree.leaves(step("humanoid", inputs))).hex()
    for process in both:
        assert process.communicate(timeout=120)[0] == wanted


# ---- blow-ups --------------------------------------------------------------------------------------------------------


def test_a_robot_that_blows_up_leaves_its_neighbors_alone():
    inputs, wanted = played("ant"), step("ant", played("ant"))
    broken = [part.copy() for part in inputs]
    broken[0][1, 8], broken[1][4, 3], broken[1][7, 6], broken[3][9, 0] = np.inf, np.nan, 1e9, np.nan
    broken[2][11, 2] = np.inf
    broken[1][14] *= 3e3 / np.abs(broken[1][14]).max()  # finite and within all bounds when the step begins
    found, bad = step("ant", broken), np.isin(np.arange(BATCH), [1, 4, 7, 9, 11, 14])
    assert_equal_bits(jax.tree.map(lambda x: x[~bad], found), jax.tree.map(lambda x: x[~bad], wanted))
    assert not np.isfinite(found.qvel[bad]).all(axis=1).any()


@pytest.mark.parametrize("name", ["ant", "half_cheetah", "walker2d", "humanoid"])
def test_a_blow_up_ends_the_episode_without_reward_or_a_word(name, tmp_path, monkeypatch, capfd):
    """Also one that happens within the step. MuJoCo would print, and leave MUJOCO_LOG.TXT where the program runs."""
    monkeypatch.chdir(tmp_path)
    env = make(name, physics="c", split="single")
    # As loaded first: a warning that has been given once is not given again.
    fresh = c.load.__wrapped__(env.file)
    monkeypatch.setattr(type(env), "_engine", fresh)
    model, rng = env.mj_model, np.random.default_rng(0)
    qvel = rng.uniform(-1, 1, (BATCH, model.nv))
    qvel[1::2] *= 99_000  # below the limit of 1e5 when the step begins
    qvel[3::8], qvel[5::8] = np.nan, 1e9
    one = jax.vmap(lambda v, a: env.step(None, env.state(jnp.asarray(model.qpos0, jnp.float32), v), (a,)))
    action = rng.uniform(*model.actuator_ctrlrange.T, (BATCH, model.nu)).astype(np.float32)
    found = jax.device_get(jax.jit(one)(jnp.asarray(qvel, jnp.float32), action))
    assert found.terminated[1::2].all()
    assert (found.reward[1::2] == 0).all() and (found.state.terms[1::2] == 0).all()
    assert not found.terminated[::2].any() and (found.reward[::2] != 0).all()
    assert all((np.abs(part) <= 1e5).all() for part in found.observation)
    assert list(tmp_path.iterdir()) == []
    assert capfd.readouterr() == ("", "")


def test_mujoco_speaks_again_afterwards(tmp_path, monkeypatch):
    heard = []
    mujoco.set_mju_user_warning(heard.append)
    try:
        qpos, qvel, warmstart, control = played("hopper")
        at_once(*(lambda: step("hopper", (qpos, qvel * 1e4, warmstart, control)) for _ in range(4)))
        assert heard == []
        data = mujoco.MjData(engine.load("hopper.xml", "c").mj_model)
        data.qvel[:] = np.nan
        mujoco.mj_step(engine.load("hopper.xml", "c").mj_model, data)
        assert len(heard) > 0
    finally:
        mujoco.set_mju_user_warning(None)


# ---- which engine ----------------------------------------------------------------------------------------------------


def test_auto_is_c_on_cpus_and_mjx_elsewhere(monkeypatch):
    assert make("ant").physics == make("ant", physics="auto").physics == "c"
    assert isinstance(make("ant")._engine, c.CEngine)
    assert make("ant") == make("ant", physics="c")
    for backend in ("gpu", "tpu", "METAL"):
        monkeypatch.setattr(jax, "default_backend", lambda backend=backend: backend)
        assert make("ant").physics == make("ant", physics="auto").physics == "mjx"
        assert make("ant", physics="c").physics == "c"


@pytest.mark.parametrize(
    ("physics", "message"),
    [
        ("exact", "must be one of 'auto', 'c', 'mjx', 'mjx_fast'; it is called 'mjx' now"),
        ("fast", "must be one of 'auto', 'c', 'mjx', 'mjx_fast'; it is called 'mjx_fast' now"),
        ("mjx_fst", "did you mean 'mjx_fast'"),
        (None, "physics=None: must be one of"),
        (True, "physics=True: must be one of"),
    ],
)
def test_other_names_are_refused(physics, message):
    with pytest.raises(OptionError) as error:
        make("hopper", physics=physics)
    assert message in str(error.value)


def test_c_does_not_import_mjx(tmp_path):
    """MJX takes seconds to import."""
    program = (
        "import sys, jax\nfrom matd3_jax.envs import make\nenv = make('humanoid', physics='c')\n"
        "state, _ = jax.jit(env.reset)(jax.random.key(0))\n"
        "jax.jit(env.step)(None, state, tuple(jax.numpy.zeros(s.size) for s in env.action_spaces))\n"
        "print([name for name in sys.modules if name.startswith(('mujoco.mjx', 'brax'))])"
    )
    done = subprocess.run([sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True)
    assert (done.stdout, done.returncode) == ("[]\n", 0), done.stderr
