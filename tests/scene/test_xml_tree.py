"""Trees of XML within their budgets, and numbers that every program reads alike."""

import numpy as np
import pytest

from radiotwin.errors import BadInput
from radiotwin.scene.mitsuba_xml import Node, XmlReader, read_numbers, read_vector, shown


def node(tmp_path, **attributes):
    return Node("scale", attributes, tmp_path / "a.xml", 3)


@pytest.mark.parametrize("text", ["", "1 2", "nan", "inf", "1e400", "1_000", "\u0663", "0x10", "1" * 5000, "1 " * 10**6])
def test_what_is_no_number(tmp_path, text):
    with pytest.raises(BadInput, match=r"a\.xml, line 3: <scale> has '.{0,70}' where 1 finite") as error:
        read_numbers(node(tmp_path), text, (1,))
    assert len(str(error.value)) < 300 + len(str(tmp_path))


def test_vectors(tmp_path):
    np.testing.assert_array_equal(read_vector(node(tmp_path, value="2"), 0), [2, 2, 2])
    np.testing.assert_array_equal(read_vector(node(tmp_path, y="-1e1"), 1), [1, -10, 1])


def test_one_budget_for_all_files(tmp_path, monkeypatch):
    (tmp_path / "a.xml").write_text("<scene><a/><b/></scene>")
    monkeypatch.setenv("RADIOTWIN_MAX_ELEMENTS", "5")
    reader = XmlReader(tmp_path / "a.xml")
    assert [child.tag for child in reader.read(tmp_path / "a.xml").children] == ["a", "b"]
    with pytest.raises(BadInput, match=r"6 XML elements; at most 5 .* RADIOTWIN_MAX_ELEMENTS"):
        reader.read(tmp_path / "a.xml")


def test_texts_in_messages():
    assert shown("a\x1b[31m") == r"'a\x1b[31m'" and len(shown("x" * 10**6)) == 63
