"""Outputs are whole or absent."""

import errno
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import nullcontext, suppress
from pathlib import Path

import pytest

from radiotwin.errors import BadInput, RunFailed
from radiotwin.io import files
from radiotwin.io.files import (
    atomic_file,
    atomic_folder,
    atomic_path,
    require_folder,
    require_writable,
    scratch_folder,
)


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


NAMES = ("result.json", "effect_*.png")


def content(folder):
    return {path.relative_to(folder).as_posix(): path.read_text() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture(params=["beside", "working folder", "link", "volume"])
def older(request, tmp_path, monkeypatch):
    """An older result with a file of the user's, in a folder that can, or cannot, be renamed."""
    folder = tmp_path / "real"
    (folder / "twin").mkdir(parents=True)
    for name in ("result.json", "effect_1.png", "notes.txt", "twin/twin.json"):
        (folder / name).write_text("old")
    if request.param == "working folder":
        monkeypatch.chdir(folder)
        return Path(".")
    if request.param == "link":
        (tmp_path / "link").symlink_to(folder)
        return tmp_path / "link"
    if request.param == "volume":
        monkeypatch.setattr(Path, "is_mount", lambda path: path == folder)
    return folder


def test_of_a_folder_what_is_written_is_replaced_as_a_whole_and_the_rest_stays(older, tmp_path):
    before = content(older)
    with pytest.raises(ZeroDivisionError), atomic_folder(older, (*NAMES, "twin")) as temporary:
        (temporary / "result.json").write_text("half")
        1 / 0
    assert content(older) == before
    with atomic_folder(older, (*NAMES, "twin")) as temporary:
        (temporary / "twin").mkdir()
        for name in ("result.json", "twin/channel.pt"):
            (temporary / name).write_text("new")
    assert content(tmp_path / "real") == {"result.json": "new", "twin/channel.pt": "new", "notes.txt": "old"}
    assert {path.name for path in tmp_path.iterdir()} <= {"real", "link"}


def test_a_folder_that_cannot_be_renamed_is_replaced_too(older, tmp_path):
    with atomic_folder(older) as temporary:
        (temporary / "new").write_text("new")
    assert content(tmp_path / "real") == {"new": "new"}


@pytest.mark.parametrize("number", range(6))  # of renames: three away, three in
def test_a_failed_rename_in_a_folder_leaves_the_old_content(tmp_path, monkeypatch, number):
    older = tmp_path / "out"
    older.mkdir()
    for name in ("a", "b", "c", "mine"):
        (older / name).write_text("old")
    replace, done = os.replace, []

    def refuse_one(source, target):
        if target == older:
            raise OSError(errno.ENOTEMPTY, "Directory not empty")
        done.append(source)
        if len(done) == number + 1:
            raise OSError(errno.EIO, "Input/output error")
        replace(source, target)

    monkeypatch.setattr("os.replace", refuse_one)
    with pytest.raises(RunFailed, match="out: Input/output error; what was there before is unchanged"), \
            atomic_folder(older, "abc") as temporary:
        for name in ("a", "b", "d"):
            (temporary / name).write_text("new")
    monkeypatch.undo()
    assert content(tmp_path) == {f"out/{name}": "old" for name in ("a", "b", "c", "mine")}


@pytest.mark.skipif(os.name != "posix", reason="folders are locked on POSIX only")
@pytest.mark.parametrize("names", [None, NAMES])
def test_two_that_write_a_folder_at_once_leave_that_of_one(tmp_path, names):
    program = ("import sys; from radiotwin.io.files import *\n"
               "for number in range(25):\n"
               "    with atomic_folder(sys.argv[1], eval(sys.argv[3])) as folder:\n"
               "        for name in ('result.json', 'effect_1.png', 'effect_2.png'):\n"
               "            (folder / name).write_text(sys.argv[2])")
    both = [subprocess.Popen([sys.executable, "-c", program, tmp_path / "out", who, repr(names)]) for who in "ab"]
    assert [each.wait() for each in both] == [0, 0]
    assert len(set(content(tmp_path / "out").values())) == 1 and len(content(tmp_path)) == 3


def test_a_folder_with_files_that_would_be_lost_is_refused(tmp_path):
    (tmp_path / "notes.txt").touch()
    require_folder(tmp_path, NAMES, "result.json", keep_others=True)
    with pytest.raises(BadInput, match="holds notes.txt, which the new content would erase; move it away"):
        require_folder(tmp_path, NAMES)
    (tmp_path / "effect_1.png").touch()
    with pytest.raises(BadInput, match="holds effect_1.png, and no result.json of an earlier run, which"):
        require_folder(tmp_path, NAMES, "result.json", keep_others=True)
    (tmp_path / "result.json").touch()
    require_folder(tmp_path, NAMES, "result.json", keep_others=True)
    (tmp_path / "notes.txt").unlink()
    require_folder(tmp_path, NAMES, "result.json")
    with pytest.raises(BadInput, match="is a file; give the name of a folder"):
        require_folder(tmp_path / "result.json", NAMES)
    with pytest.raises(BadInput, match="cannot write"):
        require_folder("a" * 300, NAMES)


def test_what_fails_in_a_folder_is_named_as_it_would_be_there(tmp_path):
    with pytest.raises(RunFailed, match=f"cannot write {tmp_path}/out/a.csv: No space left"), \
            atomic_folder(tmp_path / "out") as temporary, atomic_path(temporary / "a.csv"):
        raise OSError(errno.ENOSPC, "No space left on device")


@pytest.mark.parametrize("path, file, folder", [
    ("{}/folder", "name of a file", ""), ("{}/file", "", "name of a folder"), ("{}/file/out", "choose another", "choose another"),
    ("/dev/null", "not an ordinary file", "name of a folder"), ("{}/" + "a" * 300, "cannot write", "cannot write"),
    *((f"/proc{new}/out.csv", f"cannot write /proc{new}/out.csv: .*choose another", "cannot write") for new in ("", "/new")
      if os.path.isdir("/proc/self"))])  # where even root cannot write
def test_what_cannot_be_written_is_bad_input(tmp_path, path, file, folder):
    (tmp_path / "file").touch()
    (tmp_path / "folder").mkdir()
    for make, message in ((atomic_path, file), (require_writable, file), (atomic_folder, folder)):
        if message:
            with pytest.raises(BadInput, match=message), make(path.format(tmp_path)) or nullcontext():
                pass
    assert sorted(os.listdir(tmp_path)) == ["file", "folder"]


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
        if os.fspath(destination) == os.fspath(target) and "aside" not in os.fspath(source):
            raise OSError(errno.EBUSY, "Device or resource busy")
        replace(source, destination)

    monkeypatch.setattr("os.replace", refuse_new)
    with pytest.raises(BadInput, match="cannot write .*out: Device or resource busy"), make(target):
        pass
    assert sorted(tmp_path.rglob("*")) == before


def test_a_full_disk_is_a_failure_of_the_run_other_errors_of_the_body_are_not(tmp_path):
    with pytest.raises(RunFailed, match="No space left"), atomic_path(tmp_path / "out"):
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
    with atomic_path(tmp_path / "new" / "out"):
        pass
    (tmp_path / "new" / "out").unlink()
    require_writable(tmp_path / "new" / "out")
    assert (tmp_path / "new").is_dir(), "others may write there, too"


FULL = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs a file that is always full")
def test_an_error_that_a_library_must_not_see_is_raised_in_the_end(tmp_path):
    target = tmp_path / "out.nc"
    target.write_text("old")
    with pytest.raises(RunFailed, match="cannot write .*out.nc: No space left .* unchanged"), \
            atomic_file(target, hide_errors=True) as file:
        file._file.close()
        file._file = open("/dev/full", "r+b", buffering=0)
        assert file.write(b"abc") == 3, "the library goes on"
        assert file.write(b"def") == 3
    assert target.read_text() == "old"
    assert [path.name for path in tmp_path.iterdir()] == ["out.nc"]


def test_what_is_written_to_an_open_file_is_there(tmp_path):
    for hide in (False, True):
        with atomic_file(tmp_path / "out", hide_errors=hide) as file:
            file.write(b"abcdef")
            file.seek(1)
            file.write(b"B")
            file.seek(0)
            assert file.read(6) == b"aBcdef"
            file.truncate(4)
        assert (tmp_path / "out").read_bytes() == b"aBcd"


def test_an_error_when_the_file_is_flushed_is_a_failure_of_the_run(tmp_path, monkeypatch):
    (tmp_path / "out").write_text("old")

    def fail(handle):
        raise FULL

    monkeypatch.setattr("os.fsync", fail)
    with pytest.raises(RunFailed, match="cannot write"), atomic_path(tmp_path / "out") as temporary:
        temporary.write_text("new")
    (tmp_path / "folder").mkdir()
    with pytest.raises(RunFailed, match="cannot write"), atomic_folder(tmp_path / "folder") as temporary:
        (temporary / "new").write_text("new")
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["folder", "out"]
    assert (tmp_path / "out").read_text() == "old"


@pytest.mark.skipif(os.name != "posix", reason="temporaries are locked and swept on POSIX only")
def test_temporaries_of_a_killed_process_are_swept_by_the_next_one_that_writes_there(tmp_path):
    program = ("import sys, time; from radiotwin.io.files import *\n"
               "with atomic_path(sys.argv[1] + '/a.csv'), atomic_folder(sys.argv[1] + '/b') as b:\n"
               "    (b / 'c').touch(); print('ready', flush=True); time.sleep(60)")
    child = subprocess.Popen([sys.executable, "-c", program, tmp_path], stdout=subprocess.PIPE)
    assert child.stdout.readline() == b"ready\n"
    alive = sorted(tmp_path.iterdir())
    assert len(alive) == 2 and all(path.is_dir() for path in alive)
    files._sweep.cache_clear()
    require_writable(tmp_path / "other")
    assert sorted(tmp_path.iterdir()) == alive, "those of a living process are kept"
    child.send_signal(signal.SIGKILL)
    child.wait()
    child.stdout.close()
    (tmp_path / ".radiotwin-notes").touch()
    files._sweep.cache_clear()
    require_writable(tmp_path / "other")
    assert [path.name for path in tmp_path.iterdir()] == [".radiotwin-notes"], "no file of the user's"


@pytest.mark.skipif(os.name != "posix", reason="temporaries are locked and swept on POSIX only")
def test_a_folder_that_was_put_aside_by_a_killed_process_is_put_back(tmp_path):
    aside = tmp_path / ".radiotwin-abcdefgh-aside"
    (aside / "scene").mkdir(parents=True)
    (aside / "scene" / "old").touch()
    files._sweep.cache_clear()
    require_writable(tmp_path / "other")
    assert [path.name for path in tmp_path.rglob("*")] == ["scene", "old"]


def test_a_scratch_folder_is_gone_in_the_end():
    with scratch_folder() as folder:
        (folder / "a").touch()
    assert not folder.exists()


def test_a_file_that_another_process_removes_meanwhile_is_written(tmp_path):
    """Rationale: asked twice whether it is there, a file could be missing the second time."""
    path, done = tmp_path / "new" / "part.bin", threading.Event()

    def remove():
        while not done.is_set():
            with suppress(FileNotFoundError):
                path.unlink()

    other = threading.Thread(target=remove)
    other.start()
    try:
        for _ in range(500):
            with atomic_path(path, flush=False) as temporary:
                temporary.write_bytes(b"x")
    finally:
        done.set()
        other.join()


@pytest.mark.skipif(os.name != "posix", reason="temporaries are locked and swept on POSIX only")
def test_a_temporary_that_another_process_sweeps_before_it_is_locked_is_made_again(tmp_path, monkeypatch):
    make, made = tempfile.mkdtemp, []

    def make_and_sweep_the_first(**options):
        made.append(make(**options))
        if len(made) == 1:
            files._remove_stale(Path(made[0]), aside=False)
        return made[-1]

    monkeypatch.setattr("tempfile.mkdtemp", make_and_sweep_the_first)
    with atomic_path(tmp_path / "part.bin") as temporary:
        temporary.write_bytes(b"x")
    assert len(made) == 2 and [path.name for path in tmp_path.iterdir()] == ["part.bin"]


@pytest.mark.skipif(os.name != "posix", reason="temporaries are locked and swept on POSIX only")
def test_a_folder_that_is_replaced_again_and_again_is_whole_whenever_its_process_is_killed(tmp_path):
    program = ("import sys; from itertools import count; from radiotwin.io.files import *\n"
               "for number in count():\n"
               "    with atomic_folder(sys.argv[1], ('*.txt',)) as folder:\n"
               "        for name in 'abcdef':\n"
               "            (folder / f'{name}.txt').write_text(str(number))\n"
               "    print(number, flush=True)")
    for moment in range(0, 20, 5):
        child = subprocess.Popen([sys.executable, "-S", "-c", program, tmp_path / "out"], stdout=subprocess.PIPE,
                                 env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)})
        for _ in range(1 + moment % 4):
            child.stdout.readline()
        time.sleep(moment * 2e-4)
        child.kill()
        child.wait()
        child.stdout.close()
        files._sweep.cache_clear()
        require_writable(tmp_path / "other")
        assert len(content(tmp_path)) == 6 and len(set(content(tmp_path).values())) == 1


@pytest.mark.parametrize("names", [None, ("maps",)])
def test_an_older_folder_that_nothing_may_be_removed_from_leaves_nothing(tmp_path, names):
    """What stayed would come back where the older run was, once the newer one is removed."""
    (tmp_path / "out" / "maps").mkdir(parents=True)
    (tmp_path / "out" / "maps" / "a.nc").write_text("old")
    (tmp_path / "out" / "maps").chmod(0o555)
    if os.access(tmp_path / "out" / "maps", os.W_OK):
        pytest.skip("this user may write everywhere")
    with atomic_folder(tmp_path / "out", names) as temporary:
        (temporary / "b.nc").write_text("new")
    assert os.listdir(tmp_path) == ["out"] and os.listdir(tmp_path / "out") == ["b.nc"]
