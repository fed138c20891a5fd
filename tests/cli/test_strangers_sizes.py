"""Strangers' files that would fill memory, disk or hours."""

import gzip
import importlib.util
import math
import shutil
import subprocess

import h5py
import numpy as np
import pytest

from tests.cli.strangers import (
    MAP,
    MAP_IN,
    SQUARE,
    SURVEY,
    Strangers,
    check_stranger,
    edit,
    forked,
    write_town,
)

pytestmark = pytest.mark.usefixtures("drawn_preview")
stranger = Strangers()
LINKS = ("time_s,flight,receiver,receiver_x_m,receiver_y_m,receiver_z_m,device,gain_db\n", "0,f,r,1,2,60,d0,-80\n")


@stranger("fit bomb.csv.gz --scene scene --model log_distance -o out", "RADIOTWIN_MAX_FILE_BYTES",
          FILE_BYTES=100 * 2**20)
def a_bomb_of_gzip(folder):
    block = gzip.compress(LINKS[1].encode() * 2**20, 9)
    (folder / "bomb.csv.gz").write_bytes(gzip.compress(LINKS[0].encode()) + block * 200)


@stranger("fit bomb.parquet --scene scene --model log_distance -o out", "RADIOTWIN_MAX_ROWS")
def a_bomb_of_parquet(folder):
    pyarrow = pytest.importorskip("pyarrow")
    parquet = pytest.importorskip("pyarrow.parquet")
    rows = 3_000_000
    part = pyarrow.table({name: pyarrow.nulls(rows, pyarrow.float64()) for name in LINKS[0].strip().split(",")})
    with parquet.ParquetWriter(folder / "bomb.parquet", part.schema) as writer:
        for _ in range(20):
            writer.write_table(part)
    assert (folder / "bomb.parquet").stat().st_size < 5e6


@stranger(MAP_IN, "map.nc.*RADIOTWIN_MAX_")
def a_sparse_map(folder):
    with h5py.File(folder / "map.nc", "r+") as file:
        for name in ("gain_db", "los", "sigma_db"):
            if name in file:
                del file[name]
        for axis, size in (("y", 60_000), ("x", 60_000)):
            del file[axis]
            file.create_dataset(axis, data=np.arange(size, dtype=float)).make_scale(axis)
        data = file.create_dataset("gain_db", (1, 1, 60_000, 60_000), "f4", chunks=(1, 1, 1000, 1000), compression="gzip")
        for number, axis in enumerate(("device", "z", "y", "x")):
            data.dims[number].attach_scale(file[axis])


@stranger(SURVEY, "RADIOTWIN_MAX_NESTING")
def a_key_of_20_000_parts(folder):
    with (folder / "scene" / "scene.toml").open("a") as file:
        file.write("\n[x]\n" + "a." * 20_000 + "b = 1\n")


@stranger(SURVEY, "RADIOTWIN_MAX_NESTING")
def lists_in_lists(folder):
    with (folder / "scene" / "scene.toml").open("a") as file:
        file.write("\n[x]\na = " + "[" * 100_000 + "]" * 100_000 + "\n")


@stranger(MAP, "RADIOTWIN_MAX_NESTING|readable")
def lists_in_lists_of_a_twin(folder):
    (folder / "twin" / "twin.json").write_text("[" * 100_000 + "]" * 100_000)


@stranger(SURVEY, "scene.toml")
def a_number_of_5_000_digits(folder):
    edit(folder / "scene" / "scene.toml", "frequency_hz = 2400000000.0", "frequency_hz = " + "9" * 5000)


@stranger("build-scene city.xml --check", "city.xml")
def defaults_that_double(folder):
    doubling = "".join(f'<default name="a{n}" value="$a{n - 1}$a{n - 1}"/>' for n in range(1, 40))
    (folder / "city.xml").write_text(f'<scene version="2.1.0"><default name="a0" value="xxxxxxxx"/>{doubling}<shape type="cube" '
                                     'id="$a39"/></scene>')


@stranger("fit wide.csv --scene scene --model log_distance -o out", "RADIOTWIN_MAX_COLUMNS")
def names_of_100_000_columns(folder):
    columns = [*LINKS[0].strip().split(","), *(f"c{number}" for number in range(100_000))]
    (folder / "wide.csv").write_text(",".join(columns) + "\n" + ",".join("1" for _ in columns) + "\n")


@stranger("export-scene scene -o out.obj", "", status=0)
def devices_by_the_ten_thousand(folder):
    with (folder / "scene" / "scene.toml").open("a") as file:
        for number in range(20_000):
            file.write(f'\n[[devices]]\ndevice = "n{number}"\nx_m = {number % 300}.0\ny_m = 1.0\nz_m = 1.5\nrole = "anchor"\n')


@stranger("build-scene town.geojson --check", "RADIOTWIN_MAX_CROSSINGS", CROSSINGS=1000)
def a_star_of_6_000_points(folder):
    points = [[8.5 + 1e-3 * math.cos(2 * math.pi * 3000 * n / 6001), 47.4 + 1e-3 * math.sin(2 * math.pi * 3000 * n / 6001)]
              for n in range(6001)]
    write_town(folder / "town.geojson", [*points, points[0]])


@stranger("build-scene town.geojson --check", "RADIOTWIN_MAX_PART_PAIRS")
def equal_buildings(folder):
    write_town(folder / "town.geojson", *[SQUARE] * 1500)


@stranger("build-scene town.geojson --uavs 1000000000 -o out", "RADIOTWIN_MAX_UAVS")
def a_thousand_million_uavs(folder):
    write_town(folder / "town.geojson", SQUARE)


@pytest.mark.parametrize(*stranger.cases)
def test_a_stranger(run, strangers_folder, monkeypatch, prepare, command, message, status, limits):
    check_stranger(run, strangers_folder, monkeypatch, prepare, command, message, status, limits)


@pytest.mark.parametrize("suffix", [".tif", ".nc"])
def test_a_full_disk(run, strangers_folder, tmp_path, suffix):
    folder = strangers_folder
    if suffix == ".tif" and importlib.util.find_spec("rasterio") is None:
        pytest.skip("GeoTIFF needs rasterio")
    edit(folder / "scene" / "scene.toml", "[mission]", "[origin]\nlatitude_deg = 47.5\nlongitude_deg = 8.7\n[mission]")
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = shutil.which("mount")
    if mount is None or subprocess.run([mount, "-t", "tmpfs", "-o", "size=16k", "tmpfs", str(disk)],
                                       capture_output=True).returncode:
        pytest.skip("no file system can be mounted here")
    try:
        (disk / f"o{suffix}").write_text("an older result")
        found, said = forked(run, f"map twin --scene scene -o {disk}/o{suffix} --force", folder)
        assert found == 1 and "Traceback" not in said and "No space left" in " ".join(said.split()), (found, said)
        assert [path.name for path in disk.iterdir()] == [f"o{suffix}"]
        assert (disk / f"o{suffix}").read_text() == "an older result"
    finally:
        subprocess.run(["umount", "--lazy", str(disk)], check=True)
