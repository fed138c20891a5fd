"""Workbooks: cells of all types, lines around the table, and workbooks that nobody should open."""

import datetime
import zipfile

import pytest

from radiotwin.errors import BadInput

openpyxl = pytest.importorskip("openpyxl")
COLUMNS = {"level": "RSRP", "device": "Zelle", "x": "x", "y": "y"}


@pytest.fixture
def book(tmp_path):
    path = tmp_path / "made.xlsx"
    book = openpyxl.Workbook()
    sheet = book.active
    sheet.title = "Messung"
    for row in (["Messfahrt Süd, Tag 1"], [], ["Datum", "Uhr", "Stempel", "Zelle", "x", "y", "RSRP"],
                [datetime.date(2024, 3, 1), datetime.time(10, 0, 1), datetime.datetime(2024, 3, 1, 10, 0, 1, 500_000), 7, 1.5, 2, -80.5],
                [datetime.date(2024, 3, 1), datetime.time(10, 0, 2), datetime.datetime(2024, 3, 1), 8, 3.0, 4, -91], ["Summe", 2]):
        sheet.append(row)
    book.create_sheet("leer")
    book.save(path)
    return path


def rewritten(path, change):
    """Return a workbook in which some files are others."""
    out = path.with_name("changed.xlsx")
    with zipfile.ZipFile(path) as old, zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as new:
        for name in old.namelist():
            new.writestr(name, change(name, old.read(name)))
    return out.read_bytes()


def test_dates_beside_times_and_lines_around_the_table(bring_in, book):
    given = {"length_unit": "m", "time_format": "ISO 8601", "time_zone": "UTC"}
    result = bring_in(book.read_bytes(), "log.xlsx", columns=COLUMNS | {"time": "{Datum} {Uhr}"}, **given)
    assert list(result.table["device"]) == ["7", "8"] and list(result.table["rssi_dbm"]) == [-80.5, -91]
    assert list(result.table["time_s"] % 60) == [1, 2] and list(result.table["receiver_x_m"]) == [1.5, 3]
    assert "2 lines before the header, 1 line after the table" in result.report["warnings"][0]
    result = bring_in(book.read_bytes(), "log.xlsx", columns=COLUMNS | {"time": "Stempel"}, **given)
    assert list(result.table["time_s"] % 86_400) == [36_001.5, 0]


def test_sheets_by_name(bring_in, book):
    given = {"columns": COLUMNS, "length_unit": "m"}
    assert len(bring_in(book.read_bytes(), "log.xlsx", sheet="Messung", **given).table) == 2
    with pytest.raises(BadInput, match="has no sheet 'x'; it has Messung, leer"):
        bring_in(book.read_bytes(), "log.xlsx", sheet="x", **given)
    with pytest.raises(BadInput, match="log.xlsx is empty"):
        bring_in(book.read_bytes(), "log.xlsx", sheet="leer", **given)


@pytest.mark.seconds
def test_workbooks_that_are_bombs(bring_in, book, monkeypatch):
    given = {"columns": COLUMNS, "length_unit": "m"}
    declared = rewritten(book, lambda name, data: b'<!DOCTYPE a [<!ENTITY b "c">]>' + data if "sheet1" in name else data)
    with pytest.raises(BadInput, match="is no XML of a workbook .it has a DOCTYPE"):
        bring_in(declared, "log.xlsx", **given)
    wide = rewritten(book, lambda name, data: data.replace(b'r="G5"', b'r="XFD5"') if "sheet1" in name else data)
    with pytest.raises(BadInput, match="row 5: 16,384 columns; at most 5,000"):
        bring_in(wide, "log.xlsx", **given)
    far = rewritten(book, lambda name, data: data.replace(b'<row r="6"', b'<row r="99999999"') if "sheet1" in name else data)
    with pytest.raises(BadInput, match="more than 1,048,576 rows"):
        bring_in(far, "log.xlsx", **given)
    large = rewritten(book, lambda name, data: data + b" " * 3_000_000 if "sheet1" in name else data)
    monkeypatch.setenv("RADIOTWIN_MAX_DOCUMENT_BYTES", "2_000_000")
    with pytest.raises(BadInput, match="bytes; at most 2,000,000 are read"):
        bring_in(large, "log.xlsx", **given)


@pytest.mark.parametrize("content", [b"no", b"PK\x05\x06" + bytes(18)])
def test_what_is_no_workbook(bring_in, content):
    with pytest.raises(BadInput, match="is no readable zip file|cannot be read as a workbook"):
        bring_in(content, "log.xlsx", columns=COLUMNS)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-16"])
def test_a_sheet_of_another_name_is_checked_as_well(bring_in, book, tmp_path, encoding):
    """What a part is, other parts say; its name may be anything."""
    out = tmp_path / "renamed.xlsx"
    with zipfile.ZipFile(book) as old, zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as new:
        for name in old.namelist():
            data = old.read(name)
            if name.endswith("sheet1.xml"):
                text = data.decode().replace("<?xml version='1.0' encoding='UTF-8' standalone='yes'?>", "")
                data = ('<!DOCTYPE a [<!ENTITY b "c">]>' + text).encode(encoding)
            new.writestr(name.replace("sheet1.xml", "sheet1.dat"), data.replace(b"sheet1.xml", b"sheet1.dat"))
    with pytest.raises(BadInput, match="is no XML of a workbook .it has a DOCTYPE"):
        bring_in(out.read_bytes(), "log.xlsx", columns=COLUMNS, length_unit="m")


def sheets(path, tables):
    book = openpyxl.Workbook()
    book.remove(book.active)
    for title, rows in tables.items():
        sheet = book.create_sheet(title)
        for row in rows:
            sheet.append(row)
    book.save(path)
    return path.read_bytes()


DAY = [["Zelle", "x", "y", "RSRP"], [7, 1.5, 2, -80.5], [8, 3.0, 4, -91]]


def test_sheets_of_the_same_columns_are_one_table(bring_in, tmp_path):
    days = {"cover": [["Messfahrt"]], "1": DAY, "2": [DAY[0], [7, 9, 2, -82]], "notes": [["a", "b"], [1, 2]], "empty": []}
    result = bring_in(sheets(tmp_path / "days.xlsx", days), "log.xlsx", columns=COLUMNS, length_unit="m")
    assert list(result.table["rssi_dbm"]) == [-80.5, -91, -82]
    assert any("sheets 1, 2 have the same columns" in note for note in result.report["warnings"])
    assert any("are not read: notes" in note for note in result.report["warnings"])
    days["2"].append([7, "far", 2, -83])
    with pytest.raises(BadInput, match="sheet 2: line 3, column x: 'far' is not a number"):
        bring_in(sheets(tmp_path / "days.xlsx", days), "log.xlsx", columns=COLUMNS, length_unit="m")


@pytest.mark.parametrize("decimal", [None, ","])
def test_texts_with_decimal_commas_and_serial_dates(bring_in, tmp_path, decimal):
    rows = [["t", *DAY[0]], [45350.5, 7, "1,5", 2, "-80,5"], [45350.75, 8, 3.25, 4, -91]]
    result = bring_in(sheets(tmp_path / "made.xlsx", {"a": rows}), "log.xlsx", columns=COLUMNS | {"time": "t"}, length_unit="m",
                      time_format="serial date", time_zone="UTC", decimal=decimal)
    assert list(result.table["receiver_x_m"]) == [1.5, 3.25] and list(result.table["rssi_dbm"]) == [-80.5, -91]
    assert list(result.table["time_s"] % 86_400) == [43_200, 64_800]
