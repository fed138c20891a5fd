"""Clock readings in every form, and the two nights a year on which they mean nothing or two things."""

from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from radiotwin.errors import BadInput
from radiotwin.importing.source import Source
from radiotwin.importing.units import calendar_days, seconds


def read(values, form, zone=None):
    table = pd.DataFrame({"t": values})
    return seconds(Source(Path("f.csv"), table, lambda index: f"row {index + 2}"), "t", form, zone)


NOON = datetime(2022, 7, 6, 12, 0, 0, 250_000, tzinfo=UTC).timestamp()


@pytest.mark.parametrize(("text", "form", "zone"), [
    ("1657108800.25", "epoch s", None),
    ("1657108800250", "epoch ms", None),
    ("1657108800250000", "epoch us", None),
    ("1657108800250000000", "epoch ns", None),
    ("44748.50000289352", "serial date", "UTC"),
    ("2022-07-06T12:00:00.25Z", "ISO 8601", None),
    ("2022-07-06T14:00:00.25+02:00", "ISO 8601", "America/Denver"),  # an offset is worth more than a zone
    ("2022-07-06 06:00:00.25", "ISO 8601", "America/Denver"),  # daylight saving: UTC-6
    ("2022-07-06 12:00:00.25", "ISO 8601", "UTC"),
    ("06.07.2022 14:00:00.25", "%d.%m.%Y %H:%M:%S.%f", "Europe/Berlin"),
    ("06.07.2022 17:30:00.25 +0530", "%d.%m.%Y %H:%M:%S.%f %z", None),
])
def test_all_forms_are_the_same_moment(text, form, zone):
    np.testing.assert_allclose(read([text, "", text], form, zone), [NOON, np.nan, NOON], atol=1e-6)


@pytest.mark.parametrize("texts", [
    ("2024-03-31T00:30:00+01:00", "2024-03-31T03:30:00+02:00"), ("20240331T003000+0100", "20240331T033000.0+0200"),
    ("20240331T0030+01", "20240331T033000+02"), ("2024-03-31 00:30:00 +0100", "2024-03-31 01:30Z"),
    ("2024-03-30T23:30:00Z", "2024-03-31T01-00:30")])
def test_the_offset_changes_within_a_file(texts):
    first = datetime(2024, 3, 30, 23, 30, tzinfo=UTC).timestamp()
    assert list(read(texts, "ISO 8601")) == [first, first + 7200]


def test_winter_has_another_offset():
    assert read(["2022-01-06 05:00:00"], "ISO 8601", "America/Denver")[0] == datetime(2022, 1, 6, 12, tzinfo=UTC).timestamp()


def test_a_date_ends_in_no_offset():
    midnight = datetime(2024, 3, 31, tzinfo=UTC).timestamp()
    assert list(read(["2024-03-31", "20240331T01", "2024-03-31T020000"], "ISO 8601", "UTC") - midnight) == [0, 3600, 7200]


def test_the_day_is_that_of_the_zone():
    late = datetime(2022, 7, 7, 3, tzinfo=UTC).timestamp()
    assert list(calendar_days(np.array([late, np.nan]), "America/Denver")) == ["2022-07-06", ""]
    assert list(calendar_days(np.array([late]), None)) == ["2022-07-07"]


def test_times_of_parquet_need_a_zone_or_have_one():
    stamps = pd.to_datetime(["2022-07-06 12:00:00.25"])
    assert read(stamps.tz_localize("UTC"), "ISO 8601")[0] == NOON
    assert read(stamps, None, "UTC")[0] == read(stamps, "epoch s", "UTC")[0] == NOON
    with pytest.raises(BadInput, match="time_zone is not given"):
        read(stamps, "ISO 8601")


@pytest.mark.parametrize(("values", "form", "zone", "message"), [
    (["1657108800"], None, None, r"column t: time_format is not given; allowed are epoch s.*'1657108800'"),
    (["1"], "epoch", None, "'epoch' is unknown"),
    (["2022-07-06 12:00"], "ISO 8601", None, "time_zone is not given"),
    (["2022-07-06 12:00"], "ISO 8601", "Europe/Muenchen", "'Europe/Muenchen' is unknown"),
    (["2022-07-06 12:00"], "ISO 8601", "../etc/passwd", "is unknown"),
    (["1"], "epoch s", "denver", "'denver' is unknown.*America/Denver"),
    (["2022-07-06 12:00", "soon"], "ISO 8601", "UTC", "row 3, column t: 'soon' is no time"),
    (["2022"], "%Q", "UTC", "'%Q' is not a strftime format"), (["2022"], "%Y%Y", "UTC", "'%Y%Y' is not a strftime format"),
    (["1657108800", "1657108800250"], "epoch s", None, "row 3.*'1657108800250' lies outside of the years 1900 to 2200"),
    (["9999-12-31"], "ISO 8601", "UTC", "row 2.*'9999-12-31' lies outside"),
    (["soon"], "epoch s", None, "row 2, column t: 'soon' is not a number"),
    (["2022-07-06T12:00:00Z", "2022-07-06T12:00:00"], "ISO 8601", "UTC", "row 3.*carries no offset"),
    (["2022-03-27 01:59", "2022-03-27 02:30"], "ISO 8601", "Europe/Berlin", "row 3.*never happened.*forward"),
    (["2022-10-30 01:59", "2022-10-30 02:30", "2022-10-30 02:40"], "ISO 8601", "Europe/Berlin",
     r"row 3.*happened twice.*went back.*\(2 such rows\)"),
])
def test_times_that_cannot_be_used(values, form, zone, message):
    with pytest.raises(BadInput, match=message):
        read(values, form, zone)
