"""What a run's last checkpoint holds, for comparisons to the bit."""

from pathlib import Path

import numpy as np
import orbax.checkpoint as ocp

from matd3_jax.training import checkpoint


def leaves(path: Path) -> dict[str, np.ndarray]:
    """Every array of the last checkpoint of a run directory, replays included."""
    folder = checkpoint.verify(path / "checkpoints")
    with ocp.StandardCheckpointer() as reader:
        found = dict(reader.restore(folder / "state"))
        for seed in sorted((folder / "replay").iterdir()):
            found[f"replay {seed.name}"] = reader.restore(seed)["rows"]
    return {name: np.asarray(leaf) for name, leaf in found.items()}
