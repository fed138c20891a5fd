"""Positions of ROS bags, made up by rosbags' own writers; bags of strangers."""

import bz2
import sqlite3
import struct

import numpy as np
import pandas as pd
import pytest

from radiotwin.cli import main
from radiotwin.errors import BadInput
from radiotwin.importing.tracks.rosbag import read_rosbag
from radiotwin.links.measurements import read_measurements
from tests.command_line import run_in_this_process

rosbags = pytest.importorskip("rosbags")
START = int(pd.Timestamp("2024-03-01 10:00:00Z").timestamp())
PLACES = [(0, 48.1, 11.5, 560.0, 0), (1, 48.2, 11.5, 570.0, 0), (2, 48.3, 11.5, 580.0, -1), (3, 48.4, 11.5, 590.0, 2)]
KIND = "sensor_msgs/msg/NavSatFix"


def write(path, topics, *, is_ros1=False, places=PLACES, stamped=True, compression=None, storage="mcap"):
    """Write a bag with a fix a second on each topic, and texts on another."""
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_HUMBLE)
    kinds = store.types
    serialise = store.serialize_ros1 if is_ros1 else store.serialize_cdr
    if is_ros1:
        writer = Writer1(path)
        if compression:
            writer.set_compression(Writer1.CompressionFormat[compression])
    else:
        writer = Writer(path, version=9, storage_plugin=StoragePlugin[storage.upper()])
        if compression:
            writer.set_compression(CompressionMode[compression], CompressionFormat.ZSTD)
    with writer:
        text = writer.add_connection("/log", "std_msgs/msg/String", typestore=store)
        for topic in topics:
            connection = writer.add_connection(topic, KIND, typestore=store)
            for second, latitude, longitude, altitude, status in places:
                time = kinds["builtin_interfaces/msg/Time"](START + second if stamped else 0, 250_000_000 * stamped)
                header = kinds["std_msgs/msg/Header"](*([0] if is_ros1 else []), stamp=time, frame_id="gps")
                fix = kinds[KIND](header, kinds["sensor_msgs/msg/NavSatStatus"](status, 1), latitude, longitude, altitude,
                                  np.zeros(9), 0)
                writer.write(connection, (START + second) * 10**9, serialise(fix, KIND))
                writer.write(text, (START + second) * 10**9, serialise(kinds["std_msgs/msg/String"]("x" * 200), "std_msgs/msg/String"))
    return path


@pytest.mark.parametrize(("name", "how"), [
    ("a.bag", {"is_ros1": True}), ("a.bag", {"is_ros1": True, "compression": "BZ2"}), ("a.bag", {"is_ros1": True, "compression": "LZ4"}),
    ("a", {}), ("a", {"compression": "STORAGE"}), ("a", {"storage": "sqlite3"}),
    ("a", {"storage": "sqlite3", "compression": "MESSAGE"})])
def test_fixes_of_every_container(tmp_path, name, how):
    fixes = read_rosbag(write(tmp_path / name, ["/fix"], **how))
    np.testing.assert_allclose(fixes.time_s - START, [0.25, 1.25, 3.25], atol=1e-6)  # at 2 s there was none
    np.testing.assert_allclose(fixes.values["latitude"], [48.1, 48.2, 48.4])
    np.testing.assert_allclose(fixes.values["altitude"], [560, 570, 590])
    assert "WGS84 ellipsoid" in fixes.notes[0]


def test_times_of_the_recording_where_headers_have_none(tmp_path):
    fixes = read_rosbag(write(tmp_path / "a.bag", ["/fix"], is_ros1=True, stamped=False))
    np.testing.assert_allclose(fixes.time_s - START, [0, 1, 3])


def test_import_joins_a_log_with_a_bag(tmp_path):
    (tmp_path / "log.csv").write_text("t,id,rssi\n" + "".join(f"{START + t},b,-8{i}\n" for i, t in enumerate((0.75, 1.25, 60))))
    bag = write(tmp_path / "flight", ["/gps/fix", "/mavros/global_position/raw/fix"])
    given = ("import log.csv --columns time=t,device=id,level=rssi --level-unit dBm "
             f"--track {bag} --origin 48.15,11.5,500 -o out").split() + ["--time-format", "epoch s"]
    refused = run_in_this_process(main, given, tmp_path)
    assert refused.returncode == 2 and not (tmp_path / "out").exists()
    assert "name one of /gps/fix, /mavros/global_position/raw/fix with --track-topic" in " ".join(refused.stderr.split())
    assert run_in_this_process(main, [*given, "--track-topic", "/gps/fix"], tmp_path).returncode == 0
    table = read_measurements(tmp_path / "out" / "measurements.csv").table
    np.testing.assert_allclose(table["receiver_z_m"], [65, 70])
    assert abs(table["receiver_y_m"][0]) < 0.1 and 'topic = "/gps/fix"' in (tmp_path / "out" / "import.toml").read_text()


def test_recordings_that_were_cut_off(tmp_path):
    """Without their index, as after a crash."""
    whole = write(tmp_path / "a.bag", ["/fix"], is_ros1=True).read_bytes()
    (tmp_path / "cut.bag").write_bytes(whole[:whole.rindex(b"op=\x07")])
    assert len(read_rosbag(tmp_path / "cut.bag").time_s) == 3
    file = next(write(tmp_path / "b", ["/fix"]).glob("*.mcap"))
    (tmp_path / "cut.mcap").write_bytes(file.read_bytes()[:-60])
    assert len(read_rosbag(tmp_path / "cut.mcap").time_s) == 3


def record(data, **fields):
    """Return a record of a ROS 1 bag (wiki.ros.org/Bags/Format/2.0)."""
    header = b"".join(struct.pack("<I", len(name) + 1 + len(value)) + name.encode() + b"=" + value for name, value in fields.items())
    return struct.pack("<I", len(header)) + header + struct.pack("<I", len(data)) + data


def bomb_mcap(compression, data):
    """Return an MCAP file with one chunk (mcap.dev/spec)."""
    name = compression.encode()
    body = struct.pack("<QQQII", 0, 1, 5, 0, len(name)) + name + struct.pack("<Q", len(data)) + data
    return b"\x89MCAP0\r\n" + struct.pack("<BQ", 6, len(body)) + body


def test_chunks_are_refused_before_they_fill_memory(tmp_path, monkeypatch):
    import tracemalloc

    from backports import zstd
    from lz4.frame import compress

    monkeypatch.setenv("RADIOTWIN_MAX_BAG_CHUNK_BYTES", "1_000_000")
    zeros = bytes(200_000_000)
    files = {"a.bag": chunk(bz2.compress(zeros[:50_000_000], 1), b"bz2"),
             "b.mcap": bomb_mcap("lz4", compress(zeros)), "c.mcap": bomb_mcap("zstd", zstd.compress(zeros))}
    del zeros
    for name, content in files.items():
        (tmp_path / name).write_bytes(content)
        tracemalloc.start()
        with pytest.raises(BadInput, match="a chunk, decompressed: 1,000,001 bytes; at most 1,000,000 are read"):
            read_rosbag(tmp_path / name)
        assert tracemalloc.get_traced_memory()[1] < 20e6
        tracemalloc.stop()
    small = chunk(bz2.compress(record(bytes(899_982), op=b"\3")), b"bz2")
    (tmp_path / "many.bag").write_bytes(small + small.removeprefix(b"#ROSBAG V2.0\n") * 19)
    monkeypatch.setenv("RADIOTWIN_MAX_FILE_BYTES", "10_000_000")
    with pytest.raises(BadInput, match="many.bag, decompressed: 10,799,976 bytes"):
        read_rosbag(tmp_path / "many.bag")


def connection(kind, definition, md5="2d3a8cd499b9b4a0249fb98fd05cfa48"):
    fields = {"type": kind, "md5sum": md5, "message_definition": definition}
    data = b"".join(struct.pack("<I", len(name) + 1 + len(value)) + f"{name}={value}".encode() for name, value in fields.items())
    return record(data, op=b"\7", conn=bytes(4), topic=b"/fix")


def chunk(data, compression=b"none"):
    return b"#ROSBAG V2.0\n" + record(data, op=b"\5", compression=compression, size=bytes(4))


@pytest.mark.parametrize(("content", "message"), [
    (b"no bag", "is no ROS 1 bag of format 2.0"), (chunk(b"x", b"rar"), "compressed by 'rar'"), (chunk(b"x", b"bz2"), "a chunk is damaged"),
    (b"#ROSBAG V2.0\n" + record(b"x", name=b"\5"), "is damaged"),
    (b"#ROSBAG V2.0\n" + struct.pack("<I", 2**32 - 1), "a record's header: 4,294,967,295 bytes"),
    (b"#ROSBAG V2.0\n", "has no messages of type sensor_msgs/NavSatFix"),
    # rosbags would make Python of a bag's definitions: an own one is refused, and no text of one is parsed.
    (chunk(connection("sensor_msgs/NavSatFix", "float64 x", md5="0" * 32)), "topic '/fix' has a NavSatFix of its own"),
    (chunk(connection("sensor_msgs/NavSatFix", "no definition (\n") + record(b"short", op=b"\2", conn=bytes(4), time=bytes(8))),
     "a message of '/fix' cannot be decoded"),
    # A position beyond what the system can seek to was a traceback.
    (b"\x89MCAP0\r\n" + struct.pack("<BQ", 0x7f, 2**61) + bytes(50), "has no messages")])
def test_bags_that_cannot_be_used(tmp_path, content, message):
    path = tmp_path / ("a.mcap" if b"MCAP" in content else "a.bag")
    path.write_bytes(content)
    with pytest.raises(BadInput, match=message):
        read_rosbag(path)


def test_tables_of_a_stranger(tmp_path):
    """A view could compute for ever."""
    with sqlite3.connect(tmp_path / "a.db3") as database:
        database.execute("CREATE TABLE topics(id INTEGER, name TEXT, type TEXT, serialization_format TEXT)")
        database.execute("CREATE VIEW messages AS WITH RECURSIVE n(topic_id) AS (SELECT 1 UNION ALL SELECT topic_id + 1 FROM n) "
                         "SELECT topic_id, 0 AS timestamp, 'a' AS data FROM n")
    database.close()
    with pytest.raises(BadInput, match="'messages' is a view"):
        read_rosbag(tmp_path / "a.db3")


def test_folders_and_names_that_are_none(tmp_path):
    with pytest.raises(BadInput, match="holds no .mcap or .db3 file"):
        read_rosbag(tmp_path)
    with pytest.raises(BadInput, match="zstd -d a.mcap.zstd"):
        read_rosbag(tmp_path / "a.mcap.zstd")
    (tmp_path / "bag").mkdir()
    (tmp_path / "a.mcap").write_bytes(bomb_mcap("", b""))
    (tmp_path / "bag" / "b.mcap").symlink_to(tmp_path / "a.mcap")
    with pytest.raises(BadInput, match="leads out of"):
        read_rosbag(tmp_path / "bag")
