"""Outputs are whole or absent."""

import pytest

from radiotwin.errors import BadInput
from radiotwin.files import atomic_folder, atomic_path


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
