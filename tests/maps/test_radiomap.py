"""Radio maps in memory and as files."""

import numpy as np
import pytest
import xarray as xr

from radiotwin.cli.options import open_model
from radiotwin.errors import BadInput
from radiotwin.maps.file import BLOCK_VALUES, MapStream, parts_of, write_blocks
from radiotwin.maps.radiomap import RadioMap
from radiotwin.scene.lattice import Lattice
from tests.maps.conftest import DTYPES, LATTICE, small_map


def test_a_map_comes_back_from_its_file_as_it_was(tmp_path):
    small_map().save(tmp_path / "map.nc")
    again = RadioMap.load(tmp_path / "map.nc")
    xr.testing.assert_identical(again.dataset, small_map().dataset)
    assert again.devices == ["a", "bé"]
    assert again.los.dtype == bool and again.gain_db.dtype == np.float32
    np.testing.assert_array_equal(again.lattice.positions_m, LATTICE.positions_m)


def test_a_map_whose_name_is_in_capitals(tmp_path):
    small_map().save(tmp_path / "MAP.NC")
    with open_model(tmp_path / "MAP.NC") as radio_map:
        assert radio_map.devices == ["a", "bé"]


def test_what_is_not_a_radio_map_is_bad_input(tmp_path):
    with pytest.raises(BadInput, match="does not exist"):
        RadioMap.load(tmp_path / "no.nc")
    small_map().save(tmp_path / "map.nc")
    data = (tmp_path / "map.nc").read_bytes()
    (tmp_path / "half.nc").write_bytes(data[: len(data) // 2])
    with pytest.raises(BadInput, match="not a readable NetCDF-4 file"):
        RadioMap.load(tmp_path / "half.nc")
    xr.Dataset({"t": ("x", [1.0])}).to_netcdf(tmp_path / "other.nc", engine="h5netcdf")
    with pytest.raises(BadInput, match="not a radio map"):
        RadioMap.load(tmp_path / "other.nc")


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
    (lambda d: d.assign_coords(device=["a", "b\x1b[2J"]), "device name .*cannot be printed"),
    (lambda d: d.assign_coords(device=["a", "b" * 300]), "longer than 200"),
    (lambda d: d.assign_coords(x=[0.0, 20.0, 1e308]), "coordinate x must lie within"),
    (lambda d: d.assign_coords(x=[0.0, 1e-300, 20.0]), "coordinate x must lie within .*steps of at least"),
    (lambda d: d.assign(gain_db=d["gain_db"] + 1000.0), "gain_db goes from .* to 1000 dB"),
    (lambda d: d.assign(gain_db=d["gain_db"].astype(float) - 1e308), "gain_db goes from"),
    (lambda d: d.assign(sigma_db=d["gain_db"] * 0 + 1e30), "sigma_db is above"),
    (lambda d: d.assign_attrs(frequency_hz="high"), "attribute frequency_hz is 'high', not a finite number"),
    (lambda d: d.assign_attrs(gain_limit_db=np.nan), "attribute gain_limit_db is"),
    (lambda d: d.assign_attrs(origin_latitude_deg=1e308), "origin_latitude_deg is not within 90"),
])
def test_a_part_that_is_not_as_it_must_be_is_named(tmp_path, change, message):
    dataset = change(small_map().dataset)
    for name in dataset.variables:
        dataset[name].encoding = {}
    dataset.to_netcdf(tmp_path / "map.nc", engine="h5netcdf")
    with pytest.raises(BadInput, match=f"map.nc is not a radio map: .*{message}"):
        RadioMap.load(tmp_path / "map.nc")


def test_one_position_is_a_map_too(tmp_path):
    one = Lattice.over(0, 10, 0, 10, 20, [50])
    RadioMap.build(["a"], one, np.zeros((1, 1)), np.ones((1, 1)), np.ones((1, 1))).save(tmp_path / "map.nc")
    assert RadioMap.load(tmp_path / "map.nc").lattice.shape == (1, 1, 1)


@pytest.mark.parametrize("shape", [(1, 1, 1), (2, 30, 40), (2, 700, 900), (1, 3, 500_000), (3, 1, 200_001)])
def test_parts_cover_every_position_once_in_order_and_are_small(shape):
    index, seen = np.arange(np.prod(shape)).reshape(shape), []
    for part in parts_of(shape):
        seen.append(index[part].ravel())
        assert 0 < seen[-1].size <= BLOCK_VALUES
    np.testing.assert_array_equal(np.concatenate(seen), index.ravel())


def test_a_stream_is_the_map_that_it_collects_to(tmp_path, large_stream):
    stream, made = large_stream
    write_blocks(stream.header, DTYPES, stream.blocks(), tmp_path / "stream.nc")
    assert max(np.prod(shape) for shape in made) <= BLOCK_VALUES
    again = RadioMap.load(tmp_path / "stream.nc")
    xr.testing.assert_identical(again.dataset, RadioMap.collect(stream).dataset)
    assert again.dataset["gain_db"].sel(device="b", x=200, y=100, z=50) == -57


def test_a_model_that_predicts_what_no_link_has_is_refused(tmp_path):
    stream = MapStream(["a"], LATTICE, {}, ("gain_db", "los"),
                       lambda _, part: {"gain_db": np.full(part.shape, 1e308), "los": np.ones(part.shape, bool)})
    with pytest.raises(BadInput, match="gain_db for device 'a' goes from 1e[+]308"):
        RadioMap.collect(stream)
