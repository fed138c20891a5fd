"""Summaries of objects: escaped, short, on one line."""

from radiotwin.display import MAX_LINE, Summary, count, some, span

HOSTILE = "<script>alert('x')</script>\x1b[31m\u202e\n"


def test_every_text_of_the_table_is_escaped():
    html = Summary(HOSTILE, HOSTILE, ((HOSTILE, HOSTILE),)).html()
    assert "<script" not in html and html.count("&lt;script&gt;") == 4
    summary = Summary("Scene", HOSTILE, (("name", HOSTILE),))
    assert not set(summary.html()) & set("\x1b\u202e") and not set(summary.text()) & set("\x1b\u202e\n")
    assert summary.text().startswith("<Scene: ") and len(Summary("Scene", "x" * 10**6).text()) < MAX_LINE + 20
    assert len(Summary("Scene", "x" * 10**6, (("n", "x" * 10**6),)).html()) < 1000


def test_numbers_have_units():
    assert (count(1, "link"), count(0, "link"), count(1200, "link")) == ("1 link", "0 links", "1,200 links")
    assert span(-101.26, -60.0, "dB") == "−101.3 to −60 dB" and span(float("nan"), 1.0, "dB") == "–"
    assert some("abc") == "a, b, c" and some(str(i) for i in range(7)) == "0, 1, 2, 3, 4, … (7 in all)"
    assert some([]) == ""
