"""The search for libLLVM: on trees of made-up files, and on the libraries of this machine."""

import os
import subprocess
import sys

import pytest

from radiotwin.errors import RunFailed
from radiotwin.runtime import llvm


@pytest.fixture
def tree(tmp_path, monkeypatch):
    """An empty machine: nothing but the folder `lib` is searched."""
    folder = tmp_path / "lib"
    folder.mkdir()
    monkeypatch.setattr(llvm, "search_folders", lambda: [folder, tmp_path / "missing"])
    monkeypatch.setattr(llvm, "_loader_files", list)
    monkeypatch.delenv(llvm.VARIABLE, raising=False)
    return folder


@pytest.fixture
def loaded(monkeypatch):
    """Libraries of versions 18 to 20 load; gives the names of the files that were to load."""
    names = []

    def reported(path):
        names.append(path.name)
        return next(((major, 0) for major in (18, 19, 20) if str(major) in path.name), "it fails")

    monkeypatch.setattr(llvm, "reported_version", reported)
    return names


def write(folder, *names):
    for name in names:
        (folder / name).write_text("not a library")


@pytest.mark.parametrize(("name", "version"), [
    ("libLLVM-14.so.1", (14,)), ("libLLVM-14.0.6.so.1", (14, 0, 6)), ("libLLVM.so.19.1", (19, 1)), ("libLLVM-19.so", (19,)),
    ("libLLVM.20.1.dylib", (20, 1)), ("libLLVM.dylib", None), ("LLVM-C.dll", None)])
def test_version_from_name(tree, name, version):
    write(tree, name, "libLLVMCore.so", "libLLVM-17-rust-1.77.0-stable.so", "libLLVM.so.txt")
    assert llvm.find() == [llvm.Candidate(tree / name, version)]


def test_newest_first_and_each_library_once(tree):
    write(tree, "libLLVM-9.so.1", "libLLVM.so.19.1", "libLLVM-18.so")
    (tree / "libLLVM-19.so").symlink_to("libLLVM.so.19.1")
    (tree / "libLLVM.so").symlink_to("libLLVM.so.19.1")
    (tree / "libLLVM-20.so").symlink_to("gone.so")
    assert [candidate.version for candidate in llvm.find()] == [(19, 1), (18,), (9,)]


def test_newest_that_works_is_chosen(tree, loaded):
    write(tree, "libLLVM-14.so.1", "libLLVM-18.so.1", "libLLVM.so.19.1", "libLLVM.so.21.0")
    assert llvm.choose().path == tree / "libLLVM.so.19.1"
    assert loaded == ["libLLVM.so.21.0", "libLLVM.so.19.1"]


def test_old_ones_are_never_tried(tree, loaded):
    write(tree, "libLLVM-14.so.1", "libLLVM-15.so.1", "libLLVM-16.so.1")
    assert not llvm.available() and loaded == []


def test_users_own_is_the_only_choice(tree, loaded, monkeypatch, tmp_path):
    write(tree, "libLLVM-20.so")
    write(tmp_path, "libLLVM-18.so", "libLLVM-22.so")
    monkeypatch.setenv(llvm.VARIABLE, str(tmp_path / "libLLVM-18.so"))
    assert llvm.choose().path == tmp_path / "libLLVM-18.so"
    monkeypatch.setenv(llvm.VARIABLE, str(tmp_path / "libLLVM-22.so"))
    assert llvm.choose() is None
    assert f"{llvm.VARIABLE} names one that does not work" in llvm.advice()
    assert f"{tmp_path / 'libLLVM-22.so'} (version 22): it fails" in llvm.advice()
    assert "libLLVM-20.so" not in llvm.advice()


@pytest.mark.parametrize("program, said", [
    ("import os; os.abort()", "exit status -6"), ("import time; time.sleep(60)", "it did not end within 0.2 s")])
def test_library_that_aborts_or_hangs_ends_only_its_own_process(tree, monkeypatch, program, said):
    monkeypatch.setattr(llvm, "_ASK_VERSION", program)
    monkeypatch.setattr(llvm, "TIMEOUT_S", 0.2 if "sleep" in program else 60)
    assert llvm.reported_version(tree / "libLLVM-19.so") == said


def test_prepare_without_any_says_what_was_found_and_what_to_do(tree, loaded, monkeypatch):
    monkeypatch.delitem(sys.modules, "drjit", raising=False)
    write(tree, "libLLVM-14.so.1", "libLLVM-22.so")
    with pytest.raises(RunFailed) as failure:
        llvm.prepare()
    message = str(failure.value)
    assert f"{tree / 'libLLVM-14.so.1'} (version 14): too old" in message
    assert f"{tree / 'libLLVM-22.so'} (version 22): it fails" in message
    assert llvm.install_line() in message
    assert llvm.VARIABLE not in os.environ


def test_prepare_names_the_chosen_one_and_repeats(tree, loaded, monkeypatch):
    monkeypatch.delitem(sys.modules, "drjit", raising=False)
    monkeypatch.setenv(llvm.VARIABLE, "")  # so that what prepare() sets is undone after the test
    write(tree, "libLLVM-18.so", "libLLVM-19.so")
    for _ in range(2):
        llvm.prepare()
        assert os.environ[llvm.VARIABLE] == str(tree / "libLLVM-19.so")


@pytest.mark.parametrize(("system", "conda", "manager", "line"), [
    ("Linux", False, "apt-get", "apt-get install -y libllvm19  # not known there? see https://apt.llvm.org"),
    ("Linux", False, "dnf", "dnf install -y llvm-libs"),
    ("Linux", False, "", "this system's package manager has it as libLLVM, llvm or llvm-libs"),
    ("Linux", True, "apt-get", "conda install -y -c conda-forge libllvm19"), ("Darwin", False, "", "brew install llvm"),
    ("Windows", False, "", "winget install LLVM.LLVM"), ("Windows", True, "", "conda install -y -c conda-forge libllvm-c19")])
def test_install_line(monkeypatch, system, conda, manager, line):
    monkeypatch.setattr(llvm.platform, "system", lambda: system)
    monkeypatch.setattr(llvm.shutil, "which", lambda name: name if name == manager else None)
    monkeypatch.setattr(llvm.os, "geteuid", lambda: 0, raising=False)
    monkeypatch.setenv("CONDA_PREFIX", "/conda" if conda else "")
    assert llvm.install_line() == line


def run_python(program, **environment):
    return subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, env=os.environ | environment, timeout=120)


def test_drjit_imported_too_early_without_a_working_one():
    program = "import drjit; from radiotwin.runtime import llvm; llvm.prepare()"
    done = run_python(program, DRJIT_LIBLLVM_PATH="/nonexistent/libLLVM.so")
    assert "RunFailed: tracing needs libLLVM 17 or newer" in done.stderr


@pytest.mark.llvm
def test_chosen_one_runs_kernels_in_a_fresh_process():
    program = ("from radiotwin.runtime import llvm; llvm.prepare(); llvm.prepare()\n"
               "import drjit; from drjit.llvm import Float\n"
               "llvm.prepare(); print(float(drjit.sum(drjit.arange(Float, 101))[0]), drjit.detail.llvm_version()[0])")
    total, major = run_python(program).stdout.split()
    assert float(total) == 5050 and int(major) >= llvm.MIN_VERSION
