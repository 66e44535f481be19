"""Programs that call LAPACK do not wait forever for the threads of XLA's CPU backend."""

import dataclasses
import os
import subprocess
import sys
import textwrap
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest

from matd3_jax import config, envs
from matd3_jax.thread_pool import THREADS, calls_lapack

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("error::RuntimeWarning")]

ELSEWHERE = {name: value for name, value in os.environ.items() if name not in ("NPROC", "XLA_FLAGS")}

COUNT = """
count = len(jax.devices())
threads = 0
for path in Path("/proc/self/task").iterdir():
    try:
        threads += (path / "comm").read_text().startswith("tf_XLAEigen")
    except OSError:
        pass  # a thread that has come to its end
print(threads, count)
"""


def run(program: str, **variables: str) -> list[str]:
    """What a program prints in a process of its own, in words."""
    head = "import os\nfrom pathlib import Path\nimport jax\nimport jax.numpy as jnp\n"
    process = subprocess.run(
        [sys.executable, "-c", head + textwrap.dedent(program) + COUNT],
        env=ELSEWHERE | variables,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert process.returncode == 0, process.stderr
    return process.stdout.split()


linux = pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="threads are counted in /proc")


@linux
def test_many_calls_at_a_time_come_to_an_end():
    """With a thread for each of two cores this one waits forever."""
    program = """
        from matd3_jax.thread_pool import make_room_for_lapack

        jax.config.update("jax_num_cpu_devices", 2)
        make_room_for_lapack("this test")
        mesh = jax.make_mesh((2,), ("seeds",))
        split = jax.sharding.NamedSharding(mesh, jax.P("seeds"))

        def step(x, _):
            near = [jnp.eye(32) * 3 + 1e-3 * jnp.sin(k * x) @ jnp.swapaxes(x, -1, -2) for k in range(1, 7)]
            return jnp.tanh(sum(map(jax.lax.linalg.cholesky, near)) + x), None

        loop = jax.shard_map(lambda x: jax.lax.scan(step, x, length=200)[0], mesh=mesh, out_specs=jax.P("seeds"))
        x = jax.device_put(jax.random.normal(jax.random.key(0), (128, 32, 32)), split)
        assert jnp.isfinite(jax.jit(loop)(x)).all()
    """
    threads, count = run(program)
    assert int(threads) >= THREADS * 2 and count == "2"


@linux
@pytest.mark.parametrize(
    ("settings", "more"),
    [
        (["env=half_cheetah", "env.physics=mjx"], True),
        (["env=brax_swimmer"], True),
        (["env=simple_spread"], False),
        (["env=half_cheetah"], False),
        (["env=brax_half_cheetah"], False),
    ],
)
def test_only_runs_that_call_lapack_get_more_threads(settings, more):
    program = f"""
        from matd3_jax import config
        from matd3_jax.runtime import devices
        from matd3_jax.training.session import TrainingSession

        devices.prepare()
        TrainingSession(config.load({settings!r}))
    """
    threads, count = map(int, run(program))
    assert threads == (THREADS * count if more else count)


def test_what_each_environment_calls():
    """Those that ask for threads are those that call LAPACK."""
    for settings, expected in (
        (["env=half_cheetah", "env.physics=mjx_fast"], True),
        (["env=brax_swimmer"], True),
        (["env=brax_half_cheetah"], False),
        (["env=simple_world_comm"], False),
    ):
        env = envs.make(**config.load(settings).env)
        state, _ = jax.eval_shape(env.reset, jax.random.key(0))
        actions = tuple(jnp.zeros(space.shape) for space in env.action_spaces)
        programs = jax.make_jaxpr(env.reset)(jax.random.key(0)), jax.make_jaxpr(env.step)(None, state, actions)
        assert any(map(calls_lapack, programs)) == expected, settings


def test_calls_are_found_inside_loops_and_branches():
    def inside(x):
        body = lambda i, y: jax.lax.cond(i > 1, lambda z: jnp.linalg.cholesky(z), lambda z: z, y)  # noqa: E731
        return jax.lax.fori_loop(0, 3, body, x)

    assert calls_lapack(jax.make_jaxpr(inside)(jnp.eye(3)))
    assert not calls_lapack(jax.make_jaxpr(lambda x: jax.lax.fori_loop(0, 3, lambda i, y: y @ y, x))(jnp.eye(3)))


@pytest.mark.parametrize("call", ["inv", "solve", "det", "eigh", "svd", "qr", "eig", "pinv", "lstsq"])
def test_all_of_jax_numpy_is_known(call):
    x = jnp.eye(5) * 2
    function = getattr(jnp.linalg, call)
    both = (lambda m: function(m, m)) if call in ("solve", "lstsq") else function
    assert "lapack_" in jax.jit(both).lower(x).as_text()
    assert calls_lapack(jax.make_jaxpr(both)(x))


@dataclasses.dataclass(frozen=True, kw_only=True)
class Solving(type(envs.make("point_reach"))):
    """An environment of one's own that solves a system of equations in each step."""

    def step(self, key, state, action):
        found = super().step(key, state, action)
        scale = jnp.linalg.solve(jnp.eye(2), jnp.ones(2))
        return found._replace(reward=found.reward * scale[0])


def test_it_is_too_late_once_jax_computes(monkeypatch):
    jax.devices()
    envs.check(Solving())  # these tests have enough
    monkeypatch.setenv("NPROC", "2")
    needed = THREADS * max(len(os.sched_getaffinity(0)), 2)
    with pytest.warns(RuntimeWarning, match=rf"^Solving\.step calls LAPACK, .*; set NPROC={needed} in"):
        envs.check(Solving())
    envs.check(envs.make("point_reach"))
    assert os.environ["NPROC"] == "2"


@linux
def test_ones_own_environment_and_ones_own_number():
    program = """
        from matd3_jax import envs

        jax.config.update("jax_num_cpu_devices", 3)
        from test_thread_pool import Solving

        envs.check(Solving())
    """
    path = os.pathsep.join([str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")])
    cores = len(os.sched_getaffinity(0))
    assert run(program, PYTHONPATH=path) == [str(THREADS * max(3, cores)), "3"]
    assert run(program, PYTHONPATH=path, NPROC="100") == ["100", "3"]
