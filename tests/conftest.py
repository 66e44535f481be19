"""Two CPU devices for the tests of sharding, and quick compiles for programs that run only a few times."""

import functools

import jax
import optax  # noqa: F401  (uses jax.jit when imported: not the quick one, which must not be nested)
import pytest

jax.config.update("jax_num_cpu_devices", 2)  # counts only before the first computation, hence here

OPTIONS = {
    "xla_backend_optimization_level": 0,
    "xla_llvm_disable_expensive_passes": True,
    "xla_cpu_use_fusion_emitters": False,
}
"""Compile three to five times faster; what is computed stays the same."""


@pytest.fixture(scope="session")
def quickly_compiled():
    """`jax.jit` with little optimization, where this XLA knows the options."""
    try:
        jax.jit(lambda x: x + 1, compiler_options=OPTIONS)(0)
    except jax.errors.JaxRuntimeError:  # another backend or version: only slower
        return jax.jit
    return functools.partial(jax.jit, compiler_options=OPTIONS)


@pytest.fixture(scope="module")
def quick_jit(quickly_compiled):
    """`jax.jit` is `quickly_compiled` within the module: not for programs that themselves call `jax.jit`."""
    patch = pytest.MonkeyPatch()
    patch.setattr(jax, "jit", quickly_compiled)
    yield
    patch.undo()
