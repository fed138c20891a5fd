"""A full disk: every command that writes says so in one message, keeps the old output, and leaves nothing else.

Where the machine allows no mount (only root may), the tests of `tests/test_files.py`, whose writes fail, remain.
"""

import contextlib
import os
import shutil
import subprocess

import numpy as np
import pytest

from radiotwin.export import EXPORTERS
from radiotwin.survey import fly_survey, segmented_truth

DISK_BYTES = 64 * 1024
IMPORT = """[columns]
level = "gain_db"
receiver = "receiver"
x = "receiver_x_m"
y = "receiver_y_m"
z = "receiver_z_m"
device = "device"
"""
OLD = b"an older result\n"


@pytest.fixture(scope="module")
def disk(tmp_path_factory):
    """A file system of 64 KiB."""
    folder = tmp_path_factory.mktemp("disk")
    options = ["-t", "tmpfs", "-o", f"size={DISK_BYTES}", "tmpfs", str(folder)]
    mount = shutil.which("mount")
    if mount is None or subprocess.run([mount, *options], capture_output=True).returncode:
        pytest.skip("no file system can be mounted here")
    yield folder
    subprocess.run(["umount", "--lazy", str(folder)], check=True)


@pytest.fixture(scope="module")
def inputs(small_scene, tmp_path_factory, run):
    """A scene with an origin, measurements, a twin of them, and a result of close-loop."""
    folder = tmp_path_factory.mktemp("inputs")
    shutil.copytree(small_scene.folder, folder / "scene", ignore=shutil.ignore_patterns("cache"))
    toml = folder / "scene" / "scene.toml"
    origin = "[origin]\nlatitude_deg = 47.5\nlongitude_deg = 8.7\n[mission]"
    toml.write_text(toml.read_text().replace("[mission]", origin))
    truth = segmented_truth(small_scene)
    fly_survey(small_scene, truth, flights=2, pattern="random-waypoint", seed=0).write(folder / "m.csv")
    assert run("fit m.csv --scene scene --model log_distance -o twin", folder).returncode == 0
    (folder / "import.toml").write_text(IMPORT)
    (folder / "points.csv").write_text("x_m,y_m,z_m\n" + "80,60,30\n" * 50)
    return folder


def fill(disk, free):
    """Empty the disk, write an old file and an old folder, and leave some bytes free."""
    for path in disk.iterdir():
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    (disk / "filler").touch()  # what is written into a folder that exists takes room as well
    for name in ("old.csv", "old.nc"):
        (disk / name).write_bytes(OLD)
    with contextlib.suppress(OSError), open(disk / "filler", "wb", buffering=0) as file:
        while file.write(bytes(4096)):
            pass
    if free:
        os.truncate(disk / "filler", (disk / "filler").stat().st_size - free)


def content(disk):
    return {str(path.relative_to(disk)): path.read_bytes() if path.is_file() else None for path in disk.rglob("*")}


COMMANDS = [
    "build-scene preset:small -o {disk}/new",
    "survey scene --truth segmented -o {disk}/new/m.csv", "survey scene --truth segmented -o {disk}/new/m.parquet",
    "survey scene --truth segmented -o {disk}/new/m.csv.gz",
    "import m.csv --devices devices.csv --columns import.toml -o {disk}/new", "fit m.csv --scene scene --model log_distance -o {disk}/new",
    *(f"map twin --scene scene -o {{disk}}/old{suffix}" for suffix in (*EXPORTERS, ".png")),
    *(f"export-scene scene -o {{disk}}/{name}" for name in ("new", "old.glb", "old.gltf", "old.obj")),
    "report twin --scene scene -o {disk}/old.html",
]


@pytest.mark.parametrize("free", [0, 4096])
@pytest.mark.parametrize("command", COMMANDS)
def test_the_old_output_stays(run, disk, inputs, command, free):
    fill(disk, free)
    out = command.rpartition("/")[2]
    if out.startswith("old"):
        (disk / out).write_bytes(OLD if free else b"")
    before = content(disk)
    result = run(command.format(disk=disk), inputs)
    if free and result.returncode == 0:
        pytest.skip("the output is so small that it had room")
    message = " ".join(result.stderr.split())
    assert result.returncode == 1 and "No space left on device" in message and "unchanged" in message, message
    assert result.stderr.count("radiotwin:") == 1 and "Traceback" not in result.stderr
    assert "wrote" not in result.stdout
    assert content(disk) == before


@pytest.mark.slow
@pytest.mark.parametrize("command", ["compare m.csv --scene scene -o {disk}/new",
                                     "close-loop m.csv --scene scene --base log-distance -o {disk}/new"])
def test_what_takes_long_says_so_in_the_end(run, disk, inputs, command):
    """Of the files in its folder those are whole that had room."""
    fill(disk, 0)
    result = run(command.format(disk=disk), inputs)
    assert result.returncode == 1 and "No space left on device" in result.stderr, result.stderr
    assert not [path for path in disk.rglob("*") if ".radiotwin-" in path.name]
    assert all(path.stat().st_size for path in disk.rglob("*") if path.is_file())


def test_a_map_in_a_process_of_its_own_ends_as_it_should(run_installed, disk, inputs):
    """HDF5 crashed when Python ended."""
    fill(disk, 4096)
    result = run_installed(f"map twin --scene scene -o {disk}/old.nc", inputs)
    assert result.returncode == 1 and "No space left" in result.stderr, (result.returncode, result.stderr)
    assert (disk / "old.nc").read_bytes() == OLD


def traced_gains(scene, device_m, points_m, *_):
    return np.full((len(device_m), len(points_m)), -80.0)


def test_gains(run, disk, inputs, monkeypatch):
    monkeypatch.setattr("radiotwin.trace.points.trace_gains", traced_gains)
    for name in ("old.csv", "old.csv.gz"):
        fill(disk, 0)
        before = content(disk)
        result = run(f"gains scene --points points.csv -o {disk}/{name}", inputs)
        assert result.returncode == 1 and "No space left on device" in result.stderr, result.stderr
        assert content(disk) == before


def test_trace(run, disk, inputs, monkeypatch):
    monkeypatch.setattr("radiotwin.trace.run.solve_lattice",
                        lambda scene, settings, store, index: np.full((len(index), scene.blocked.size), -80.0))
    monkeypatch.setattr("radiotwin.trace.run.solve_finer", lambda *_: (
        np.zeros((1, 1), int), np.arange(1), np.full((1, 1), -80.0)))
    monkeypatch.setattr("radiotwin.trace.run.check_gains", lambda *_: {})
    monkeypatch.setattr("radiotwin.trace.run.noise_figures", lambda *_: {})
    fill(disk, 4096)
    before = content(disk)
    result = run(f"trace scene -o {disk}/old.nc", inputs)
    assert result.returncode == 1 and "No space left on device" in result.stderr, result.stderr
    assert content(disk) == before
