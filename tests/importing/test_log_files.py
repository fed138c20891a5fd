"""Several files, folders and zip files as one import, and zip files that nobody should open."""

import gzip
import struct
import zipfile

import pytest

from radiotwin.errors import BadInput
from radiotwin.importing import import_files, read_settings
from radiotwin.importing.log_files import list_files
from radiotwin.links.measurements import read_measurements

MAPPING = {"level": "level", "device": "device", "x": "x", "y": "y", "time": "t"}
GIVEN = {"level_unit": "dBm", "length_unit": "m", "time_format": "epoch s"}
HEAD = "t,device,x,y,level\n"
ONE, TWO = HEAD + "1,a,0,0,-80\n2,a,0,1,-81\n", HEAD + "11,b,5,5,-90\n"


@pytest.fixture
def logs(tmp_path):
    folder = tmp_path / "logs"
    (folder / "day 2").mkdir(parents=True)
    (folder / "one.csv").write_text(ONE)
    (folder / "day 2" / "two.csv").write_text(TWO)
    (folder / "notes.pdf").write_text("no log")
    (folder / ".hidden.csv").write_text("no log")
    return folder


@pytest.fixture
def bring_all(tmp_path):
    def bring_all(*paths, columns=MAPPING, **given):
        report = import_files(paths, read_settings(None, GIVEN | {"columns": columns} | given), tmp_path / "out")
        return read_measurements(tmp_path / "out" / "measurements.csv").table, report
    return bring_all


def zipped(path, files):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return path


def test_folder_files_and_zip_give_the_same(logs, tmp_path, bring_all):
    packed = zipped(tmp_path / "logs.zip", {"one.csv": ONE, "day 2/two.csv.gz": gzip.compress(TWO.encode()),
                                            "__MACOSX/._one.csv": "x", "notes.pdf": "x"})
    folder, report = bring_all(logs)
    assert list(folder["flight"]) == ["two", "one", "one"] and sorted(folder["device"]) == ["a", "a", "b"]
    assert [each["file"] for each in report["files"]] == ["day 2/two.csv", "one.csv"]
    assert report["rows"] == report["kept"] == 3 and "1 file of another format is left out" in report["warnings"]
    for paths in ([packed], [logs / "one.csv", logs / "day 2" / "two.csv"]):
        table, _ = bring_all(*paths)
        assert sorted(table.to_csv(index=False).split()) == sorted(folder.to_csv(index=False).split())


def test_endings_in_capitals(tmp_path, bring_all):
    """As loggers on FAT write them: by themselves, in a folder, and in a zip file."""
    folder = tmp_path / "LOGS"
    folder.mkdir()
    (folder / "ONE.CSV").write_text(ONE)
    (folder / "TWO.CSV.GZ").write_bytes(gzip.compress(TWO.encode()))
    packed = zipped(tmp_path / "LOGS.ZIP", {"ONE.CSV": ONE, "TWO.CSV.GZ": gzip.compress(TWO.encode())})
    for paths in ([folder], [packed], [folder / "ONE.CSV", folder / "TWO.CSV.GZ"]):
        table, _ = bring_all(*paths)
        assert list(table["flight"]) == ["ONE", "ONE", "TWO"] and list(table["device"]) == ["a", "a", "b"]


def test_a_map_in_a_zip_file_is_read_where_it_is(tmp_path):
    content = ('{"type": "FeatureCollection", "features": [{"type": "Feature", "properties": {"d": "a", "l": -80}, "geometry": '
               '{"type": "Point", "coordinates": [11.5, 48.1]}}]}')
    (tmp_path / "plain.geojson").write_text(content)
    packed = zipped(tmp_path / "a.zip", {"points.geojson": content})
    settings = read_settings(None, {"level_unit": "dBm", "columns": {
        "device": "d", "level": "l", "latitude": "latitude", "longitude": "longitude"}})
    for path, out in ((packed, tmp_path / "out"), (tmp_path / "plain.geojson", tmp_path / "same")):
        assert import_files([path], settings, out)["origin"] == {"latitude_deg": 48.1, "longitude_deg": 11.5, "altitude_m": 0.0}


def test_flights_and_receivers_by_file(logs, bring_all):
    table, _ = bring_all(logs, columns=MAPPING | {"flight": "by day", "receiver": "by file"})
    assert set(table["flight"]) == {"1970-01-01"} and set(table["receiver"]) == {"one", "two"}
    (logs / "day 2" / "one.csv").write_text(TWO.replace("b,5", "b,6"))
    table, _ = bring_all(logs)
    assert set(table["flight"]) == {"one.csv", "day 2/two.csv", "day 2/one.csv"}


def test_one_file_is_one_flight(logs, bring_all):
    assert set(bring_all(logs / "one.csv")[0]["flight"]) == {"flight"}
    assert set(bring_all(logs / "one.csv", logs / "one.csv", logs / "day 2" / ".." / "one.csv")[0]["flight"]) == {"flight"}


def test_what_another_file_has_too_counts_once(logs, bring_all):
    (logs / "copy.csv").write_text(ONE + "3,a,0,2,-82\n")
    table, report = bring_all(logs)
    assert len(table) == 4 and report["left_out"] == [
        {"reason": "repeats a reading of another file", "column": "", "readings": 2, "first": "one.csv: row 2"}]


def test_tables_of_positions_in_the_folder_are_no_logs(logs, bring_all):
    (logs / "sites.csv").write_text("device,x,y\na,1,1\n")
    table, report = bring_all(logs, devices=str(logs / "sites.csv"))
    assert len(table) == 3 and report["anchors"] == 1


def test_the_output_in_the_folder_is_no_log(logs, tmp_path):
    settings = read_settings(None, GIVEN | {"columns": MAPPING})
    for _ in range(2):
        assert len(import_files(logs, settings, logs / "out")["files"]) == 2


def test_places_in_messages_name_the_file(logs, bring_all):
    (logs / "day 2" / "two.csv").write_text(HEAD + "11,b,5,5,-90\n12,b,five,5,-90\n")
    with pytest.raises(BadInput, match="two.csv: row 3, column x: 'five' is not a number"):
        bring_all(logs)
    (logs / "day 2" / "two.csv").write_text(TWO + "12,b,1e9,5,-90\n")
    with pytest.raises(BadInput, match="2 files: day 2/two.csv: row 3: the receiver lies"):
        bring_all(logs)


def test_a_declared_unit_overrules_that_of_all_formats(logs, bring_all, tmp_path):
    wigle = "MAC,FirstSeen,RSSI,CurrentLatitude,CurrentLongitude,Type\na,2024-01-01 00:00:00,-60,48,11,WIFI\n"
    (tmp_path / "w.csv").write_text(wigle)
    (tmp_path / "v.csv").write_text(wigle.replace("-60", "-61"))
    settings = read_settings(None, {"level_unit": "dB"})
    assert import_files([tmp_path / "w.csv", tmp_path / "v.csv"], settings, tmp_path / "out")["rows"] == 2
    assert "gain_db" in read_measurements(tmp_path / "out" / "measurements.csv").table


def test_folders_without_logs_or_with_too_many(logs, tmp_path, monkeypatch):
    (tmp_path / "empty").mkdir()
    with pytest.raises(BadInput, match="holds no file of a format that is read"):
        list_files([tmp_path / "empty"], [])
    monkeypatch.setenv("RADIOTWIN_MAX_IMPORT_FILES", "1")
    with pytest.raises(BadInput, match="2 files; at most 1"):
        list_files([logs], [])


def test_links_out_of_the_folder_are_refused(logs, tmp_path):
    (tmp_path / "secret.csv").write_text(ONE)
    (logs / "link.csv").symlink_to(tmp_path / "secret.csv")
    with pytest.raises(BadInput, match="link.csv is a link that leads out of"):
        list_files([logs], [])


def test_names_that_would_climb_are_only_names(tmp_path, bring_all):
    packed = zipped(tmp_path / "climb.zip", {"../../one.csv": ONE, "/etc/two.csv": TWO})
    table, _ = bring_all(packed)
    assert set(table["flight"]) == {"one", "two"}
    assert sorted(path.name for path in tmp_path.iterdir()) == ["climb.zip", "out"]


def at(mark, offset, number):
    """Change a number of a zip file, after the last place of a mark."""
    def change(data):
        place = data.rindex(mark) + offset
        return data[:place] + struct.pack("<I", number) + data[place + 4:]
    return change


def of_format_64(data):
    end = data.rindex(b"PK\x05\x06")
    return data[:end] + b"PK\x06\x07" + bytes(16) + data[end:]


BAD = {  # files in a zip file, its change, limits, words of the message
    "a bomb by its declared size": ({f"{i}.csv": b"0" * 600_000 for i in range(4)}, None, {"FILE_BYTES": "2_000_000"},
                                    "2,400,000 bytes; at most 2,000,000 are read"),
    "a bomb that declares 100 bytes": ({"a.csv": HEAD + "1,a,0,0,-80\n" * 100_000}, at(b"PK\x01\x02", 24, 100), {}, "a.zip"),
    "packed in packed": ({"a.csv.gz": gzip.compress(b"0" * 5_000_000)}, None, {"FILE_BYTES": "1_000_000"},
                         "more than 1,000,000 bytes when decompressed"),
    "many files": ({f"{i}.csv": "" for i in range(30)}, None, {"IMPORT_FILES": "20"}, "30 files; at most 20"),
    "a long list of files": ({"a.csv": ONE}, at(b"PK\x05\x06", 12, 2**30), {}, "a list of files of more than 4,194,304 bytes"),
    "format 64": ({"a.csv": ONE}, of_format_64, {}, "more than 65,535 files or 4 GiB"),
    "no zip file": ({"a.csv": ONE}, lambda data: b"no zip", {}, "is no readable zip file"),
    "damaged": ({"a.csv": ONE}, lambda data: data[:40] + bytes([data[40] ^ 255]) + data[41:], {}, "damaged|cannot be read|no readable"),
    "encrypted": ({"a.csv": ONE}, at(b"PK\x01\x02", 8, 1), {}, "is encrypted"),
    "unusual compression": ({"a.csv": ONE}, at(b"PK\x01\x02", 10, zipfile.ZIP_LZMA), {}, "allowed are stored and deflated"),
    "no log": ({"a.xlsx": "x"}, None, {}, "holds no file of a format that is read")}


@pytest.mark.parametrize("name", BAD)
def test_zip_files_that_cannot_be_read(tmp_path, bring_all, monkeypatch, name):
    files, change, limits, message = BAD[name]
    packed = zipped(tmp_path / "a.zip", files)
    if change is not None:
        packed.write_bytes(change(packed.read_bytes()))
    for variable, limit in limits.items():
        monkeypatch.setenv(f"RADIOTWIN_MAX_{variable}", limit)
    with pytest.raises(BadInput, match=message):
        bring_all(packed)


def test_all_that_is_wrong_is_in_one_message(logs, bring_all):
    (logs / "day 2" / "two.csv").write_text("t,device,x,y\n11,b,5,5\n")
    with pytest.raises(BadInput) as raised:
        bring_all(logs, columns=MAPPING | {"z": "height", "heading": "yaw"}, time_format=None, length_unit=None)
    text = str(raised.value)
    assert text.startswith("6 things are wrong:\n")
    for part in ("columns 'height' (z), 'yaw' (heading) are missing", "two.csv: columns 'height' (z), 'level' (level), 'yaw'",
                 "one.csv: column t: time_format is not given", "one.csv: column y: length_unit is not given"):
        assert part in text
    assert text.count("length_unit") == 2  # once for each file
