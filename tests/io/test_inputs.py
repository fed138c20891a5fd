"""Files of strangers: refused with one message before they are read, if they are not what they should be."""

import gzip
import os
import tracemalloc

import pytest

from radiotwin.errors import BadInput
from radiotwin.io.budgets import ROWS
from radiotwin.io.inputs import (
    check_input,
    keep_inputs,
    open_gzip,
    read_bytes,
    read_json,
    read_text,
    read_toml,
    require_within,
)


def test_a_regular_file_is_read(tmp_path):
    (tmp_path / "a").write_bytes(b"\xef\xbb\xbfone\r\ntwo")
    assert read_bytes(tmp_path / "a") == b"\xef\xbb\xbfone\r\ntwo"
    assert read_text(tmp_path / "a") == "one\ntwo"
    assert check_input(tmp_path / "a") == 11


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs pipes in the file system")
@pytest.mark.parametrize("read", [read_bytes, read_text, read_json, read_toml, check_input])
def test_what_is_no_regular_file_is_refused_at_once(tmp_path, read):
    os.mkfifo(tmp_path / "pipe")
    for path, reason in ((tmp_path / "pipe", "not a regular file"), ("/dev/zero", "not a regular file"),
                         (tmp_path, "is a folder"), (tmp_path / "none", "does not exist"),
                         (tmp_path / ("a" * 300), "cannot be read"), (f"{tmp_path}/a\0b", "cannot be read")):
        with pytest.raises(BadInput, match=reason):
            read(path)


def test_a_file_above_its_budget_is_refused_before_it_is_read(tmp_path, monkeypatch):
    with open(tmp_path / "sparse", "wb") as file:
        file.truncate(3 * 2**30)
    tracemalloc.start()
    with pytest.raises(BadInput, match="3,221,225,472 bytes; at most 2,147,483,648 .*RADIOTWIN_MAX_FILE_BYTES"):
        read_bytes(tmp_path / "sparse")
    assert tracemalloc.get_traced_memory()[1] < 2**20
    tracemalloc.stop()
    (tmp_path / "small").write_bytes(b"abcd")
    monkeypatch.setenv("RADIOTWIN_MAX_FILE_BYTES", "3")
    with pytest.raises(BadInput, match="4 bytes; at most 3"):
        read_bytes(tmp_path / "small")
    monkeypatch.setenv("RADIOTWIN_MAX_FILE_BYTES", "4")
    assert read_bytes(tmp_path / "small") == b"abcd"


@pytest.mark.parametrize("text", ["", "-1", "0", "1e9", "many", "9" * 19, "٣"])
def test_a_limit_is_a_positive_whole_number(monkeypatch, text):
    monkeypatch.setenv("RADIOTWIN_MAX_ROWS", text)
    with pytest.raises(BadInput, match="RADIOTWIN_MAX_ROWS=.*whole number of rows"):
        ROWS.check(1, "table.csv")


def test_a_bomb_of_compressed_zeros_is_refused_while_it_is_read(tmp_path, monkeypatch):
    with gzip.open(tmp_path / "bomb.gz", "wb") as file:
        for _ in range(64):
            file.write(bytes(2**20))
    monkeypatch.setenv("RADIOTWIN_MAX_FILE_BYTES", str(2**24))
    read = 0
    with pytest.raises(BadInput, match="more than 16,777,216 bytes when decompressed"), \
            open_gzip(tmp_path / "bomb.gz") as file:
        while data := file.read(2**20):
            read += len(data)
    assert 2**23 <= read <= 2**24
    monkeypatch.setenv("RADIOTWIN_MAX_FILE_BYTES", str(2**26))
    with open_gzip(tmp_path / "bomb.gz") as file:
        assert len(file.read()) == 2**26


def test_damaged_compression_is_one_message(tmp_path):
    whole = gzip.compress(os.urandom(10_000))
    for name, data in {"cut.gz": whole[:5_000], "wrong.gz": b"not gzip", "flipped.gz": whole[:-8] + bytes(8)}.items():
        (tmp_path / name).write_bytes(data)
        with pytest.raises(BadInput, match="damaged or cut off"), open_gzip(tmp_path / name) as file:
            file.read()


@pytest.mark.parametrize("read, text, reason", [
    *((read_json, text, reason) for text, reason in (
        ("[" * 100_000, "levels of nesting"), ("1" * 5_000, "readable JSON"), ("[NaN]", "NaN is no JSON number"),
        ("[-Infinity]", "no JSON number"), ("{", "readable JSON"), ("", "readable JSON"))),
    *((read_toml, text, reason) for text, reason in (
        (".".join("a" * 20_000) + " = 1", "a key of more than 100 parts"), ("a = " + "[" * 100_000, "levels of nesting"),
        ("[" + " . ".join(['"a"'] * 200) + "]", "a key of more"), ("a = " + "1" * 5_000, "readable TOML"),
        ("a = \x00", "readable TOML"), ("a", "readable TOML")))])
def test_a_document_that_cannot_be_used_is_one_message(tmp_path, read, text, reason):
    (tmp_path / "a").write_text(text)
    tracemalloc.start()
    with pytest.raises(BadInput, match=reason):
        read(tmp_path / "a")
    assert tracemalloc.get_traced_memory()[1] < 2**24
    tracemalloc.stop()


def test_toml_is_searched_for_long_keys_in_linear_time(tmp_path):
    for text in ("a" * 2_000_000, "." * 1_000_000, "a " * 1_000_000, '"' * 1_000_000, "a.b " * 500_000):
        (tmp_path / "a.toml").write_text(text)
        with pytest.raises(BadInput):
            read_toml(tmp_path / "a.toml")
    (tmp_path / "a.toml").write_text('a.b."c d" = "' + "x." * 200 + '"')
    assert read_toml(tmp_path / "a.toml")["a"]["b"]["c d"].startswith("x.x")


def test_what_is_read_is_not_replaced(tmp_path):
    read = tmp_path / "in" / "a.csv"
    read.parent.mkdir()
    read.write_text("1")
    (tmp_path / "link.csv").symlink_to(read)
    for out in (read, read.parent, tmp_path / "link.csv", tmp_path / "in" / ".." / "in" / "a.csv"):
        with pytest.raises(BadInput, match=r"the command reads .*a\.csv, which would be lost; choose another"):
            keep_inputs(out, None, read)
    keep_inputs(read.parent / "b.csv", None, read)


def test_a_file_that_is_named_lies_in_the_folder(tmp_path):
    (tmp_path / "scene").mkdir()
    (tmp_path / "outside").touch()
    (tmp_path / "scene" / "link").symlink_to(tmp_path / "outside")
    (tmp_path / "scene" / "loop").symlink_to(tmp_path / "scene" / "loop")
    folder = tmp_path / "scene"
    assert require_within(folder, folder / "a" / "b", "x") == folder / "a" / "b"
    for name in ("../outside", "link", "loop", "/etc/passwd", "a\0b"):
        with pytest.raises(BadInput, match="x: .* leads out of"):
            require_within(folder, folder / name, "x")
