"""Texts in which a spreadsheet finds no formula, and the way back."""

import numpy as np
import pandas as pd
import pytest

from radiotwin.io.texts import escape_formula, escape_formulas, unescape_formula, unescape_formulas


@pytest.mark.parametrize("text", ["=1+1", "+cmd|' /C calc'!A0", "-2+3", "@SUM(A1)", "\tx", "\r=x", "\uff1d1", "-", "-inf", "-1,5"])
def test_formulas_get_an_apostrophe(text):
    for written in (text, f"'{text}", f"''{text}"):
        assert escape_formula(written) == f"'{written}" and unescape_formula(f"'{written}") == written


@pytest.mark.parametrize("text", ["", "plain", "a=1", "-80.5", "+3", "-1e5", "-.5", "'", "'plain", "1.2.3", 5, None, -2.5])
def test_other_cells_stay(text):
    assert escape_formula(text) is text and unescape_formula(text) is text


def test_tables_there_and_back():
    table = pd.DataFrame({"=n": ["=x", "y", None], "n": [-1.5, np.nan, 2], "c": pd.Categorical(["+a", "b", "+a"])})
    before = table.copy(deep=True)
    written = escape_formulas(table)
    assert list(written) == ["'=n", "n", "c"] and list(written["c"]) == ["'+a", "b", "'+a"]
    pd.testing.assert_frame_equal(table, before)
    back = unescape_formulas(written)
    assert list(back["'=n"][:2]) == ["=x", "y"] and list(back["c"]) == list(table["c"]) and back["n"].equals(table["n"])
    assert list(written["c"]) == ["'+a", "b", "'+a"], "the argument is not changed"
