"""Policies as functions that JAX saved: StableHLO with the parameters in it, for any size of batch."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import export

PLATFORMS = ("cpu", "cuda", "tpu", "rocm")


def write(path: Path, function: Callable, size: int) -> None:
    """Write a function of observations [batch, size]; "batch" stands for any number of rows."""
    (batch,) = export.symbolic_shape("batch")
    wanted = jax.ShapeDtypeStruct((batch, size), jnp.float32)
    path.write_bytes(export.export(jax.jit(function), platforms=PLATFORMS)(wanted).serialize())


def read(path: Path) -> Callable[[np.ndarray], dict[str, Any]]:
    """The function, by JAX alone."""
    return export.deserialize(bytearray(path.read_bytes())).call
