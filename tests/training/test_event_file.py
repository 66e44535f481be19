"""TensorBoard's files: read by other means, and on a disk that fails."""

import os
import sys

import event_records
import numpy as np
import pytest

from matd3_jax.runs.directory import RunDirectory
from matd3_jax.training.event_file import EventFile
from matd3_jax.training.loggers import TensorBoardLogger
from matd3_jax.training.outputs import Harmless


def test_the_checksum_is_castagnolis():
    """By the check value of its catalogs."""
    assert event_records.crc32c(b"123456789") == 0xE3069283


def test_scalars_are_read_as_they_were_written(tmp_path):
    file = EventFile(tmp_path / "tensorboard")
    file.write({"a/seed_0": 1.5, "b/seed_1": float("nan")}, 100)
    file.write({"a/seed_0": -2.0}, 2**40)
    first, second, third = event_records.scalars(file.path)
    assert first == (100, "a/seed_0", 1.5) and second[:2] == (100, "b/seed_1") and np.isnan(second[2])
    assert third == (2**40, "a/seed_0", -2.0)
    assert file.path.name.startswith("events.out.tfevents.")  # what TensorBoard looks for


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="descriptors are looked up in /proc")
@pytest.mark.parametrize("room", [0, 1, 40, 900])
def test_a_full_disk_costs_its_rows_and_nothing_else(tmp_path, monkeypatch, room):
    """One warning, never waiting; what comes when there is room again can be read."""
    runs = [RunDirectory(tmp_path / name) for name in ("full", "other")]
    warnings, real, full = [], os.write, [False]
    logger = Harmless(TensorBoardLogger(runs, [slice(0, 1), slice(1, 2)]), warnings.append)

    def write(file, data):
        if not full[0] or "/other/" in os.readlink(f"/proc/self/fd/{file}"):
            return real(file, data)
        if not room or os.fstat(file).st_size >= room:
            raise OSError(28, "No space left on device")
        return real(file, data[:room])

    monkeypatch.setattr(os, "write", write)
    for step in range(40):
        full[0] = 0 < step < 30 or (room == 0 and step == 0)
        columns = {f"column_{k}": np.array([k + step, np.nan]) for k in range(20)}
        logger.log({"step": np.full(2, step), "seed": np.arange(2), "x": np.array([step, step]), **columns})
    logger.close()
    (warning,) = warnings
    assert warning.startswith("warning: TensorBoardLogger fails, the run goes on: ") and "No space left" in warning
    found = [event_records.scalars(next(run.tensorboard.glob("events*"))) for run in runs]
    assert {step for step, *_ in found[0]} == {*([] if room == 0 else [0]), *range(30, 40)}
    assert [one for one in found[0] if one[0] == 30][-1] == (30, "column_19/seed_0", 49.0)
    assert found[1] == [(step, "x/seed_1", step) for step in range(40)]
