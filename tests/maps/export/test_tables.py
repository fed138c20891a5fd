"""Every format with numbers, read back by other programs: the same numbers to the bit."""

import numpy as np
import pandas as pd
import pytest
import xarray as xr
from pyproj import CRS

from radiotwin.errors import BadInput
from radiotwin.geo import local_crs
from radiotwin.maps.export import EXPORTERS, check_format, select
from radiotwin.maps.radiomap import RadioMap


def test_netcdf_follows_the_conventions(radio_map, scene, small_scene, tmp_path):
    path = tmp_path / "map.nc"
    EXPORTERS[".nc"](radio_map, scene, path)
    with xr.open_dataset(path) as dataset:
        np.testing.assert_array_equal(dataset["gain_db"].values, radio_map.gain_db)
        assert dataset.attrs["Conventions"].startswith("CF-")
        assert {name: dataset[name].attrs["axis"] for name in "xyz"} == {"x": "X", "y": "Y", "z": "Z"}
        assert dataset["z"].attrs["positive"] == "up" and all(dataset[name].attrs["units"] == "m" for name in "xyz")
        assert all(dataset[name].attrs["units"] == "dB" for name in ("gain_db", "sigma_db"))
        mapping = dataset[dataset["gain_db"].attrs["grid_mapping"]]
        assert CRS.from_cf(mapping.attrs).equals(CRS(local_crs(scene.config.origin)), ignore_axis_order=True)
        assert "_FillValue" not in dataset["x"].encoding and np.isnan(dataset["gain_db"].encoding["_FillValue"])
    again = RadioMap.load(path)
    assert again.dataset.attrs["origin_latitude_deg"] == 47.5 and set(again.dataset.data_vars) == {
        "gain_db", "los", "sigma_db"}
    again.save(tmp_path / "again.nc")
    xr.testing.assert_identical(RadioMap.load(tmp_path / "again.nc").dataset, again.dataset)
    EXPORTERS[".nc"](radio_map, small_scene, tmp_path / "nowhere.nc")  # without an origin
    with xr.open_dataset(tmp_path / "nowhere.nc") as dataset:
        assert "grid_mapping" not in dataset["gain_db"].attrs and "crs" not in dataset


def test_csv(radio_map, scene, tmp_path):
    EXPORTERS[".csv"](radio_map, scene, tmp_path / "map.csv")
    table = pd.read_csv(tmp_path / "map.csv")
    assert list(table.columns) == ["device", "x_m", "y_m", "z_m", "gain_db", "los", "sigma_db"]
    for row in table.itertuples():
        value = radio_map.dataset["gain_db"].sel(device=row.device, x=row.x_m, y=row.y_m, z=row.z_m).item()
        assert np.float32(row.gain_db) == value or (np.isnan(row.gain_db) and np.isnan(value))
    assert table["gain_db"].isna().sum() == 1 and len(table) == radio_map.gain_db.size


def test_numpy(radio_map, scene, tmp_path):
    EXPORTERS[".npz"](radio_map, scene, tmp_path / "map.npz")
    with np.load(tmp_path / "map.npz", allow_pickle=False) as arrays:
        assert arrays["device"].tolist() == ["d0", "d1"] and arrays["z_m"].tolist() == [50, 60]
        for name in ("gain_db", "los", "sigma_db"):
            np.testing.assert_array_equal(arrays[name], radio_map.dataset[name].values)
        np.testing.assert_array_equal(arrays["x_m"], radio_map.lattice.x_m)


def test_a_part_of_a_map(radio_map):
    part = select(radio_map, ["d1"], [60.0])
    assert part.devices == ["d1"] and part.lattice.z_m.tolist() == [60]
    np.testing.assert_array_equal(part.gain_db, radio_map.gain_db[1:, 1:])
    assert select(radio_map, ["d1", "d0", "d1"], None).devices == ["d1", "d0"]
    assert select(radio_map, None, None).dataset.identical(radio_map.dataset)


@pytest.mark.parametrize(("devices", "altitudes_m", "message"), [
    (["d7"], None, "device 'd7' is not in the map; it has d0, d1"),
    (None, [55.0], "altitude 55 m is not in the map; it has 50, 60 m")])
def test_no_such_part(radio_map, devices, altitudes_m, message):
    with pytest.raises(BadInput, match=message):
        select(radio_map, devices, altitudes_m)


def test_names_of_files(scene, small_scene, tmp_path):
    with pytest.raises(BadInput, match=r"unknown format '.xlsx'; allowed are .nc, .zarr, .csv, .npz, .tif, .kmz, .png"):
        check_format(tmp_path / "map.xlsx", scene, [*EXPORTERS, ".png"])
    with pytest.raises(BadInput, match=r"has no \[origin\]; add one"):
        check_format(tmp_path / "map.kmz", small_scene)
    check_format(tmp_path / "map.kmz", scene)
