"""Radio maps in memory and as files."""

import numpy as np
import pytest
import xarray as xr

from radiotwin.errors import BadInput
from radiotwin.radiomap import RadioMap
from radiotwin.scene.lattice import Lattice

LATTICE = Lattice.over(0, 40, 0, 20, 20, [50, 60])


def example() -> RadioMap:
    gain_db = -np.arange(2 * 2 * 2 * 3, dtype=float).reshape(2, 2, 2, 3)
    gain_db[1, 0, 1, 2] = np.nan
    return RadioMap.build(["a", "b"], LATTICE, gain_db, gain_db > -10, attributes={"frequency_hz": 2.4e9})


def test_a_map_comes_back_from_its_file_as_it_was(tmp_path):
    example().write(tmp_path / "map.nc")
    again = RadioMap.read(tmp_path / "map.nc")
    xr.testing.assert_identical(again.dataset, example().dataset)
    assert again.devices == ["a", "b"]
    assert again.los.dtype == bool and again.gain_db.dtype == np.float32
    np.testing.assert_array_equal(again.lattice.positions_m, LATTICE.positions_m)


def test_values_lie_where_the_lattice_says():
    radio_map = example()
    value = radio_map.dataset["gain_db"].sel(device="b", x=40, y=0, z=60).item()
    index = LATTICE.index_of(np.array([[40.0, 0.0, 60.0]]))[0]
    assert value == radio_map.gain_db[1].ravel()[index] == -(12 + index)


def test_units_are_in_the_file(tmp_path):
    example().write(tmp_path / "map.nc")
    with xr.open_dataset(tmp_path / "map.nc", engine="h5netcdf") as dataset:
        assert dataset["gain_db"].attrs["units"] == "dB" and dataset["x"].attrs["units"] == "m"


def test_what_is_not_a_radio_map_is_bad_input(tmp_path):
    with pytest.raises(BadInput, match="does not exist"):
        RadioMap.read(tmp_path / "no.nc")
    example().write(tmp_path / "map.nc")
    data = (tmp_path / "map.nc").read_bytes()
    (tmp_path / "half.nc").write_bytes(data[: len(data) // 2])
    with pytest.raises(BadInput, match="not a readable NetCDF-4 file"):
        RadioMap.read(tmp_path / "half.nc")
    xr.Dataset({"t": ("x", [1.0])}).to_netcdf(tmp_path / "other.nc", engine="h5netcdf")
    with pytest.raises(BadInput, match="not a radio map"):
        RadioMap.read(tmp_path / "other.nc")


@pytest.mark.parametrize(("change", "message"), [
    (lambda d: d.drop_vars("los"), "lacks los"),
    (lambda d: d.assign(los=d["los"].isel(z=0)), "los has the dims"),
    (lambda d: d.assign(los=(d["los"].dims, np.full(d["los"].shape, "yes"))), "los holds .*not numbers"),
    (lambda d: d.assign(los=d["los"] * 7), "los holds other values"),
    (lambda d: d.assign(gain_db=d["gain_db"].transpose("z", "device", "y", "x")), "gain_db has the dims"),
    (lambda d: d.assign(gain_db=(d["gain_db"].dims, np.full(d["los"].shape, "-80"))), "gain_db holds .*not numbers"),
    (lambda d: d.assign(gain_db=d["gain_db"] - np.inf), "gain_db is infinite"),
    (lambda d: d.assign(sigma_db=d["gain_db"].isel(device=0)), "sigma_db has the dims"),
    (lambda d: d.assign(sigma_db=d["gain_db"]), "sigma_db is negative"),
    (lambda d: d.drop_vars("y"), "coordinate y is missing"),
    (lambda d: d.isel(x=slice(0, 0)), "coordinate x is missing or empty"),
    (lambda d: d.assign_coords(x=[0.0, 20.0, np.nan]), "coordinate x must hold finite numbers in ascending"),
    (lambda d: d.assign_coords(x=[0.0, 20.0, 20.0]), "coordinate x must hold finite numbers in ascending"),
    (lambda d: d.assign_coords(z=["low", "high"]), "coordinate z must hold finite numbers in ascending"),
    (lambda d: d.assign_coords(device=["a", "a"]), "two devices have one name"),
])
def test_a_part_that_is_not_as_it_must_be_is_named(tmp_path, change, message):
    dataset = change(example().dataset)
    for name in dataset.variables:
        dataset[name].encoding = {}
    dataset.to_netcdf(tmp_path / "map.nc", engine="h5netcdf")
    with pytest.raises(BadInput, match=f"map.nc is not a radio map: .*{message}"):
        RadioMap.read(tmp_path / "map.nc")


def test_one_position_is_a_map_too(tmp_path):
    one = Lattice.over(0, 10, 0, 10, 20, [50])
    RadioMap.build(["a"], one, np.zeros((1, 1)), np.ones((1, 1)), np.ones((1, 1))).write(tmp_path / "map.nc")
    assert RadioMap.read(tmp_path / "map.nc").lattice.shape == (1, 1, 1)
