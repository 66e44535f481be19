"""Trained policies as files for other programs: ONNX, NumPy, JAX's own export."""

from matd3_jax.export.write import FORMATS, export

__all__ = ["FORMATS", "export"]
