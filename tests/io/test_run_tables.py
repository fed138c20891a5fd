"""Tables of a run: typed columns, or one message."""

import numpy as np
import pytest

from radiotwin.errors import BadInput
from radiotwin.io.cells import read_table

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
