"""Commands on machines as they are: JAX's modes, no home, no OpenGL, signals, no space, several starts at once."""

import multiprocessing
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax
import numpy as np
import pytest

import matd3_jax
from matd3_jax import config
from matd3_jax.runs.directory import RunDirectory
from matd3_jax.runtime import devices

pytestmark = pytest.mark.slow

SMALL = {
    "seeds": 2, "total_steps": 400, "learning_starts": 100, "num_envs": 2, "rollout_length": 5, "batch_size": 16,
    "replay_capacity": 400, "log_every": 100, "eval_every": 200, "eval_episodes": 2,
}  # fmt: skip
NETWORKS = "algo.hidden=[8]", "algo.policy_delay=1"
WORDS = ["env=point_reach", *NETWORKS, *(f"{key}={value}" for key, value in SMALL.items())]


def train(*more: str, **how) -> subprocess.CompletedProcess:
    words = [sys.executable, "-m", "matd3_jax.train", *WORDS, *more]
    return subprocess.run(words, capture_output=True, text=True, timeout=300, **how)


@pytest.fixture(scope="module")
def plain():
    return matd3_jax.train(*NETWORKS, env="point_reach", **SMALL)


MODES = {
    "x64": lambda: jax.enable_x64(True),
    "strict types": lambda: jax.numpy_dtype_promotion("strict"),
    "strict ranks": lambda: jax.numpy_rank_promotion("raise"),
    "nan": lambda: jax.debug_nans(True),
}


@pytest.mark.parametrize("mode", MODES)
def test_modes_of_jax_leave_the_numbers_as_they_are(mode, plain):
    with MODES[mode]():
        found = matd3_jax.train(*NETWORKS, env="point_reach", **SMALL)
        played = found.evaluate(episodes=3)
    assert all(leaf.dtype != np.float64 for leaf in jax.tree.leaves(found.state) if hasattr(leaf, "dtype"))
    for name, column in plain.metrics.items():
        np.testing.assert_array_equal(found.metrics[name], column, err_msg=name)
    np.testing.assert_array_equal(played, plain.evaluate(episodes=3))


def test_the_environment_variable(tmp_path):
    """The command in a process of its own, which reads the variable as it starts."""
    done = train(f"out={tmp_path}", "name=x", env={**os.environ, "JAX_ENABLE_X64": "1"})
    assert done.returncode == 0, done.stderr
    words = [sys.executable, "-m", "matd3_jax.evaluate", f"run={tmp_path / 'x'}", "episodes=2"]
    played = subprocess.run(words, env={**os.environ, "JAX_ENABLE_X64": "1"}, capture_output=True, text=True)
    assert played.returncode == 0, played.stderr


def test_no_home(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    assert devices.cache_folder() == tmp_path / "cache" / "matd3_jax"
    (tmp_path / "file").touch()
    for home in (str(tmp_path / "file"), "/proc/nowhere", "relative"):
        monkeypatch.setenv("XDG_CACHE_HOME", home)
        monkeypatch.chdir(tmp_path)
        assert devices.cache_folder() is None
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setattr(Path, "home", lambda: (_ for _ in ()).throw(RuntimeError("Could not determine home")))
    assert devices.cache_folder() is None


@pytest.mark.parametrize("value", ["osmesa", "nonsense"])
def test_robots_need_no_opengl(value):
    code = (
        "import os, matd3_jax; from matd3_jax import envs; robot = envs.make('ant'); import mujoco\n"
        "print(robot.num_agents if hasattr(robot, 'num_agents') else len(robot.agents), os.environ['MUJOCO_GL'])"
    )
    environment = {**os.environ, "MUJOCO_GL": value, "PYOPENGL_PLATFORM": "osmesa"}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["2", value]


def test_ctrl_c_before_the_training(tmp_path):
    """While the modules are imported, say."""
    words = [sys.executable, "-X", "importtime", "-m", "matd3_jax.train", *WORDS, f"out={tmp_path}"]
    started = subprocess.Popen(words, stderr=subprocess.PIPE, text=True)
    for line in started.stderr:
        if "jax._src.core" in line:
            started.send_signal(signal.SIGINT)
            break
    said = started.stderr.read()
    assert started.wait(60) == 130
    assert said.splitlines()[-1] == "interrupted" and "Traceback" not in said
    assert not list(tmp_path.iterdir())


def test_no_space_at_a_checkpoint(tmp_path):
    """Files may not grow beyond 2 kB here; a run's checkpoints do."""
    shell = (
        f"ulimit -f 4; exec {sys.executable} -m matd3_jax.train {' '.join(map(repr, WORDS))} name=full out={tmp_path}"
    )
    environment = {name: value for name, value in os.environ.items() if name != "JAX_COMPILATION_CACHE_DIR"}
    environment |= {"XDG_CACHE_HOME": "/proc/nowhere"}
    done = subprocess.run(["bash", "-c", shell], env=environment, capture_output=True, text=True, timeout=300)
    # Orbax's other writers may complain of their closed event loop meanwhile, from threads that are not ours.
    assert done.returncode == 2 and "cli/train.py" not in done.stderr, done.stderr
    (said,) = re.findall(r"error: .*", done.stderr)
    assert "File too large" in said
    assert said.endswith(f"; resume with: python -m matd3_jax.train resume={tmp_path / 'full'}")
    assert not list(tmp_path.glob("full/checkpoints/[0-9]*"))


def make(out: str, begin: float) -> str:
    settings = config.load(WORDS)
    time.sleep(max(0.0, begin - time.time()))
    return RunDirectory.create(Path(out) / "same", settings, {}, or_another=True).path.name


def test_starts_at_the_same_time_get_names_of_their_own(tmp_path):
    with multiprocessing.get_context("spawn").Pool(4) as pool:
        pool.starmap(make, [(str(tmp_path / "warm"), 0.0)] * 4)
        found = pool.starmap(make, [(str(tmp_path / "runs"), time.time() + 1)] * 12, chunksize=3)
    assert sorted(found) == sorted(["same", *(f"same-{k}" for k in range(2, 13))])
    assert sorted(path.name for path in (tmp_path / "runs").iterdir()) == sorted(found)
