"""Two CPU devices for the tests of sharding, quick compiles, and a worker for each core.

Nearly all of the suite's time goes into compiling. Therefore everything, single operations and the processes that tests
start included, is compiled with little optimization, and a program that was compiled once is loaded from then on.
"""

import collections
import functools
import gc
import importlib.metadata
import math
import os
import shutil
import signal
import tempfile
from pathlib import Path

import pytest

OPTIONS = {
    "xla_backend_optimization_level": 0,
    "xla_llvm_disable_expensive_passes": True,
    "xla_cpu_parallel_codegen_split_count": 1,  # the other cores have workers of their own
}
"""Compile three to five times faster; what is computed stays the same."""
if importlib.metadata.version("jaxlib").startswith("0.10."):
    OPTIONS["xla_cpu_use_fusion_emitters"] = False  # other versions end the process over a flag that they do not know

FULL = {"xla_backend_optimization_level": 3, "xla_llvm_disable_expensive_passes": False}
"""What programs compile with outside of the tests."""

WORKERS = 4
"""At most: each needs up to 3.5 GB."""

KEPT_BYTES = 2 * 2**30
"""Of a worker, above which it forgets its programs between files; most of them no other file runs."""

IN_WORKER = "PYTEST_XDIST_WORKER" in os.environ
"""Set by pytest-xdist before this file is read, and by it in all that a worker starts."""

THREADS = str(4 * max(os.cpu_count(), 2))
"""Of XLA's CPU backend, for the robots that MJX steps on two devices: see `matd3_jax.thread_pool`."""

for name in ("SIGINT", "SIGHUP"):  # ignored in a shell's background and under nohup, and in what is started from there
    if signal.getsignal(getattr(signal, name)) is signal.SIG_IGN:
        signal.signal(getattr(signal, name), signal.default_int_handler if name == "SIGINT" else signal.SIG_DFL)

if not IN_WORKER:  # workers get all of it from the process that starts them
    os.environ["NPROC"] = THREADS
    flags = [f"--{name}={str(value).lower()}" for name, value in OPTIONS.items()]
    os.environ["XLA_FLAGS"] = " ".join([*flags, os.environ.get("XLA_FLAGS", "")]).strip()
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")  # workers share an accelerator
    # A program would carry where in the code each operation stands: a tenth of the time of compiling it.
    os.environ.setdefault("JAX_TRACEBACK_IN_LOCATIONS_LIMIT", "0")
    os.environ.setdefault("JAX_INCLUDE_FULL_TRACEBACKS_IN_LOCATIONS", "false")
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        os.environ["JAX_COMPILATION_CACHE_DIR"] = tempfile.mkdtemp(prefix="matd3_jax-tests-")
        os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"
        os.environ["JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES"] = "-1"

import jax  # noqa: E402  (reads the environment when it is imported)

gc.set_threshold(50_000)  # tracing makes so many objects that collecting them takes a twentieth of the time

jax.config.update("jax_num_cpu_devices", 2)  # counts only before the first computation, hence here


@pytest.hookimpl(tryfirst=True)  # before the workers are counted
def pytest_cmdline_main(config: pytest.Config) -> None:
    """Share the files out among workers, unless -n says how many or one file only is given."""
    if IN_WORKER:
        return  # or each worker would start its own
    files = {argument.split("::")[0] for argument in config.args}
    one = len(files) == 1 and all(Path(name).is_file() for name in files)
    if getattr(config.option, "numprocesses", 0) is None and not one and not config.option.usepdb:
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
        config.option.numprocesses = min(cores, WORKERS)
        config.option.dist = "loadfile"  # fixtures of a module are made once
        config.option.loadscopereorder = False  # or the files with the fewest tests, long ones, would come last


@pytest.hookimpl(trylast=True)  # when -m has chosen
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the files that take long: in the end no worker waits for one of them."""
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    number = collections.Counter(item.path for item in items)
    items.sort(key=lambda item: (item.path not in slow, -number[item.path]))


def pytest_unconfigure(config: pytest.Config) -> None:
    folder = Path(os.environ["JAX_COMPILATION_CACHE_DIR"])
    if not IN_WORKER and folder.name.startswith("matd3_jax-tests-"):
        shutil.rmtree(folder, ignore_errors=True)


def pytest_collection_finish() -> None:
    """Never look again for garbage among what the imports left."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="module", autouse=True)
def release_programs():
    """Forget what was compiled, once it takes much memory: a worker would end with 6 GB of programs."""
    yield
    if resident_bytes() > KEPT_BYTES:
        jax.clear_caches()
        gc.collect()


def resident_bytes() -> float:
    """Memory of this process, infinite where Linux does not say."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:
        return math.inf


@pytest.fixture(scope="session")
def fully_optimized():
    """`jax.jit` as it compiles outside of the tests."""
    return functools.partial(jax.jit, compiler_options=FULL)
