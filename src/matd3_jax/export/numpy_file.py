"""Policies as one .npz, with a reader beside it that needs NumPy alone."""

import importlib.util
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from matd3_jax.envs.spaces import Box, Discrete, Simplex
from matd3_jax.export.policy import Perceptron

FILE, READER = "policies.npz", "read_policies.py"


def network(policy: Perceptron) -> dict[str, Any]:
    """What the reader has to know of a policy besides its arrays."""
    space = policy.space
    bound = float(np.finfo(np.float32).max) if policy.mean is None else policy.bound
    found: dict[str, Any] = {"layers": len(policy.kernels), "bounds": [-bound, bound], "cuts": []}
    if isinstance(space, Box):
        half = (space.high - space.low) / 2
        return {**found, "head": "tanh", "slope": policy.slope, "center": space.low + half, "half": half}
    head = "soft" if isinstance(space, Simplex) else "choice" if isinstance(space, Discrete) else "choices"
    return {**found, "head": head, "cuts": np.cumsum(space.sizes)[:-1].tolist()}


def arrays(policy: Perceptron) -> dict[str, np.ndarray]:
    """Of one policy, by name; what is not normalized has mean 0 and deviation 1."""
    size = policy.kernels[0].shape[0]
    found = {
        "mean": np.zeros(size, np.float32) if policy.mean is None else policy.mean,
        "deviation": np.ones(size, np.float32) if policy.deviation is None else policy.deviation,
    }
    for layer, (kernel, bias) in enumerate(zip(policy.kernels, policy.biases, strict=True)):
        found |= {f"kernel_{layer}": kernel, f"bias_{layer}": bias}
    return found


def write(folder: Path, policies: Sequence[Perceptron], facts: Mapping[str, Any]) -> dict[str, str]:
    """Write all policies and the reader: the files by agent.

    Args:
        facts: of all that is exported; its "agents" are in the order of the policies.
    """
    each = list(map(arrays, policies))
    agents = [
        {**agent, "arrays": list(own), "network": network(policy)}
        for agent, own, policy in zip(facts["agents"], each, policies, strict=True)
    ]
    flat = {f"{i}/{name}": value for i, own in enumerate(each) for name, value in own.items()}
    text = np.array(json.dumps({**facts, "agents": agents}))
    np.savez(folder / FILE, facts=text, **flat)  # type: ignore[arg-type]
    (folder / READER).write_bytes((Path(__file__).parent / "numpy_reader.py").read_bytes())
    return {agent["name"]: FILE for agent in facts["agents"]}


def read(folder: Path) -> Any:
    """The policies by agent, by the reader that lies beside them."""
    spec = importlib.util.spec_from_file_location("read_policies", folder / READER)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.load(folder / FILE)
