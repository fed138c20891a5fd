"""Nothing is left out without a word, and what is refused is read with the setting that the message names."""

import re
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

from radiotwin.errors import BadInput

HEAD = "t,x,y,d,l\n"
ROWS = "".join(f"2024-05-01T10:00:0{i}Z,{i},0,a,{-80 - i}\n" for i in range(6))
COLUMNS = {"time": "t", "x": "x", "y": "y", "device": "d", "level": "l"}
GIVEN = {"columns": COLUMNS, "length_unit": "m", "time_format": "ISO 8601"}


def with_cell(text, column, cell, rows=range(1, 2)):
    lines = [line.split(",") for line in text.splitlines()]
    place = lines[0].index(column)
    for row in rows:
        lines[row][place] = cell
    return "".join(",".join(line) + "\n" for line in lines)


LOG = HEAD + ROWS
REFUSALS = [  # content, settings that are refused, settings that help, what the message names of them
    (LOG, {"length_unit": None}, {"length_unit": "m"}, ["length_unit"]),
    (LOG, {"level_unit": None}, {"level_unit": "dBm"}, ["level_unit"]),
    (LOG, {"time_format": None}, {"time_format": "ISO 8601"}, ["time_format"]),
    (LOG.replace("Z,", ","), {}, {"time_zone": "UTC"}, ["time_zone"]),
    (LOG, {"columns": COLUMNS | {"level": None}}, {"columns": COLUMNS}, ["columns.level"]),
    (LOG, {"columns": COLUMNS | {"device": None}}, {"columns": COLUMNS}, ["columns.device"]),
    (LOG, {"columns": COLUMNS | {"device": "cell"}}, {"columns": COLUMNS}, ["mapping"]),
    (with_cell(LOG, "l", ""), {}, {"not_measured": ["empty"]}, ["not_measured", "not_detected"]),
    (with_cell(LOG, "l", "N/A"), {}, {"not_detected": ["empty"]}, ["not_measured", "not_detected", "N/A"]),
    (with_cell(LOG, "l", "weak"), {}, {"not_detected": ["weak"]}, ["not_measured", "not_detected", "--skip-bad-rows"]),
    (with_cell(LOG, "l", "weak"), {}, {"skip_bad_rows": 1}, ["--skip-bad-rows 1"]),
    (with_cell(LOG, "x", "east"), {}, {"skip_bad_rows": 1}, ["--skip-bad-rows 1"]),
    (with_cell(LOG, "t", "soon"), {}, {"skip_bad_rows": 1}, ["--skip-bad-rows 1"]),
    (with_cell(LOG, "t", "1800-01-01T00:00Z"), {}, {"skip_bad_rows": 1}, ["--skip-bad-rows 1"]),
    (with_cell(LOG, "d", "a\x01"), {}, {"skip_bad_rows": 1}, ["--skip-bad-rows 1"]),
    (with_cell(LOG, "d", "a,b"), {}, {"skip_bad_rows": 1}, ["--skip-bad-rows 1"]),
    (with_cell(LOG, "d", '"a'), {}, {"quotes": False}, ["--no-quotes"]),
    (LOG.replace("-8", "12"), {"level_unit": "dB"}, {"level_unit": "dB", "path_loss": True}, ["--path-loss"]),
    (LOG.replace("-8", "8"), {}, {"level_offset_db": -120.0}, ["--level-offset-db"]),
    (LOG.replace("2024-05-01T", "").replace("Z,", ","), {"time_zone": "UTC"},
     {"columns": COLUMNS | {"time": "2024-05-01 {t}"}, "time_zone": "UTC"}, ["--columns 'time="]),
    (LOG.replace(",", ";").replace("-80", "-80,123"), {}, {"decimal": ","}, ["--decimal"]),
    (LOG.replace("a,-", "ä,-").encode("utf-16-le"), {}, {"encoding": "utf-16-le"}, ["--encoding"]),
]


@pytest.mark.parametrize(("content", "refused", "helps", "named"), REFUSALS)
def test_a_refusal_names_a_setting_that_helps(bring_in, content, refused, helps, named):
    given = {name: value for name, value in (GIVEN | refused).items()}
    given["columns"] = {name: spec for name, spec in given["columns"].items() if spec}
    with pytest.raises(BadInput) as refusal:
        bring_in(content, **given)
    assert all(name in str(refusal.value) for name in named), str(refusal.value)
    result = bring_in(content, **given | helps)
    assert 5 <= len(result.table) <= 6


def test_options_that_messages_name_exist():
    """Every `--option` in a text of the import is one of its command."""
    from radiotwin.cli.importing import import_

    app = typer.Typer()
    app.command()(import_)
    options = set(re.findall(r"--[a-z][a-z-]+", CliRunner().invoke(app, ["--help"], env={"COLUMNS": "300", "NO_COLOR": "1"}).output))
    package = Path(__file__).parents[2] / "radiotwin" / "importing"
    for path in package.rglob("*.py"):
        for name in re.findall(r"(?<![\w-])--[a-z][a-z-]+", path.read_text(encoding="utf-8")):
            assert name in options, (path.name, name)


def test_a_column_that_is_not_used_is_told(bring_in):
    report = bring_in(LOG.replace("x,", "x,more,", 1).replace(",0,a", ",5,0,a"), **GIVEN).report
    assert report["files"][0]["not_used"] == ["more"] and any("not used: more" in note for note in report["warnings"])
