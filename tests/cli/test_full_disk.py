"""A full disk: every command that writes says so in one message, keeps the old output, and leaves nothing else.

Where the machine allows no mount (only root may), the tests of `tests/io/test_files.py`, whose writes fail, remain.
"""

import os
import shlex
import shutil
import subprocess
from pathlib import Path

import pytest

from radiotwin.maps.export import EXPORTERS
from radiotwin.maps.survey import fly_survey
from tests.command_line import run_planning
from tests.worlds import placed

DISK_BYTES = 1024 * 1024
IMPORT = """length_unit = "m"
level_unit = "dB"
[columns]
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
    """A file system of 1 MiB."""
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
    placed(small_scene).save(folder / "scene")
    fly_survey(small_scene, "segmented", flights=2, seed=0).save(folder / "m.csv")
    assert run("fit m.csv --scene scene --model log_distance -o twin", folder).returncode == 0
    (folder / "import.toml").write_text(IMPORT)
    stored = Path(__file__).parents[1] / "twin" / "stored"
    shutil.copytree(stored / "corrected", folder / "corrected")
    (folder / "links").mkdir()
    shutil.copy(stored / "links" / "measurements.csv", folder / "links")
    first, *others = (stored / "links" / "devices.csv").read_text().splitlines()
    lost = f"{others[-1].split(',')[0]},,,1.5,unknown,2400000000.0"
    (folder / "links" / "devices.csv").write_text("\n".join([first, *others[:-1], lost, ""]))
    (folder / "points.csv").write_text("x_m,y_m,z_m\n" + "80,60,30\n" * 50)
    return folder


def fill(disk, free, *names):
    """Empty the disk, write old files, and leave some bytes free."""
    for path in disk.iterdir():
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    (disk / "filler").touch()  # what is written into a folder that exists takes room as well
    for name in {"old.csv", "old.nc", *names}:
        (disk / name).parent.mkdir(exist_ok=True)
        (disk / name).write_bytes(OLD)
    with open(disk / "filler", "wb", buffering=0) as file:
        with pytest.raises(OSError, match="No space left"):  # not for want of memory, which may come back
            while True:
                file.write(bytes(4096))
    if free:
        os.truncate(disk / "filler", (disk / "filler").stat().st_size - free)


def content(disk):
    return {str(path.relative_to(disk)): path.read_bytes() if path.is_file() else None for path in disk.rglob("*")}


def assert_says_so(result):
    """One message and no other word of success or of Python, and status 1."""
    message = " ".join(result.stderr.split())
    assert result.returncode == 1 and "No space left on device" in message, (result.returncode, result.stderr)
    assert "unchanged" in message or "are kept" in message
    notes, last = result.stderr.splitlines()[:-1], result.stderr.splitlines()[-1]
    said = ("warning: ", "note: ", "radiotwin: ")  # of a slow machine: parts kept, and what is done after so many seconds
    assert last.startswith("radiotwin: ") and all(note.startswith(said) for note in notes), result.stderr
    assert message.count("No space left") == 1
    assert "wrote" not in result.stdout and "look at" not in result.stdout


def assert_all_is_whole(disk):
    """Of the files of a folder that is filled bit by bit those are whole that had room."""
    assert not [path for path in disk.rglob("*") if ".radiotwin-" in path.name]
    assert all(path.stat().st_size for path in disk.rglob("*") if path.is_file() and "tfevents" not in path.name)


COMMANDS = [
    "build-scene preset:small -o {disk}/new",
    "survey scene --truth segmented -o {disk}/new/m.csv", "survey scene --truth segmented -o {disk}/new/m.parquet",
    "survey scene --truth segmented -o {disk}/new/m.csv.gz",
    "import m.csv --devices devices.csv --columns import.toml -o {disk}/new", "fit m.csv --scene scene --model log_distance -o {disk}/new",
    *(f"map twin --scene scene --force -o {{disk}}/{name}" for name in ("new.zarr", *(f"old{suffix}" for suffix in (*EXPORTERS, ".png") if suffix != ".zarr"))),
    *(f"export-scene scene --force -o {{disk}}/{name}" for name in ("new", "old.glb", "old.gltf", "old.obj")),
    "report twin --scene scene --force -o {disk}/old.html", "locate links/measurements.csv --twin corrected --force -o {disk}/old.csv",
    "plan twin --scene scene --iterations 50 --worlds 20 -o {disk}/new",
    "coverage scene --tx-power-dbm 20 --step 20 -o {disk}/new", "demo -o {disk}/new", "trace scene --force -o {disk}/old.nc",
    *(f"gains scene --points points.csv --force -o {{disk}}/{name}" for name in ("old.csv", "old.csv.gz")),
]


@pytest.mark.parametrize("command", COMMANDS)
def test_the_old_output_stays(run, disk, inputs, traced, command):
    """With a page of room; with none if the output fits into a page."""
    out = command.rpartition("/")[2]
    for free in (4096, 0):
        fill(disk, free, *[out] * out.startswith("old"))
        before = content(disk)
        result = run(command.format(disk=disk), inputs)
        if result.returncode:
            break
    assert_says_so(result)
    assert content(disk) == before, result.stderr


@pytest.mark.slow
@pytest.mark.parametrize("command, names", [
    ("compare m.csv --scene scene -o {disk}/run", ("compare.json", "scatter.png", "predictions.csv.gz")),
    ("close-loop m.csv --scene scene --base log-distance -o {disk}/run", ("closeloop.json", "closeloop.html", "effect_3_foliage.png"))])
def test_an_older_folder_stays_as_a_whole(run, disk, inputs, command, names):
    fill(disk, 24 * 1024, *(f"run/{name}" for name in (*names, "notes.txt")))
    before = content(disk)
    assert_says_so(run(command.format(disk=disk), inputs))
    assert content(disk) == before


PLANNED = ("config.json", "twin", "checkpoint.safetensors", "metrics.csv", "tensorboard", "comparison.csv", "curve.png",
           "flights.csv", "trajectories.png")  # in the order in which they are written


def planning(out, inputs):
    arguments = "--scene scene --truth segmented --twin log-distance --algorithm random --real-episodes 1 " \
                f"--planner-iterations 50 --flights 2 --out {out}"
    return run_planning(shlex.split(arguments), inputs)


@pytest.fixture(scope="module")
def room(inputs):
    """Name -> bytes of the pages of all that is written before it."""
    assert planning("whole", inputs).returncode == 0
    pages = [sum(-(-path.stat().st_size // 4096) for path in [inputs / "whole" / name, *(inputs / "whole" / name).glob("*")]
                 if path.is_file()) for name in PLANNED]
    return {name: 4096 * sum(pages[:number]) for number, name in enumerate(PLANNED)}


@pytest.mark.parametrize("name", PLANNED)
def test_planning(disk, inputs, room, name):
    fill(disk, room[name])
    result = planning(disk / "new", inputs)
    assert_says_so(result)
    assert f"cannot write {disk}/new/{name}" in result.stderr
    assert_all_is_whole(disk)


def test_a_map_in_a_process_of_its_own_ends_as_it_should(run_installed, disk, inputs):
    """HDF5 crashed when Python ended."""
    fill(disk, 4096)
    result = run_installed(f"map twin --scene scene --force -o {disk}/old.nc", inputs)
    assert result.returncode == 1 and "No space left" in result.stderr, (result.returncode, result.stderr)
    assert (disk / "old.nc").read_bytes() == OLD


def test_the_demo_stops_at_the_step_that_has_no_room(run, disk, inputs, traced):
    fill(disk, 120 * 1024)
    assert_says_so(run(f"demo -o {disk}/new", inputs))
    assert_all_is_whole(disk)
