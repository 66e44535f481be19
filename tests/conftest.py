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


@pytest.fixture(scope="module")
def quick_jit():
    """`jax.jit` compiles with little optimisation within the module, where this XLA knows the options."""
    patch, jit = pytest.MonkeyPatch(), jax.jit
    try:
        jit(lambda x: x + 1, compiler_options=OPTIONS)(0)
    except jax.errors.JaxRuntimeError:  # another backend or version: only slower
        yield
        return
    patch.setattr(jax, "jit", functools.partial(jit, compiler_options=OPTIONS))
    yield
    patch.undo()
