"""Whatever reads a table of sites says what it does not use: any column, row or sheet, in every command."""

import warnings

import numpy as np
import pytest

from radiotwin.coverage import read_transmitters
from radiotwin.errors import BadInput
from radiotwin.importing import import_files, read_settings
from radiotwin.links.measurements import read_measurements
from radiotwin.scene import Scene
from radiotwin.trace import read_points
from radiotwin.twin.locate import read_truth
from tests.coverage.conftest import write_scene

LETTERS = list("bcdfghjkmnpqrsvwxz")  # without vowels no name is near a known one


def written(path, end, first, column=None, row=None):
    lines = [f"{end},x_m,y_m,z_m", f"{first},1,2,3"] + ([f"{row},4,5,6"] if row else [])
    if column:
        lines = [f"{lines[0]},{column}", *(f"{line},7" for line in lines[1:])]
    path.write_text("\n".join(lines) + "\n")
    return path


def imported(path, tables):
    (path.parent / "log.csv").write_text("device,receiver,level\na,r,-80\n")
    columns = {name: name for name in ("device", "receiver", "level")}
    settings = read_settings(None, {"level_unit": "dBm", "columns": columns} | {name: str(file) for name, file in tables.items()})
    return import_files(path.parent / "log.csv", settings, path.parent / "out")["warnings"]


def import_devices(path, scene):
    return imported(path, {"devices": path, "receivers": written(path.parent / "other.csv", "receiver", "r")})


def import_receivers(path, scene):
    return imported(path, {"receivers": path, "devices": written(path.parent / "other.csv", "device", "a")})


def devices_of_measurements(path, scene):
    (path.parent / "links.csv").write_text("flight,receiver,receiver_x_m,receiver_y_m,receiver_z_m,device,rssi_dbm\n"
                                           "f,r,0,0,1.5,a,-80\n")
    return read_measurements(path.parent / "links.csv", path).notes


def warned(read):
    def notes(path, scene):
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            read(path, scene)
        return [str(each.message) for each in told]
    return notes


READERS = {"import --devices": ("device", "a", import_devices), "import --receivers": ("receiver", "r", import_receivers),
           "devices.csv": ("device", "a", devices_of_measurements),
           "coverage --transmitters": ("device", "a", warned(read_transmitters)),
           "locate --truth": ("device", "a", warned(lambda path, scene: read_truth(path, None))),
           "--points": ("device", "a", warned(lambda path, scene: read_points(path)))}


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scene") / "open"
    write_scene(folder)
    return Scene.load(folder)


@pytest.mark.parametrize("reader", READERS)
def test_every_reader_says_which_columns_it_does_not_use(reader, scene, tmp_path):
    end, first, read = READERS[reader]
    rng = np.random.default_rng(5)
    for _ in range(8):
        column = "".join(rng.choice(LETTERS, rng.integers(3, 15)))
        notes = read(written(tmp_path / "sites.csv", end, first, column), scene)
        assert any(f"sites.csv: column not used: {column}" in note or f", {column}" in note for note in notes), notes


@pytest.mark.parametrize("reader", READERS)
def test_every_reader_refuses_a_column_that_is_nearly_known(reader, scene, tmp_path):
    end, first, read = READERS[reader]
    with pytest.raises(BadInput, match="sites.csv: column 'azimutth_deg' is nearly a name of azimuth_deg"):
        read(written(tmp_path / "sites.csv", end, first, "azimutth_deg"), scene)


def test_sheets_that_are_not_read_are_said(tmp_path):
    openpyxl = pytest.importorskip("openpyxl")
    book = openpyxl.Workbook()
    for row in (["device", "x_m", "y_m"], ["a", 1, 2]):
        book["Sheet"].append(row)
    legend = book.create_sheet("qwrtz", 0)
    for row in (["colour", "meaning"], ["red", "bad"]):
        legend.append(row)
    book.save(tmp_path / "sites.xlsx")
    notes = imported(tmp_path / "sites.xlsx", {"devices": tmp_path / "sites.xlsx",
                                               "receivers": written(tmp_path / "other.csv", "receiver", "r")})
    assert any("qwrtz" in note for note in notes), notes
