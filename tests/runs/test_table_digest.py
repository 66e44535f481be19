"""Digests of metrics tables in checkpoints."""

import hashlib
import json

from matd3_jax.runs import table_digest


def test_the_beginning_is_compared_and_what_comes_later_is_not(tmp_path):
    tables = [tmp_path / "one.csv", tmp_path / "two.csv", tmp_path / "none.csv"]
    tables[0].write_bytes(b"step,seed\r\n100,0\r\n")
    tables[1].write_bytes(b"step,seed\r\n100,1\r\n")
    file = table_digest.write(tmp_path, tables)
    assert json.loads(file.read_text())[1] == {
        "bytes": 18,
        "sha256": hashlib.sha256(tables[1].read_bytes()).hexdigest(),
    }
    with tables[1].open("ab") as more:
        more.write(b"200,1\r\n")
    assert [table_digest.is_changed(tmp_path, table, k) for k, table in enumerate(tables)] == [False] * 3
    tables[1].write_bytes(tables[1].read_bytes().replace(b"100", b"101"))
    assert [table_digest.is_changed(tmp_path, table, k) for k, table in enumerate(tables)] == [False, True, False]
    tables[0].write_bytes(tables[0].read_bytes()[:-1])
    assert table_digest.is_changed(tmp_path, tables[0], 0)
    tables[0].unlink()
    assert table_digest.is_changed(tmp_path, tables[0], 0)


def test_checkpoints_from_before_say_nothing(tmp_path):
    table = tmp_path / "metrics.csv"
    assert not table_digest.is_changed(tmp_path, table)
    table.write_text("step,seed\n")
    for text in ("", "[]", "{}", '[{"bytes": "x"}]', "[1]"):
        (tmp_path / table_digest.FILE).write_text(text)
        assert not table_digest.is_changed(tmp_path, table), text
