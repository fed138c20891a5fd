"""Outputs are whole or absent."""

import errno
import os

import pytest

from radiotwin.errors import BadInput
from radiotwin.files import atomic_folder, atomic_path, require_writable


def test_a_file_appears_when_it_is_finished(tmp_path):
    target = tmp_path / "new" / "out.csv.gz"
    with atomic_path(target) as temporary:
        assert temporary.suffixes[-2:] == [".csv", ".gz"], "writers choose their format by the suffix"
        temporary.write_text("whole")
        assert not target.exists()
    assert target.read_text() == "whole"
    assert [path.name for path in target.parent.iterdir()] == ["out.csv.gz"]


def test_a_failed_file_leaves_the_old_one_and_nothing_else(tmp_path):
    target = tmp_path / "out.csv"
    target.write_text("old")
    with pytest.raises(ZeroDivisionError), atomic_path(target) as temporary:
        temporary.write_text("half")
        1 / 0
    assert target.read_text() == "old"
    assert [path.name for path in tmp_path.iterdir()] == ["out.csv"]


def test_a_failed_folder_leaves_the_old_one_and_nothing_else(tmp_path):
    target = tmp_path / "scene"
    target.mkdir()
    (target / "old").touch()
    with pytest.raises(ZeroDivisionError), atomic_folder(target) as temporary:
        (temporary / "half").touch()
        1 / 0
    assert [path.name for path in tmp_path.rglob("*")] == ["scene", "old"]


def test_a_folder_replaces_the_old_one_whole(tmp_path):
    target = tmp_path / "scene"
    target.mkdir()
    (target / "old").touch()
    with atomic_folder(target) as temporary:
        (temporary / "new").touch()
    assert [path.name for path in target.iterdir()] == ["new"]
    assert [path.name for path in tmp_path.iterdir()] == ["scene"]


def test_what_cannot_be_written_is_bad_input(tmp_path):
    (tmp_path / "file").touch()
    (tmp_path / "folder").mkdir()
    for path in (tmp_path / "folder", tmp_path / "file" / "out.csv"):
        with pytest.raises(BadInput, match="choose another|name of a file"), atomic_path(path):
            pass
    with pytest.raises(BadInput, match="name of a folder"), atomic_folder(tmp_path / "file"):
        pass


@pytest.mark.skipif(not os.path.isdir("/proc/self"), reason="needs a folder that even root cannot write to")
def test_a_place_where_nothing_can_be_made_is_bad_input():
    for out in ("/proc/out.csv", "/proc/new/out.csv"):
        for make in (atomic_path, atomic_folder):
            with pytest.raises(BadInput, match=f"cannot write {out}: .*choose another"), make(out):
                pass
        with pytest.raises(BadInput, match="cannot write"):
            require_writable(out)


def test_a_device_file_is_not_replaced():
    with pytest.raises(BadInput, match="not an ordinary file"), atomic_path("/dev/null"):
        pass


@pytest.mark.parametrize("make", [atomic_path, atomic_folder])
def test_a_failed_rename_is_bad_input_and_leaves_the_old_one(tmp_path, monkeypatch, make):
    target = tmp_path / "out"
    if make is atomic_folder:
        target.mkdir()
        (target / "old").touch()
    else:
        target.write_text("old")
    before, replace = sorted(tmp_path.rglob("*")), os.replace

    def refuse_new(source, destination):
        if os.fspath(destination) == os.fspath(target) and "old" not in os.path.basename(source):
            raise OSError(errno.EBUSY, "Device or resource busy")
        replace(source, destination)

    monkeypatch.setattr("os.replace", refuse_new)
    with pytest.raises(BadInput, match="cannot write .*out: Device or resource busy"), make(target):
        pass
    assert sorted(tmp_path.rglob("*")) == before


def test_a_full_disk_is_bad_input_other_errors_of_the_body_are_not(tmp_path):
    with pytest.raises(BadInput, match="No space left"), atomic_path(tmp_path / "out"):
        raise OSError(errno.ENOSPC, "No space left on device")
    with pytest.raises(FileNotFoundError), atomic_path(tmp_path / "out"):
        open(tmp_path / "an input that is missing")


def test_no_empty_folders_stay_where_nothing_was_written(tmp_path):
    for make in (atomic_path, atomic_folder):
        with pytest.raises(ZeroDivisionError), make(tmp_path / "new" / "deep" / "out"):
            1 / 0
        assert list(tmp_path.iterdir()) == []
    require_writable(tmp_path / "new" / "out")
    assert list(tmp_path.iterdir()) == []
