"""How texts hold tables: found, declared, and refused where it is ambiguous."""

import pytest

from radiotwin.errors import BadInput
from radiotwin.importing.read_source import Expected, read_source
from radiotwin.importing.settings import Settings

ROWS = [["Zeit", "Breite", "Länge", "Zelle", "RSRP"], ["1", "48.1", "11.5", "A", "-81.5"], ["2", "48.2", "11.6", "B", "-90.25"],
        ["3", "48.3", "11.7", "B", "-91.0"]]


def text_of(delimiter=",", decimal=".", before="", after=""):
    rows = [[cell.replace(".", decimal) for cell in row] for row in ROWS]
    return before + "".join(delimiter.join(row) + "\n" for row in rows) + after


@pytest.fixture
def read(tmp_path):
    def read(content, name="data.csv", expected=(), **declared):
        path = tmp_path / name
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        source = read_source(path, Settings(**declared), Expected((frozenset(expected),)))
        return source, [list(source.table), *source.table.to_numpy().tolist()]
    return read


@pytest.mark.parametrize("delimiter", [",", ";", "\t", "|"])
@pytest.mark.parametrize("decimal", [".", ","])
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "latin-1"])
@pytest.mark.parametrize(("before", "after"), [("", ""), ("Messfahrt Süd\nGerät: 3\n\n", "Summe" + "\n" + "Ende, gut\n")])
def test_tables_are_the_same_however_they_are_written(read, delimiter, decimal, encoding, before, after):
    if delimiter == decimal == ",":
        pytest.skip("is no table")
    source, table = read(text_of(delimiter, decimal, before, after).encode(encoding))
    assert table == ROWS
    plain = delimiter == "," and not before and encoding in ("utf-8", "utf-8-sig")
    assert source.where(1) == ("row 3" if plain else f"line {6 if before else 3}") and bool(source.notes) != plain


def test_what_was_found_is_told(read):
    source, _ = read(text_of(";", ",", "Messfahrt Süd\n\n", "Ende\n").encode("cp1252"))
    assert source.notes == ("data.csv: separated by semicolons, decimal commas, encoding cp1252, 2 lines before the header, "
                            "1 line after the table ('Ende')",)


def test_a_preamble_of_pairs_is_no_table(read):
    """Twelve lines of two fields, three of five: the mapping decides."""
    pairs = "".join(f"Parameter {i};Wert {i}\n" for i in range(12))
    _, table = read(text_of(";", ",", pairs), expected={"rsrp", "breite"})
    assert table == ROWS


def test_declared_lines_are_not_looked_for(read):
    text = "a;b\n" + text_of(";") + "Summe;1;2;3;4\n"
    _, table = read(text, lines_before_header=1, lines_after_table=1, delimiter=";", decimal=".")
    assert table == ROWS
    with pytest.raises(BadInput, match="line 2 has 5 fields, the header has 2"):
        read(text, lines_before_header=0, delimiter=";")


def test_a_line_that_was_cut_off_is_told(read):
    source, table = read(text_of(";") + "4;48.4;11.8")
    assert table == ROWS and "1 line after the table" in source.notes[0]


@pytest.mark.parametrize("rows", [300, 500, 30_000])
def test_a_summary_is_found_however_long_the_table_is(read, rows):
    """Of which the beginning alone is looked at for all else; the last does not fit into one block."""
    text = "Zeit;Pegel\n" + "".join(f"{i};-80\n" for i in range(rows)) + "Mittel;-80;dBm\nEnde\n"
    source, table = read(text)
    assert len(table) == rows + 1 and table[-1] == [str(rows - 1), "-80"] and "2 lines after the table" in source.notes[0]


def test_many_lines_after_the_table_are_a_damaged_table(read):
    with pytest.raises(BadInput, match="line 5 has 1 fields"):
        read(text_of(";") + "".join(f"Ende {i}\n" for i in range(30)))


def test_quoted_fields_may_hold_separators_and_line_breaks(read):
    source, table = read('Zeit;Zelle\n1;"A; links"\n2;"B\nrechts"\n3;C\n')
    assert [row[1] for row in table] == ["Zelle", "A; links", "B\nrechts", "C"] and source.where(2) == "line 5"
    with pytest.raises(BadInput, match="is a quotation mark not closed|fields"):
        read('Zeit;Zelle\n1;A\n2;"B\n' + "3;C\n" * 50)


def test_repeated_names_are_numbered(read):
    source, table = read("Zeit,RSRP,RSRP,RSRP\n1,-80,-81,-82\n")
    assert table[0] == ["Zeit", "RSRP", "RSRP.2", "RSRP.3"]
    assert "column 'RSRP' occurs more than once: the others are RSRP.2" in source.notes[0]


def test_a_decimal_comma_is_not_a_separator_of_thousands(read):
    with pytest.raises(BadInput, match="'1,234' may be a number with a decimal comma, or one with separated thousands"):
        read("a;b\n1,234;x\n")
    assert read("a;b\n1,234;x\n", decimal=",")[1][1] == ["1.234", "x"]
    assert read("a;b\n1,234;x\n", decimal=".")[1][1] == ["1,234", "x"]


def test_encodings_that_are_declared_and_wrong(read):
    with pytest.raises(BadInput, match="is not text in utf-8; give another --encoding"):
        read("ü".encode("latin-1") + b",a\n1,2\n", encoding="utf-8")
    for name in ("hex", "idna", "punycode", "unicode_escape", "raw-unicode-escape", "undefined", "none"):
        with pytest.raises(ValueError, match="unknown; allowed are utf-8"):
            Settings(encoding=name)
    for name in ("UTF-16-LE", "utf_16_le", "UTF-16"):
        assert read("a,b\nü,1\n".encode(name), encoding=name)[1] == [["a", "b"], ["ü", "1"]]


def test_lines_are_those_of_the_reader(read):
    """A form feed ends no line there, and moved the header by one."""
    _, table = read("Report\x0cpage 1\nmade by x\n" + text_of())
    assert table == ROWS


def test_long_lines_and_rows_are_refused_before_they_fill_the_memory(read, monkeypatch):
    monkeypatch.setenv("RADIOTWIN_MAX_ROW_BYTES", "1000")
    with pytest.raises(BadInput, match="line 2: a line of 1,000 characters and more"):
        read("a;b\n" + "1" * 5000)
    whole = "a;b\n" + "".join(f'"{number}\nx";1\n' for number in range(500))
    assert len(read(whole)[1]) == 501
    with pytest.raises(BadInput, match="a row of more than 1,000 characters"):
        read(whole + '"\nx";' * 2000)
    _, table = read(("x" * 90 + "\n") * 15 + text_of(), lines_before_header=15)  # of which none is a part of the first row
    assert table == ROWS
