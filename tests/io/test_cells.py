"""The cells of tables: what a stranger's file may cost, and what a spreadsheet finds in ours."""

import gzip
import os
import re
import tracemalloc
from io import BytesIO
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from radiotwin.errors import BadInput
from radiotwin.io.cells import (
    CsvLayout,
    as_numbers,
    read_cells,
    read_table,
    write_csv,
)

ROOT = Path(__file__).parents[2]
MIB = 2**20


@pytest.fixture
def write(tmp_path):
    def write(data: bytes, name: str = "t.csv") -> Path:
        (tmp_path / name).write_bytes(data)
        return tmp_path / name
    return write


@pytest.mark.parametrize(("text", "cells"), [
    ("a,b\n1,2\n", [["1", "2"]]),
    ("a,b\r\n1, 2\r\n\r\n3,4", [["1", "2"], ["3", "4"]]),
    ("a,b\r1,2\r3,4\r", [["1", "2"], ["3", "4"]]),
    ("a,b\n1,2\r\n3,4\n", [["1", "2"], ["3", "4"]]),
    ('a,b\n"1,5",2\n', [["1,5", "2"]]),
    ('a,b\n"1\n5",2\n', [["1\n5", "2"]]),
    ('a,b\n5" pipe,2\n', [['5" pipe', "2"]]),
    ('"a","b"\n1,"x ""y"""\n', [["1", 'x "y"']]),
    ("\n\na,b\n1,\n", [["1", ""]]),
    ("\ufeffa,b\n1,2\n", [["1", "2"]]),
    ("a,b\n", []),
    ("a,b", []),
])
def test_cells_are_read_as_they_are(write, text, cells):
    table = read_cells(write(text.encode()))
    assert list(table.columns) == ["a", "b"] and table.to_numpy().tolist() == cells
    packed = read_cells(write(gzip.compress(text.encode()), "t.csv.gz"))
    assert packed.to_numpy().tolist() == cells


def test_endings_count_in_any_case(write):
    table = pd.DataFrame({"a": ["x"], "b": ["1"]})
    assert read_cells(write(b"a,b\nx,1\n", "T.CSV")).equals(table)
    assert read_cells(write(gzip.compress(b"a,b\nx,1\n"), "T.Csv.GZ")).equals(table)
    packed = write(b"", "U.CSV.GZ")
    write_csv(table, packed)
    assert gzip.decompress(packed.read_bytes()) == b"a,b\nx,1\n" and read_cells(packed).equals(table)
    columns = write(b"", "T.PARQUET")
    pytest.importorskip("pyarrow")
    table.to_parquet(columns)
    assert read_cells(columns).astype(str).to_numpy().tolist() == [["x", "1"]]


@pytest.mark.parametrize(("data", "message"), [
    (b"a,b\n1,\x002\n", "null characters"), ("a,b\n1,2\n".encode("utf-16-le"), "null characters"),
    (b'a,b\n1,"2\n3,4\n', "cannot be read|fields"), (b"a,b\n1," + b'"' + b"x,\n" * 200_000, "not closed"),
    (b"a,b\n1,\xff\n", "UTF-8"), (b"a,a\n", "'a' occurs twice"), (b"\n\n", "is empty"),
    (b"a,b\n" + b"," * 1_000_000, "row 2 has 1000001 fields"),
])
def test_texts_that_are_no_tables(write, data, message):
    with pytest.raises(BadInput, match=message) as error:
        read_cells(write(data))
    assert len(str(error.value)) < 1000


def peak_mib(work) -> float:
    tracemalloc.start()
    try:
        with pytest.raises(BadInput, match="RADIOTWIN_MAX_"):
            work()
        return tracemalloc.get_traced_memory()[1] / MIB
    finally:
        tracemalloc.stop()


def test_a_bomb_of_gzip_is_refused_before_it_is_memory(write, monkeypatch):
    monkeypatch.setenv("RADIOTWIN_MAX_FILE_BYTES", str(8 * MIB))
    path = write(gzip.compress(b"a,b\n" + b"1,2\n" * (4 * MIB)), "t.csv.gz")
    assert peak_mib(lambda: read_cells(path)) < 15


@pytest.mark.parametrize(("variable", "limit", "data"), [
    ("ROWS", 10, b"a,b\n" + b"1,2\n" * 11), ("ROWS", 10, b"a,b\n" + b'"1",2\n' * 11),
    ("COLUMNS", 10, b",".join(b"c%d" % i for i in range(100_000)) + b"\n"),
    ("COLUMNS", 10, b'"a",' + b",".join(b"c%d" % i for i in range(10_000)) + b"\n"),
    ("CELLS", 10, b"a,b\n" + b"1,2\n" * 6)])
def test_limits_of_csv_name_their_variable(write, monkeypatch, variable, limit, data):
    monkeypatch.setenv(f"RADIOTWIN_MAX_{variable}", str(limit))
    with pytest.raises(BadInput, match=f"at most 10 are read; .*RADIOTWIN_MAX_{variable}"):
        read_cells(write(data))


def test_parquet_is_judged_by_its_metadata(tmp_path, monkeypatch):
    pytest.importorskip("pyarrow")
    path = tmp_path / "t.parquet"
    pd.DataFrame({"a": np.zeros(100_000), "b": "x"}).to_parquet(path)
    monkeypatch.setattr("pyarrow.parquet.ParquetFile.iter_batches", lambda *_, **__: pytest.fail("was read"))
    for variable, limit in (("ROWS", 99_999), ("COLUMNS", 1), ("CELLS", 199_999), ("FILE_BYTES", 999),
                            ("TABLE_BYTES", 1_599_999)):
        monkeypatch.setenv(f"RADIOTWIN_MAX_{variable}", str(limit))
        assert peak_mib(lambda: read_cells(path)) < 5
        monkeypatch.delenv(f"RADIOTWIN_MAX_{variable}")


def test_a_dictionary_that_stands_for_gigabytes(tmp_path, monkeypatch):
    pyarrow = pytest.importorskip("pyarrow")
    path = tmp_path / "t.parquet"
    parquet = pytest.importorskip("pyarrow.parquet")
    texts = pyarrow.DictionaryArray.from_arrays(np.zeros(4000, dtype=np.int32), ["x" * (MIB // 4)])
    parquet.write_table(pyarrow.table({"a": texts, "b": np.ones(4000)}), path, store_schema=False)
    assert path.stat().st_size < MIB
    monkeypatch.setenv("RADIOTWIN_MAX_TABLE_BYTES", str(900 * MIB))
    before = pyarrow.default_memory_pool().max_memory()
    with pytest.raises(BadInput, match="bytes in memory; at most .*RADIOTWIN_MAX_TABLE_BYTES"):
        read_cells(path)
    assert pyarrow.default_memory_pool().max_memory() - before < 100 * MIB
    assert len(read_cells(path, ["b"], [])) == 4000


def test_parquet_keeps_its_types(tmp_path):
    pytest.importorskip("pyarrow")
    frame = pd.DataFrame({"text": ["a", None, "ü"], "number": [1.5, np.nan, 3], "whole": [1, 2, 3],
                          "kind": pd.Categorical(["x", "y", "x"]), "yes": [True, False, True],
                          "time": pd.to_datetime([0, 1, 2], unit="s", utc=True), "many": [[1], [], None]})
    frame.to_parquet(tmp_path / "t.parquet")
    from pyarrow.parquet import read_table
    expected = read_table(tmp_path / "t.parquet").to_pandas(ignore_metadata=True).astype({"kind": "str"})
    pd.testing.assert_frame_equal(read_cells(tmp_path / "t.parquet"), expected)
    expected.iloc[:0].to_parquet(tmp_path / "none.parquet")
    assert list(read_cells(tmp_path / "none.parquet").columns) == list(frame.columns)


@pytest.mark.parametrize("kind", ["string", "large_string", "string_view", "binary", "large_binary", "binary_view", "dictionary"])
def test_texts_of_parquet_are_utf_8(tmp_path, kind):
    """Bytes are a text if they can be one; a file may also call texts what is none."""
    pyarrow = pytest.importorskip("pyarrow")
    from pyarrow.parquet import write_table

    def column(*cells):
        data = pyarrow.array(cells, pyarrow.binary())
        if kind == "dictionary":
            return pyarrow.DictionaryArray.from_arrays([0, 1, None], data[:2])
        if "string" not in kind:
            return data.cast(getattr(pyarrow, kind)())
        texts = pyarrow.StringArray.from_buffers(3, *data.buffers()[1:], data.buffers()[0], data.null_count)
        return texts if kind == "string" else texts.cast(getattr(pyarrow, kind)())

    path = tmp_path / "t.parquet"
    write_table(pyarrow.table({"a": column("ü".encode(), b"b", None)}), path)
    assert [None if pd.isna(cell) else cell for cell in read_cells(path)["a"]] == ["ü", "b", None]
    write_table(pyarrow.table({"a": column(b"a", b"\xffb", None)}), path)
    with pytest.raises(BadInput, match=r"t.parquet: row 3, column a: b'\\xffb' is not text in UTF-8"):
        read_cells(path, ["a"], [])
    if kind in ("binary", "large_binary", "binary_view"):  # UUIDs, say
        write_table(pyarrow.table({"a": column(b"\1\xff", b"\2\xfe", None)}), path)
        assert list(read_cells(path)["a"])[:2] == ["01ff", "02fe"]
    if kind == "binary":
        assert list(read_cells(path, ["a"], binary=["a"])["a"]) == [b"\1\xff", b"\2\xfe", None]


def test_only_the_columns_that_are_asked_for(write):
    path = write(b"c,a,b,d\n1,2,3,4\n")
    assert list(read_cells(path, ["a"], ["c", "z"]).columns) == ["c", "a"]
    with pytest.raises(BadInput, match=r"column 'z' is missing; it needs z, it has c, a, b, d"):
        read_cells(path, ["z"])


@pytest.mark.parametrize("name", ["http://127.0.0.1:9/t.csv", "s3://bucket/t.parquet", "file:///etc/passwd.csv",
                                  "x" * 300 + ".csv", "a/" * 2000 + "t.csv", "nul\0.csv", "ftp://h/t.csv.gz"])
def test_a_name_is_a_path_and_nothing_else(name):
    with pytest.raises(BadInput, match="does not exist|cannot be read"):
        read_cells(Path(name))


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="the system has no pipes")
@pytest.mark.parametrize("name", ["t.csv", "t.csv.gz", "t.parquet"])
def test_pipes_folders_and_devices_are_refused(tmp_path, name):
    os.mkfifo(tmp_path / name)
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / name).symlink_to("/dev/zero")
    for path in (tmp_path / name, tmp_path / "folder" / name):
        with pytest.raises(BadInput, match="not a regular file"):
            read_cells(path)


FORMULAS = ["=1+1", "+cmd|' /C calc'!A0", "-2+3", "@SUM(A1)", "'=x", "''=x", "'", "'plain", "\uff1d1", "plain", "a=1", "-",
            "-80.5", "+3", "-1e5", "-.5", "1.2.3", "-inf", "", "'-5", "\u00fc", "-1,5"]


@pytest.mark.parametrize("name", ["t.csv", "t.csv.gz"])
def test_texts_survive_writing_and_reading(tmp_path, name):
    table = pd.DataFrame({"=name": FORMULAS, "n": np.arange(len(FORMULAS)) - 3.5})
    write_csv(table, tmp_path / name)
    back = read_cells(tmp_path / name)
    assert list(back.columns) == ["=name", "n"] and list(back["=name"]) == FORMULAS
    raw = pd.read_csv(tmp_path / name, keep_default_na=False, dtype={"'=name": str})
    assert list(raw.columns) == ["'=name", "n"]
    risky = [cell for cell in raw["'=name"] if cell.startswith(tuple("=+-@\uff1d"))]
    assert sorted(risky) == ["+3", "-.5", "-1e5", "-80.5"]


def test_honest_tables_are_written_as_pandas_does(tmp_path):
    table = pd.DataFrame({"a": ["x", None, "y, z"], "b": [1.23456789, np.nan, -1e300], "c": [1, -2, 3],
                          "d": [True, False, None], "e": pd.Categorical(["k", "l", "k"])})
    for options in ({}, {"float_format": "%.4f"}):
        write_csv(table, tmp_path / "t.csv", **options)
        assert (tmp_path / "t.csv").read_text() == table.to_csv(index=False, **options)
        write_csv(table, tmp_path / "t.csv.gz", **options)
        assert gzip.decompress((tmp_path / "t.csv.gz").read_bytes()) == (tmp_path / "t.csv").read_bytes()
    again = tmp_path / "other name.csv.gz"
    write_csv(table, again, **options)
    assert again.read_bytes() == (tmp_path / "t.csv.gz").read_bytes(), "neither name nor time are in it"
    assert list(table["a"].fillna("")) == ["x", "", "y, z"], "the table itself is not changed"


def test_every_table_is_written_by_one_function():
    calls = {str(path.relative_to(ROOT)) for folder in ("radiotwin", "marl", "studies")
             for path in (ROOT / folder).rglob("*.py")
             if re.search(r"\.to_csv\(|\.savetxt\(|csv\.(Dict)?[wW]riter\(", path.read_text(encoding="utf-8"))}
    assert calls == {"radiotwin/io/cells.py", "studies/guard.py", "radiotwin/importing/read_source.py"}  # a sheet as text


def test_numbers_of_thousands_of_digits():
    text = pd.Series(["1" * 5000, "2", "-" + "9" * 400, "x", "", "9" * 25, "1e999"])
    numbers = as_numbers(text)
    assert numbers[1] == 2 and np.isnan(numbers[[0, 3, 4]]).all() and numbers[5] == 1e25
    assert not np.isfinite(numbers[[2, 6]]).any()


def layout(data: bytes) -> CsvLayout:
    layout = CsvLayout(Path("t.csv"))
    layout.check(BytesIO(data))
    return layout


@pytest.mark.parametrize("first", [b"", b'"1,",2\n'])
def test_rows_are_counted_the_same_over_blocks_and_with_quotation_marks(monkeypatch, first):
    monkeypatch.setattr("radiotwin.io.cells._BLOCK_BYTES", 64)
    rows = [f"{i},{'x' * (i % 90)}".encode() for i in range(300)]
    found = layout(b"a,b\n" + first + b"\n".join(rows))
    assert found.header == ["a", "b"] and found.rows == 301 + bool(first)
    assert not found.has_apostrophes and layout(b"a,b\n" + b"\n".join([*rows, b"1,'"])).has_apostrophes
    rows[250] += b",1"
    with pytest.raises(BadInput, match=rf"row {252 + bool(first)} has 3 fields, the header has 2"):
        layout(b"a,b\n" + first + b"\n".join(rows))


@pytest.mark.parametrize("data", [b"a" * (24 * MIB), b"a,b\n" + b"0" * (24 * MIB)], ids=["header", "row"])
def test_one_endless_line_is_refused_before_it_is_memory(monkeypatch, data):
    monkeypatch.setenv("RADIOTWIN_MAX_ROW_BYTES", str(2 * MIB))
    file = BytesIO(data)
    assert peak_mib(lambda: CsvLayout(Path("t.csv")).check(file)) < 16


KINDS = {"flight": "text", "time_s": "number", "x_m": "number or nothing", "los": "0 or 1"}
HEADER = "flight,time_s,x_m,los,other\n"


def test_columns_have_their_kinds(tmp_path):
    path = tmp_path / "table.csv"
    path.write_text(HEADER + "7,0.5,,1,<b>\nNA,2,3,0,<b>\n")
    table = read_table(path, KINDS, {"other": "text", "missing": "number"})
    assert list(table) == [*KINDS, "other"] and table["flight"].tolist() == ["7", "NA"]
    np.testing.assert_array_equal(table[["time_s", "x_m", "los"]], [[0.5, np.nan, 1], [2, 3, 0]])


@pytest.mark.parametrize("row, words", [
    ("f,<img>,1,1,", "row 2, column time_s: '<img>' is not a number"), ("f,,1,1,", "column time_s"),
    ("f,nan,1,1,", "column time_s"), ("f,1e308,1,1,", "column time_s"), ("f,1,inf,1,", "column x_m"),
    ("f,1,2e7,1,", r"column x_m: '2e7' is not a number within ±1e\+07"), ("f,1,1,2,", "column los"),
    ("f,1,1,,", "column los"), ("f,1,1", "3 fields"), ("f,1,1," + "9" * 5000 + ",", "column los")])
def test_other_cells_are_refused(tmp_path, row, words):
    path = tmp_path / "table.csv"
    path.write_text(HEADER + row + "\n")
    with pytest.raises(BadInput, match=words):
        read_table(path, KINDS)
