"""Entries of a mapping: names in other columns, columns made of several, offsets, rows that are chosen."""

import pytest

from radiotwin.errors import BadInput

WIDE = "t,x,y,PCI_1,RSRP_1,PCI_2,RSRP_2\n1,0,0,17,-80,22,-95\n2,5,0,22,-90,,\n"
GIVEN = {"length_unit": "m", "columns": {"x": "x", "y": "y"}}


def test_names_of_devices_stand_in_columns_beside_their_levels(bring_in):
    result = bring_in(WIDE, wide=[{"level": "RSRP_*", "device": "PCI_*"}], **GIVEN)
    assert result.table[["device", "rssi_dbm"]].values.tolist() == [["17", -80], ["22", -95], ["22", -90]]
    assert result.report["left_out"] == [{"reason": "no device", "column": "PCI_2", "readings": 1, "first": "row 3"}]
    assert result.report["readings"] == 4 and not any("named after" in note for note in result.report["warnings"])


def test_names_of_receivers_stand_in_columns_too(bring_in):
    result = bring_in("x,y,who 1,l 1,id\n0,0,roof,-80,b\n", length_unit="m", columns={"x": "x", "y": "y", "device": "id"},
                      wide=[{"level": "l *", "receiver": "who *"}])
    assert list(result.table["receiver"]) == ["roof"]


def test_a_column_of_names_that_is_missing_for_one_level_is_told(bring_in):
    with pytest.raises(BadInput, match=r"wide.device = 'PCI_\*' names columns .* for RSRP_2 there is no column 'PCI_2'"):
        bring_in(WIDE.replace("PCI_2", "other"), wide=[{"level": "RSRP_*", "device": "PCI_*"}], **GIVEN)


def test_names_that_are_made_of_the_columns_names_are_told(bring_in):
    result = bring_in(WIDE, wide=[{"level": "RSRP_*", "device": "PIC_*"}], not_measured=["empty"], **GIVEN)
    assert set(result.table["device"]) == {"PIC_1", "PIC_2"}
    assert any("wide.device = 'PIC_*' is no column of the file: the devices are named PIC_1, PIC_2" in note
               for note in result.report["warnings"])


def test_offsets_of_levels(bring_in):
    blocks = [{"level": "RSRP_1", "device": "one", "level_offset_db": 10.0}, {"level": "RSRP_2", "device": "two"}]
    result = bring_in(WIDE, wide=blocks, not_measured=["empty"], level_offset_db=-1.0, **GIVEN)
    assert result.table[["device", "rssi_dbm"]].values.tolist() == [["one", -71], ["two", -96], ["one", -81]]
    powers = bring_in("x,y,d,w\n0,0,a,1e-9\n", level_unit="mW", level_offset_db=3.0, length_unit="m",
                      columns={"x": "x", "y": "y", "device": "d", "level": "w"})
    assert powers.table["rssi_dbm"].tolist() == pytest.approx([-87])


def test_an_impossible_level_is_one_after_the_offset(bring_in):
    columns = {"x": "x", "y": "y", "device": "d", "level": "l"}
    result = bring_in("x,y,d,l\n0,0,a,5\n0,0,a,-20\n", level_offset_db=-10.0, length_unit="m", columns=columns)
    assert list(result.table["rssi_dbm"]) == [-5, -30]


def test_columns_made_of_several(bring_in):
    text = "day,clock,mcc,cell,x,y,l\n01.02.2024,10:00:00,262,7,0,0,-80\n01.02.2024,,262,7,1,0,-81\n01.02.2024,10:00:02,262,,2,0,-82\n"
    result = bring_in(text, length_unit="m", time_format="%d.%m.%Y %H:%M:%S", time_zone="UTC",
                      columns={"x": "x", "y": "y", "level": "l", "time": "{day} {clock}", "device": "cell {mcc}-{cell}"})
    assert list(result.table["device"]) == ["cell 262-7"] * 2 and result.table["time_s"].isna().tolist() == [False, True]
    with pytest.raises(BadInput, match=r"columns 'lac' \(device\), 'minute' \(time\) are missing"):
        bring_in(text, length_unit="m", columns={"x": "x", "y": "y", "level": "l", "time": "{day} {minute}", "device": "{mcc}-{lac}"})


def test_a_name_with_braces_is_a_column(bring_in):
    result = bring_in("x,y,{d},l\n0,0,a,-80\n", length_unit="m", columns={"x": "x", "y": "y", "device": "{d}", "level": "l"})
    assert list(result.table["device"]) == ["a"]


def test_rows_are_chosen_before_they_are_read(bring_in):
    columns = {"x": "x", "y": "y", "device": "d", "level": "l"}
    text = "x,y,d,l,tech,gps\n0,0,a,-80,LTE,1\nnone,0,b,-81,GSM,1\n2,0,c,-82,NR,1\n3,0,d,-83,NR,0\n"
    result = bring_in(text, length_unit="m", columns=columns, only={"tech": ["LTE", "NR"], "gps": [1.0]})
    assert list(result.table["device"]) == ["a", "c"]
    assert [(item["column"], item["readings"]) for item in result.report["left_out"]] == [("tech", 1), ("gps", 1)]


@pytest.mark.parametrize(("cells", "value"), [(("1234567", "7654321"), 1234567), (("868100000", "868300000"), 868_100_000),
                                              (("868.10", "868.30"), 868.1), (("868.10", "868.30"), "868.10")])
def test_rows_are_chosen_by_numbers_of_any_length(bring_in, cells, value):
    columns = {"x": "x", "y": "y", "device": "d", "level": "l"}
    text = f"x,y,d,l,c\n0,0,a,-80,{cells[0]}\n1,0,b,-81,{cells[1]}\n2,0,c,-82,\n"
    result = bring_in(text, length_unit="m", columns=columns, only={"c": [value]})
    assert list(result.table["device"]) == ["a"]
    with pytest.raises(BadInput, match="column c never is 1234568 or 1234568.5 or none of them .only.; it is"):
        bring_in(text, length_unit="m", columns=columns, only={"c": [1234568, 1234568.5, "none of them"]})
