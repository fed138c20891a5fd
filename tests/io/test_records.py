"""Records are read by their schema, within their limits, or refused with one message."""

import json

import pytest
from pydantic import Field

from radiotwin.errors import BadInput
from radiotwin.io.forms import Real, Record, Whole, read_record, validated


class Part(Record):
    """A schema with one of each."""

    name: str
    value: Real | None = None
    count: Whole = 0
    parts: list["Part"] = Field(default_factory=list)


def test_what_is_given_comes_back_and_nothing_else():
    assert validated(Part, {"name": "a", "value": 3, "more": 1}, "x.json", "") == {"name": "a", "value": 3}
    assert isinstance(validated(Part, {"name": "a", "value": 3}, "x.json", "")["value"], int), "shown without decimals"


@pytest.mark.parametrize("record, words", [
    ({}, "name: Field required"), ([], "its content"), ({"name": 3}, "name: .*, not 3"), ({"name": None}, "name"),
    ({"name": "a", "value": "<img src=x>"}, "value: is not a number within .*, not '<img"),
    ({"name": "a", "value": True}, "value"), ({"name": "a", "value": float("nan")}, "value"),
    ({"name": "a", "value": 1e308}, "value"), ({"name": "a", "value": 10**4000}, "value"),
    ({"name": "a", "count": 2.0}, "count"), ({"name": "a", "count": -1}, "count"),
    ({"name": "a", "parts": [{"name": "b"}, {"name": []}]}, r"parts\.1\.name"),
    ({"name": "a", "parts": {"0": 1}}, "parts"), ({"name": ["x" * 10**6]}, "name")])
def test_each_field_has_its_type(record, words):
    with pytest.raises(BadInput, match=f"^x.json is damaged .{words}.*; make it again$") as error:
        validated(Part, record, "x.json", "make it again")
    assert len(str(error.value)) < 400 and "\n" not in str(error.value) and "pydantic" not in str(error.value)


@pytest.mark.parametrize("text, words", [
    ("[]", "no JSON object"), ('{"a": ' * 150 + "1" + "}" * 150, "nesting; at most 100"), ("[" * 100_000, "nesting"),
    ('{"a": ' + "9" * 5000 + "}", "not readable JSON"), ('{"a": NaN}', "NaN is no JSON number"),
    (json.dumps({"a": [0] * 100_001}), "100,001 entries; at most 100,000 .* RADIOTWIN_MAX_ENTRIES"),
    (" " * (2**25 + 1), "bytes; at most .* RADIOTWIN_MAX_RECORD_BYTES")])
def test_records_have_limits(tmp_path, text, words):
    (tmp_path / "x.json").write_text(text)
    with pytest.raises(BadInput, match=words):
        read_record(tmp_path / "x.json", "record")
