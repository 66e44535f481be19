"""Comparisons to the bit: what runs' last checkpoints and metrics tables hold, and what resumed copies come to."""

import shutil
from pathlib import Path

import numpy as np
import orbax.checkpoint as ocp

from matd3_jax.training import checkpoint
from matd3_jax.training.recording import Recorder


def state_leaves(path: Path) -> dict[str, np.ndarray]:
    """Every array but the replays of the last checkpoint of a run directory."""
    with ocp.StandardCheckpointer() as reader:
        found = reader.restore(checkpoint.verify(path / "checkpoints") / "state")
    return {name: np.asarray(leaf) for name, leaf in found.items()}


def leaves(path: Path) -> dict[str, np.ndarray]:
    """Every array of the last checkpoint of a run directory, replays included (those of a sweep's runs have none)."""
    found = state_leaves(path)
    with ocp.StandardCheckpointer() as reader:
        for seed in sorted(checkpoint.verify(path / "checkpoints").glob("replay/*")):
            found[f"replay {seed.name}"] = np.asarray(reader.restore(seed)["rows"])
    return found


def assert_same_arrays(found: dict[str, np.ndarray], wanted: dict[str, np.ndarray]) -> None:
    """The same names, and the same numbers under each."""
    assert found.keys() == wanted.keys()
    for name, value in wanted.items():
        np.testing.assert_array_equal(found[name], value, err_msg=name)


def assert_same_run(path: Path, whole: Path) -> None:
    """The same metrics table, and the same arrays in the last checkpoint, replays included."""
    assert (path / "metrics.csv").read_bytes() == (whole / "metrics.csv").read_bytes()
    assert_same_arrays(leaves(path), leaves(whole))


def back_to(path: Path, step: int) -> None:
    """Leave a run as a kill after its checkpoint of env step `step` does."""
    found = checkpoint.steps(path / "checkpoints")
    assert step in found[:-1]
    for later in found:
        if later > step:
            shutil.rmtree(path / "checkpoints" / str(later))
    for name in ("summary.json", "learning_curve.png"):
        (path / name).unlink(missing_ok=True)


def assert_resumes_to_the_bit(whole: Path, copy: Path) -> None:
    """A copy of a finished run, resumed from a checkpoint on the way, comes to the same table and the same arrays."""
    _, *_, before, _ = checkpoint.steps(whole / "checkpoints")  # the first is that of the warm-up: nothing is learned
    shutil.copytree(whole, copy)
    back_to(copy, before)
    Recorder().resume(copy)
    assert_same_run(copy, whole)
