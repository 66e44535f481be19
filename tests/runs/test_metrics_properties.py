"""Any metrics table, cut anywhere or with any byte changed: what is read was written, or could have been."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from properties import examples

from matd3_jax.runs import metrics_table
from matd3_jax.runs.metrics_table import COUNTS

HEADER = ["step", "seed", "updates", "episodes", "return_agents", "agent_0_critic_loss"]
numbers = st.one_of(st.floats(width=32), st.sampled_from([0.0, -0.0, 1e-7, 1234567.0, -1.5]))


@st.composite
def tables(draw) -> tuple[bytes, list[int]]:
    """A table as a run writes it, and the seeds in it."""
    seeds = np.arange(draw(st.integers(1, 3))) + draw(st.integers(0, 12))
    steps = sorted(draw(st.sets(st.integers(1, 10**6), min_size=1, max_size=5)))
    written = ""
    for step in steps:
        row = {name: np.full(len(seeds), step) for name in HEADER[:4]} | {"seed": seeds}
        row |= {
            name: np.float32(draw(st.lists(numbers, min_size=len(seeds), max_size=len(seeds)))) for name in HEADER[4:]
        }
        written += metrics_table.row_lines(row, header=not written)
    return written.encode(), seeds.tolist()


def rows(data: bytes) -> list[list[str]]:
    return [line.split(",") for line in data.decode().split("\r\n")[1:-1]]


@given(tables(), st.data())
@examples(100)
def test_cut_anywhere_the_rows_before_are_there(table, data):
    written, _ = table
    size = data.draw(st.integers(0, len(written)))
    found = metrics_table.parse(written[:size])
    assert found.rows == rows(written)[: len(found.rows)]
    assert len(found.rows) == max(0, written[:size].count(b"\n") - 1)
    assert found.damaged == (not written[:size].endswith(b"\n") and size > 0)


@given(tables(), st.data())
@examples(200)
def test_a_changed_byte_is_noticed_where_it_can_be(table, data):
    written, seeds = table
    place = data.draw(st.integers(0, len(written) - 1))
    byte = data.draw(st.sampled_from(b"0123456789+-_.eEinfa, \r\n\0\xff"))
    damaged = written[:place] + bytes([byte]) + written[place + 1 :]
    found, true = metrics_table.parse(damaged), rows(written)
    if place <= written.index(b"\n"):  # the names of columns, or the end of their line: all rows, or none
        assert found.rows in (true, [])
        return
    others = [row for row in found.rows if row not in true]
    assert len(others) <= 1 and len(found.rows) + found.damaged >= len(true) - 1
    for row in others:  # another number where one was, as a run could have written it, and where it could be
        # The end of a line in the place of a row's first digit leaves the rest of it as a row.
        line = damaged[damaged.rfind(b"\n", 0, place + 1) + 1 :].split(b"\r\n")[0].decode()
        assert ",".join(row) == line
        before = true[written[:place].count(b"\n") - 1]
        (column,) = (k for k, (new, old) in enumerate(zip(row, before, strict=True)) if new != old)
        if HEADER[column] in COUNTS:
            assert row[column] == str(int(row[column]))
        assert not set(row[column].lower().replace("e+", "")) & set("_ +")
    keys = [(int(row[0]), int(row[1])) for row in found.rows]
    assert all(a < b for a, b in itertools.pairwise(keys))
    assert {int(row[1]) for row in found.of_seeds(seeds).rows} <= set(seeds)
    columns = found.columns()
    if len(true) > 2 * len(seeds):
        assert set(columns["seed"]) <= set(seeds) and len(columns["step"]) >= len(true) - 2 * len(seeds)


anything = st.one_of(
    st.binary(max_size=60), st.lists(st.text('0123456789,.e+-nasteps\r\n"\0', max_size=9)).map("\n".join)
)


@given(anything)
@examples(200)
def test_any_bytes_are_read_and_what_is_left_is_whole(data):
    data = data if isinstance(data, bytes) else f"step,seed\n{data}\n".encode()
    found = metrics_table.parse(data)
    found.columns()
    again = metrics_table.parse(found.text().encode())
    assert (again.header, again.rows, again.damaged) == (found.header, found.rows, 0)


@pytest.mark.parametrize("rows", [[(1, 0), (9, 0), (3, 0)], [(1, 0), (2, 0), (9, 0), (3, 0), (4, 0)]])
def test_where_rows_do_not_ascend_those_that_may_be_wrong_are_left_out(rows):
    """9 before 3: one of the two is wrong; before 3 and 4 it is 9."""
    text = "step,seed\r\n" + "".join(f"{step},{seed}\r\n" for step, seed in rows)
    found = metrics_table.parse(text.encode())
    kept = [(int(step), int(seed)) for step, seed in found.rows]
    assert kept == ([(1, 0)] if len(rows) == 3 else [(1, 0), (2, 0), (3, 0), (4, 0)])
    assert found.damaged == len(rows) - len(kept)
