"""Errors that come from outside of the program, from the machine or its packages, as one line each."""

import os
import re
import traceback

import matd3_jax
from matd3_jax.errors import one_line

_IN_A_MESSAGE = re.compile(r"os_error_code='(\d+)'")
_ON_HOST = re.compile(r"\bHostError: (.*)")
"""How JAX passes on what an environment on the host raised while a compiled program ran."""
_FILE = re.compile(r'Failed \w+: "([^"]+)"')
"""How tensorstore, which writes checkpoints, passes an error of the system on, and which file it names."""


def describe(error: BaseException) -> str | None:
    """What happened, and what to do about it; None for what can only be a fault of the program."""
    on_host = _ON_HOST.search(str(error))
    if on_host:
        return on_host[1]
    text = one_line(error)
    if isinstance(error, OSError):
        return _of_the_system(error, text)
    if isinstance(error, MemoryError) or "RESOURCE_EXHAUSTED" in text:
        return f"out of memory{f' ({text})' if text else ''}: take fewer seeds, or smaller networks, replay or batches"
    if isinstance(error, ImportError):
        return _of_a_package(error, text)
    found = _IN_A_MESSAGE.search(text)
    if found:
        file = _FILE.search(text)
        return f"{file[1] if file else text}: {os.strerror(int(found[1]))}"
    if _in_the_start_of_jax(error):
        platforms = os.environ.get("JAX_PLATFORMS", "")
        why = f": {text}" if text else ""
        hint = "unset JAX_PLATFORMS, or set it to what this machine has (cpu)" if platforms else "see JAX_PLATFORMS"
        return f"JAX cannot start {f'JAX_PLATFORMS={platforms}' if platforms else 'its platform'}{why}; {hint}"
    return None


def _of_the_system(error: OSError, text: str) -> str:
    names = [str(name) for name in (error.filename, error.filename2) if name is not None]
    reason = error.strerror or text or type(error).__name__
    return f"{' -> '.join(names)}: {reason}" if names else reason


def _of_a_package(error: ImportError, text: str) -> str | None:
    name = (error.name or "").split(".")[0]
    if name == matd3_jax.__name__:
        return None
    if isinstance(error, ModuleNotFoundError) and error.name == name:
        return f"the package {name} is missing: install matd3_jax with its dependencies (pip install -e .)"
    return f"a package does not fit the others: {text}; install the versions that matd3_jax asks for (pip install -e .)"


def _in_the_start_of_jax(error: BaseException) -> bool:
    """Whether JAX raised it when it looked for its devices: of a back end without any, a bare AssertionError."""
    frames = traceback.extract_tb(error.__traceback__)
    return bool(frames) and frames[-1].filename.replace("\\", "/").endswith("jax/_src/xla_bridge.py")
