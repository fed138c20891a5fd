"""The layout of CSV files: rows are counted the same however the file is cut into blocks."""

import tracemalloc
from io import BytesIO
from pathlib import Path

import pytest

from radiotwin.errors import BadInput
from radiotwin.io.cells import CsvLayout

MIB = 2**20


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
    tracemalloc.start()
    try:
        with pytest.raises(BadInput, match="RADIOTWIN_MAX_ROW_BYTES"):
            CsvLayout(Path("t.csv")).check(file)
        assert tracemalloc.get_traced_memory()[1] < 16 * MIB
    finally:
        tracemalloc.stop()
