"""The threads of XLA's CPU backend, of which a program that calls LAPACK needs more than there are cores."""

import os
import re
import warnings
from typing import Any

import jax

from matd3_jax.runtime.devices import cores

THREADS = 4
"""For each core or CPU device, whichever are more: one for each LAPACK call that may be under way, and some free ones.

A device may have several. Programs that call nothing pay for more threads than cores: their matrix products are split
into as many parts as there are threads, and with 16 on two cores simple_spread trains at 0.6 of its speed."""

LAPACK = frozenset(
    {
        *("cholesky", "eig", "eigh", "geqp3", "geqrf", "hessenberg", "householder_product", "lu", "ormqr", "qr"),
        *("schur", "svd", "triangular_solve", "tridiagonal"),
    }
)
"""JAX's operations that are LAPACK's on a CPU."""


def calls_lapack(jaxpr: Any) -> bool:
    """Whether a traced program has one of the `LAPACK` operations, however deep inside."""
    return any(
        equation.primitive.name in LAPACK
        or any(calls_lapack(part) for value in equation.params.values() for part in programs_in(value))
        for equation in jaxpr.eqns
    )


def programs_in(value: Any) -> list[Any]:
    """Programs within a parameter of a traced operation: a loop's body, a condition's branches."""
    values = value if isinstance(value, list | tuple) else [value]
    return [getattr(v, "jaxpr", v) for v in values if hasattr(getattr(v, "jaxpr", v), "eqns")]


def make_room_for_lapack(what: str) -> None:
    """Give XLA's CPU backend `THREADS` threads for each core, before JAX computes anything.

    jaxlib's batched LAPACK calls (Cholesky factorizations and the like) run on a thread of the backend's pool, share
    their work out to that pool and wait for it: with as many calls under way as threads, all of them wait forever
    (seen with jaxlib 0.10.2: a rollout of Playground's CheetahRun on two cores). The number is `NPROC`, the only
    variable that XLA reads it from; larger ones are left alone.

    Args:
        what: calls LAPACK; for the RuntimeWarning that it is too late, as JAX computes on CPUs already.
    """
    devices = max(1, _devices(), _forced_devices())
    needed = THREADS * max(cores(), devices)
    if _given() >= needed:
        return
    if not _started():
        os.environ["NPROC"] = str(needed)
    elif jax.default_backend() == "cpu":
        warnings.warn(
            f"{what} calls LAPACK, and on CPUs jaxlib can wait for a free thread forever; set NPROC={needed} in the "
            "process's environment before JAX computes anything",
            RuntimeWarning,
            stacklevel=2,
        )


def _given() -> int:
    text = os.environ.get("NPROC", "")
    return int(text) if text.isdecimal() else 0


def _devices() -> int:
    """CPU devices asked for; -1 where nobody has."""
    return getattr(jax.config, "jax_num_cpu_devices", -1)


def _forced_devices() -> int:
    found = re.findall(r"xla_force_host_platform_device_count=(\d+)", os.environ.get("XLA_FLAGS", ""))
    return int(found[-1]) if found else 0


def _started() -> bool:
    """Whether JAX's backends exist: their number of CPU devices is fixed then."""
    number = _devices()
    try:
        jax.config.update("jax_num_cpu_devices", number + 1)
    except RuntimeError:
        return True
    jax.config.update("jax_num_cpu_devices", number)
    return False
