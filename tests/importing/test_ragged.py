"""Texts whose lines are not all rows of one form: what is read, what is left out and told, and the way out of each refusal."""

import re

import pytest

from radiotwin.errors import BadInput

HEAD = ["time", "lat", "lon", "cell", "level"]
ROWS = [[f"2024-05-01T10:00:{i:02}Z", f"{48.1 + i * 2e-4:.4f}", "11.5", "A", str(-80 - i)] for i in range(12)]
MAPPING = {"columns": {"time": "time", "latitude": "lat", "longitude": "lon", "level": "level", "device": "cell"},
           "time_format": "ISO 8601"}


def text(rows=ROWS, head=HEAD, sep=","):
    return "".join(sep.join(row) + "\n" for row in [head, *rows])


def changed(row, cells):
    return [*ROWS[:row], cells, *ROWS[row + 1:]]


@pytest.mark.parametrize("content", [
    text([[*row, ""] for row in ROWS]), text([[*row, "", "", ""] for row in ROWS]),
    text([*ROWS[:5], ["# battery changed"], *ROWS[5:]]), text([*ROWS[:5], ["# a", "b", "c", "d", "e"], *ROWS[5:]]),
    text([["UTC", "deg", "deg", "", "dBm"], *ROWS]), text([["UTC", "degrees_north", "degrees_east", "", "(dBm)"], *ROWS], sep=";"),
    text([[*row[:4], row[4].replace("-", "\u2212")] for row in ROWS]), text([[*row[:4], row[4] + " dBm"] for row in ROWS]),
    text([*ROWS[:6], HEAD, *ROWS[6:]]), text([row + ["-101"] * (i % 2) for i, row in enumerate(ROWS)], [*HEAD, "nb1", "nb2"]),
    text(sep="  "), text(sep=" "), text(sep=" \t"), "# " + text(sep=" "), "% " + text(),
    "".join("".join(cell.rjust(22) for cell in row) + "\n" for row in [HEAD, *ROWS])])
@pytest.mark.parametrize("name", ["log.csv", "log.txt"])
def test_all_rows_are_read(bring_in, content, name):
    result = bring_in(content, name, **MAPPING)
    assert list(result.table["rssi_dbm"]) == [-80.0 - i for i in range(12)] and result.report["left_out"] == []


def test_a_row_that_was_cut_off_is_left_out_and_counted(bring_in):
    result = bring_in(text(changed(5, ROWS[5][:2])), **MAPPING)
    assert [(each["reason"], each["readings"], each["first"]) for each in result.report["left_out"]] == \
        [("row was cut off", 1, "line 7")]
    assert result.report["readings"] == 12 and len(result.table) == 11


def test_a_last_cell_may_have_been_cut_off_where_no_other_row_ends(bring_in):
    rows = [[*row, "x"] for row in ROWS]
    rows[5] = [*ROWS[5][:4], "-8"]
    assert list(bring_in(text(rows, [*HEAD, "note"]), **MAPPING).table["rssi_dbm"])[5] == -86


@pytest.mark.parametrize(("content", "kept"), [
    (text(changed(5, ["GPS", *ROWS[5][1:]])), 11), (text(changed(5, [*ROWS[5][:4], "ERR"])), 11),
    (text(changed(5, [*ROWS[5][:3], "A", "B", "-85"])), 11), (text([row[:3] if i % 2 else row for i, row in enumerate(ROWS)]), 6),
    (text([[row[0], "991.5", *row[2:]] if i % 3 == 1 else row for i, row in enumerate(ROWS)]), 8),
    (text(changed(5, [*ROWS[5][:2], "inf", *ROWS[5][3:]])), 11)])
def test_each_refusal_of_rows_names_how_many_to_skip_and_that_works(bring_in, content, kept):
    with pytest.raises(BadInput) as refusal:
        bring_in(content, **MAPPING)
    number = int(re.search(r"--skip-bad-rows (\d+)", str(refusal.value))[1])
    result = bring_in(content, **MAPPING, skip_bad_rows=number)
    assert len(result.table) == result.report["kept"] == kept
    left_out = sum(each["readings"] for each in result.report["left_out"])
    assert len(result.report["bad_rows"]) == number == left_out == result.report["readings"] - kept
    assert all(set(each) == {"row", "column", "cell", "reason"} for each in result.report["bad_rows"])


def test_a_row_of_several_levels_counts_each(bring_in):
    content = "x,a,b\n1,-80,-81\n2,-82,ERR\n?,-84,-85\n"
    given = {"columns": {"x": "x", "y": "always 0"}, "wide": [{"level": ["a", "b"], "device": "*"}], "length_unit": "m"}
    report = bring_in(content, **given, skip_bad_rows=2).report
    assert report["kept"] == 3 and [(each["column"], each["readings"]) for each in report["left_out"]] == [("x", 2), ("b", 1)]


def test_rows_of_all_files_count(tmp_path, bring_in):
    from radiotwin.importing import import_files, read_settings

    for name in ("a.csv", "b.csv"):
        (tmp_path / name).write_text(text(changed(5, ["GPS", *ROWS[5][1:]])).replace("11.5", "11.5" if name < "b" else "11.6"))
    files = [tmp_path / "a.csv", tmp_path / "b.csv"]
    with pytest.raises(BadInput, match="b.csv: row 7, column time.*--skip-bad-rows 2"):
        import_files(files, read_settings(None, MAPPING | {"level_unit": "dBm", "skip_bad_rows": 1}), tmp_path / "out")
    report = import_files(files, read_settings(None, MAPPING | {"level_unit": "dBm", "skip_bad_rows": 2}), tmp_path / "out")
    assert [each["row"] for each in report["bad_rows"]] == ["a.csv: row 7", "b.csv: row 7"]


def test_blanks_within_cells_need_names_of_their_parts(bring_in):
    content = text([[row[0].replace("T", " "), *row[1:]] for row in ROWS], sep=" ")
    with pytest.raises(BadInput, match="--header"):
        bring_in(content, "log.txt", **MAPPING)
    columns = MAPPING["columns"] | {"time": "{day} {hour}"}
    result = bring_in(content, "log.txt", columns=columns, time_format="ISO 8601", header=["day", "hour", *HEAD[1:]],
                      lines_before_header=1)
    assert len(result.table) == 12


def test_where_blanks_separate_any_cell_may_be_missing(bring_in):
    head, rows = [*HEAD, "sats"], [[*row, "9"] for row in ROWS]
    rows[5] = [*rows[5][:1], *rows[5][2:]]
    with pytest.raises(BadInput, match="line 7 has 5 fields.*--skip-bad-rows 1"):
        bring_in(text(rows, head, " "), "log.txt", **MAPPING)
    assert len(bring_in(text(rows, head, " "), "log.txt", **MAPPING, skip_bad_rows=1).table) == 11


@pytest.mark.parametrize(("lat", "lon", "expected"), [
    ("48°06'36.0\"\"N", "11°30'00\"\"E", (48.11, 11.5)), ("48.11 N", "11.5 W", (48.11, -11.5)), ("48° 6.6' S", "11.5°", (-48.11, 11.5)),
    ("-48.11°", "11° 30′ E", (-48.11, 11.5))])
def test_degrees_with_their_marks(bring_in, lat, lon, expected):
    content = text([[row[0], f'"{lat}"', f'"{lon}"', *row[3:]] for row in ROWS])
    report = bring_in(content, **MAPPING).report
    assert (report["ranges"]["latitude"]["median"], report["ranges"]["longitude"]["median"]) == pytest.approx(expected)
    with pytest.raises(BadInput, match="'somewhere' is not a number"):
        bring_in(text(changed(5, [ROWS[5][0], "somewhere", *ROWS[5][2:]])), **MAPPING)
