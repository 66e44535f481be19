"""A metrics table is read without what is not whole, however it was damaged."""

import numpy as np
import pytest

from matd3_jax.runs import metrics_table
from matd3_jax.runs.directory import RunDirectory

ROWS = [
    {"step": np.array([s, s]), "seed": np.array([0, 1]), "q": np.array([s / 3, -1e-7 * s])} for s in (650, 6500, 7000)
]
WHOLE = "".join(metrics_table.row_lines(row, header=k == 0) for k, row in enumerate(ROWS)).encode()
LINES = WHOLE.splitlines(keepends=True)


def steps(data):
    return [int(row[0]) for row in metrics_table.parse(data).rows]


def test_what_is_written_is_read():
    table = metrics_table.parse(WHOLE)
    assert table.header == ["step", "seed", "q"] and table.damaged == 0 and table.text().encode() == WHOLE
    columns = table.columns()
    np.testing.assert_array_equal(columns["step"], [650, 650, 6500, 6500, 7000, 7000])
    np.testing.assert_array_equal(columns["q"].astype(np.float32)[::2], np.float32([650 / 3, 6500 / 3, 7000 / 3]))


@pytest.mark.parametrize("size", range(len(WHOLE)))
def test_cut_off_anywhere(size):
    """After every byte: the whole lines are there, and nothing else ("65" of "6500" is no env step)."""
    table = metrics_table.parse(WHOLE[:size])
    whole = WHOLE[:size].count(b"\n")
    assert len(table.rows) == max(0, whole - 1)
    assert table.text().encode() == b"".join(LINES[:whole])
    assert table.damaged == (WHOLE[:size].rfind(b"\n") + 1 < size)


DAMAGED = {
    "empty": (b"", [], 0),
    "zeros": (b"\0" * 100, [], 1),
    "zeros at the end": (WHOLE + b"\0" * 64, [650, 650, 6500, 6500, 7000, 7000], 1),
    "zeros and a line": (WHOLE + b"\0" * 64 + b"\n", [650, 650, 6500, 6500, 7000, 7000], 1),
    "a blank line": (WHOLE + b"\r\n", [650, 650, 6500, 6500, 7000, 7000], 1),
    "blank lines within": (b"".join([*LINES[:3], b"\n", *LINES[3:]]), [650, 650, 6500, 6500, 7000, 7000], 1),
    "a field too few": (b"".join([*LINES[:2], b"650,1\r\n", *LINES[3:]]), [650, 6500, 6500, 7000, 7000], 1),
    "words": (b"".join([*LINES[:2], b"650,1,x\r\n", *LINES[3:]]), [650, 6500, 6500, 7000, 7000], 1),
    "other bytes": (b"".join([*LINES[:2], b"650,1,\xff\r\n", *LINES[3:]]), [650, 6500, 6500, 7000, 7000], 1),
    "doubled": (b"".join([*LINES, *LINES[3:5]]), [650, 650, 6500, 6500, 7000, 7000], 2),
    "no header": (b"".join(LINES[1:]), [], 6),
    "two rows in one line": (b"".join([*LINES[:4], LINES[4].strip() + LINES[5], LINES[6]]), [650, 650, 6500, 7000], 1),
}


@pytest.mark.parametrize("name", DAMAGED)
def test_damage_is_left_out_and_counted(name):
    data, wanted, damaged = DAMAGED[name]
    assert steps(data) == wanted
    assert metrics_table.parse(data).damaged == damaged


def test_intervals_that_not_all_seeds_have_are_no_columns_and_are_named():
    table = metrics_table.parse(b"".join([*LINES[:3], *LINES[4:6]]))  # 6500 without seed 0, 7000 without seed 1
    np.testing.assert_array_equal(table.columns()["step"], [650, 650])
    assert table.missing([650, 6500, 7000, 7500], 2) == [6500, 7000, 7500]


def test_a_run_directory_cuts_and_goes_on(tmp_path):
    """After a cut the table goes on as if nothing had been there; an emptied one begins anew, header first."""
    run = RunDirectory(tmp_path)
    for row in ROWS:
        run.append(row)
    assert run.metrics.read_bytes() == WHOLE
    run.metrics.write_bytes(WHOLE[:-3])
    assert run.cut(6500).damaged == 1
    assert run.metrics.read_bytes() == b"".join(LINES[:5])
    run.append(ROWS[2])
    assert run.metrics.read_bytes() == WHOLE
    run.metrics.write_bytes(b"")
    assert not run.cut(6500).rows and not run.metrics.exists()
    run.append(ROWS[2])
    assert run.metrics.read_bytes() == LINES[0] + b"".join(LINES[5:])


@pytest.mark.parametrize("text", ["", "{", "[1]", "{}", '{"total_steps": 5'])
def test_a_summary_that_is_not_whole_is_none(tmp_path, text):
    run = RunDirectory(tmp_path)
    assert run.summary() is None
    (tmp_path / "summary.json").write_text(text)
    assert run.summary() is None
    run.write_summary({"total_steps": 5, "x": float("nan")})
    assert run.summary() == {"total_steps": 5, "x": None}
