"""A metrics table is read without what is not whole, however it was damaged."""

import numpy as np
import pytest

from matd3_jax.runs import metrics_table
from matd3_jax.runs.directory import RunDirectory
from matd3_jax.runs.missing import Expected

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
    assert table.gaps(650, 7000, 500, seeds=2) == [(650, 7000)]


def test_gaps_are_named_and_other_intervals_are_none():
    """Rows every 100 env steps, then, after the run was lengthened, every 150."""
    steps = [50, 150, 250, 350, 500, 650, 800]

    def gaps(steps, last=800):
        rows = [[str(step), str(seed), "1"] for step in steps for seed in (0, 1)]
        return metrics_table.MetricsTable(["step", "seed", "q"], rows, 0).gaps(50, last, 150, 2)

    assert gaps(steps) == []
    assert gaps([step for step in steps if step != 150]) == [(50, 250)]
    assert gaps([step for step in steps if step not in (50, 500, 800)]) == [(0, 150), (350, 650), (650, 800)]
    assert gaps([]) == [(0, 800)]


def test_a_run_directory_cuts_and_appends(tmp_path):
    """After a cut the table continues as if nothing had been there; an emptied one begins with the header."""
    run = RunDirectory(tmp_path)
    for row in ROWS:
        run.append(row)
    assert run.metrics.read_bytes() == WHOLE
    run.metrics.write_bytes(WHOLE[:-3])
    expected = Expected(["step", "seed", "q"], range(2), first=650, interval=5850)
    (lost,) = run.cut(6500, expected)
    assert lost == f"{run.metrics}: 1 damaged line, left out"
    assert run.metrics.read_bytes() == b"".join(LINES[:5])
    run.append(ROWS[2])
    assert run.metrics.read_bytes() == WHOLE
    run.metrics.write_bytes(b"")
    (lost,) = run.cut(6500, expected)
    assert "lacks rows between env steps 0 and 6,500" in lost and not run.metrics.exists()
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


def test_columns_of_other_names_are_named_and_the_rows_to_come_fit(tmp_path):
    """A header one of whose letters was changed, or of a version with fewer columns."""
    run = RunDirectory(tmp_path)
    for row in ROWS[:2]:
        run.append(row)
    run.metrics.write_bytes(run.metrics.read_bytes().replace(b"q", b"p", 1))
    lost = run.cut(6500, Expected(["step", "seed", "q"], range(2), first=650, interval=5850))
    assert lost == [f"{run.metrics}: no column q: nan in the rows so far"]
    run.append(ROWS[2])
    columns = run.read_metrics()
    assert list(columns) == ["step", "seed", "q"] and np.isnan(columns["q"][:4]).all()
    np.testing.assert_array_equal(columns["q"][4:].astype(np.float32), ROWS[2]["q"].astype(np.float32))


def test_rows_of_seeds_that_a_run_does_not_have_are_damaged(tmp_path):
    run = RunDirectory(tmp_path)
    for row in ROWS[:2]:
        run.append(row)
    run.metrics.write_bytes(run.metrics.read_bytes().replace(b"650,1,", b"650,7,"))
    lost = run.cut(6500, Expected(["step", "seed", "q"], range(2), first=650, interval=5850))
    assert lost[0].endswith(": 1 damaged line, left out") and "between env steps 0 and 6,500" in lost[1]
    assert set(run.read_metrics()["seed"]) == {0, 1}
