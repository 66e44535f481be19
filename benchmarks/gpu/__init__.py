"""What a machine with an accelerator should run first: checks, then every measurement (see `__main__`)."""

import os

# JAX takes three quarters of a GPU's memory at its start; here replays are to fill it, so nine tenths. The rest is for
# what lies outside of JAX's pool: the CUDA context, kernels and their graphs, workspaces of cuBLAS, buffers of the
# profiler. It counts only before JAX first computes, hence here, before any module of JAX is imported.
os.environ.setdefault("XLA_PYTHON_CLIENT_MEM_FRACTION", "0.9")
