"""Texts of a run as they are shown."""

import pytest

from radiotwin.display import plain
from radiotwin.io.texts import MAX_TEXT, percent, shortly, shown, shown_data


@pytest.mark.parametrize("text, expected", [
    ("a b\tc\nd", "a b\tc\nd"), ("Gerät 7 · آنتن · 天线 · 👩‍🚀", "Gerät 7 · آنتن · 天线 · 👩‍🚀"),
    ("\x1b[2J\x07", r"\x1b[2J\x07"), ("a\u202eb\u2066c\u200f", r"a\u202eb\u2066c\u200f"), ("\0", r"\x00"),
    ("\ufeff\u200b", r"\ufeff\u200b"), ("\u2028", r"\u2028"), ("\ud800", r"\ud800")])
def test_what_is_hidden_is_shown(text, expected):
    assert shown(text) == expected


def test_long_texts_are_cut():
    assert len(shown("x" * 10**7)) == MAX_TEXT and shown("x" * 10**7).endswith("x…")
    assert shown("x" * MAX_TEXT) == "x" * MAX_TEXT


def test_data_for_a_script_keeps_its_arrays():
    packed = {"type": "uint8", "shape": [3], "data": "A" * 10_000}
    assert shown_data({"name": "\x1b", "values": packed, "list": ["\u202e", 1, None]}) == {
        "name": r"\x1b", "values": packed, "list": [r"\u202e", 1, None]}


@pytest.mark.parametrize("form, value, text", [
    *((percent, share, text) for share, text in (  # no share is rounded to nothing or all
        (0, "0%"), (1e-6, "under 1%"), (0.0099, "under 1%"), (0.01, "1%"), (0.5, "50%"), (0.99, "99%"), (0.9999, "over 99%"), (1, "100%"))),
    (shortly, 0.8, "0.8"), (shortly, 123.4, "123"), (shortly, 6012.0, "6,012"), (shortly, -1e5, "-100,000")])
def test_numbers_for_a_reader(form, value, text):
    assert form(value) == text


def test_names_in_figures_are_no_formulas_and_short():
    assert plain(r"a $\frac{$ b") == r"a \$\frac{\$ b" and plain("a\nb\x1b") == r"a b\x1b"
    assert len(plain("x" * 10**6)) == 100 and plain("a name that is long", 14) == "a name that i…"
