"""Set the machine up before JAX starts, and say what it is."""

import contextlib
import importlib.metadata
import os
import platform
from collections.abc import Iterator
from pathlib import Path

import jax
import jaxlib
import psutil

PACKAGES = (
    *("matd3_jax", "jax", "jaxlib", "flax", "optax", "chex", "orbax-checkpoint", "numpy"),
    *("mujoco", "mujoco-mjx", "gymnasium", "brax"),
)


def prepare() -> None:
    """One CPU device per core (seeds are sharded over them) and a compilation cache that outlives the process.

    Leaves alone what the user has set: `JAX_NUM_CPU_DEVICES`, `JAX_COMPILATION_CACHE_DIR`. Too late, and without
    effect, once JAX has computed something: a library user's own devices stand.
    """
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ and getattr(jax.config, "jax_compilation_cache_dir", None) is None:
        cache = cache_folder()
        if cache is not None:
            jax.config.update("jax_compilation_cache_dir", str(cache))
    flags = os.environ.get("XLA_FLAGS", "")
    if jaxlib.__version__.startswith(("0.10.", "0.11.")) and "ynn_fusion_type" not in flags:
        # Whole networks fused into one library call run at half the speed of single products in 0.10, at nine tenths in
        # 0.11. Other versions may not know the flag, and end the process over it.
        os.environ["XLA_FLAGS"] = f"{flags} --xla_cpu_experimental_ynn_fusion_type=LIBRARY_FUSION_TYPE_INDIVIDUAL_DOT"
    if jaxlib.__version__.startswith("0.11.") and "JAX_USE_SHARDY_PARTITIONER" not in os.environ:
        # Shardy's ManualComputationUnusedInputsPattern of 0.11.2 ends the process (a segmentation fault) at robots that
        # MJX steps on several devices; the older partitioner compiles them.
        jax.config.update("jax_use_shardy_partitioner", False)
    if "JAX_NUM_CPU_DEVICES" in os.environ or "xla_force_host_platform_device_count" in os.environ.get("XLA_FLAGS", ""):
        return
    try:
        jax.config.update("jax_num_cpu_devices", cores())
    except RuntimeError:
        pass


def cache_folder() -> Path | None:
    """Where compiled programs are kept; None where the user's cache cannot be written to, or there is no home."""
    try:
        folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "matd3_jax"
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, RuntimeError):  # the latter of a user without a home
        return None
    return folder if folder.is_absolute() and os.access(folder, os.W_OK | os.X_OK) else None


@contextlib.contextmanager
def standard_numerics() -> Iterator[None]:
    """Compute in float32 and int32 within, and by NumPy's rules of promotion, whatever JAX_ENABLE_X64,
    JAX_NUMPY_DTYPE_PROMOTION and JAX_NUMPY_RANK_PROMOTION say: the numbers are the same."""
    with jax.enable_x64(False), jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        yield


def accelerated() -> bool:
    """Whether JAX computes on something else than CPUs."""
    return jax.default_backend() != "cpu"


def versions() -> dict[str, str]:
    """Versions of what the numbers depend on."""
    found = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = "not installed"
    return found


def description() -> dict[str, object]:
    """The machine and JAX's devices."""
    devices = jax.devices()
    return {
        "devices": [f"{d.platform}:{d.id} {d.device_kind}" for d in devices],
        "processor": processor(),
        "cores": cores(),
        "memory_gib": round(psutil.virtual_memory().total / 2**30, 1),
        "system": platform.platform(),
    }


def cores() -> int:
    """How many threads of this process can run at a time."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def processor() -> str:
    """The CPU's model name."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        return next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def free_memory(sharing: int = 1) -> int:
    """Bytes that arrays may take up on this process's devices together: the accelerators' limits, or its part of what
    the machine (and the control group, in a container) has free.

    Args:
        sharing: processes that share the machine's memory; accelerators are not shared.
    """
    devices = jax.local_devices()
    if devices[0].platform != "cpu":
        stats = [d.memory_stats() or {} for d in devices]
        limits = [s["bytes_limit"] - s.get("bytes_in_use", 0) for s in stats if "bytes_limit" in s]
        if limits:
            return sum(limits)
    free = psutil.virtual_memory().available // sharing
    group = Path("/sys/fs/cgroup")
    try:
        limit = int((group / "memory.max").read_text(encoding="utf-8"))
        return min(free, (limit - int((group / "memory.current").read_text(encoding="utf-8"))) // sharing)
    except (OSError, ValueError):
        return free
