"""Radio maps of strangers: what an HDF5 file may hold is decided before a value is read."""

import tracemalloc
import zlib

import h5py
import numpy as np
import pytest
import xarray as xr

from radiotwin.errors import BadInput
from radiotwin.maps.radiomap import RadioMap
from radiotwin.scene.lattice import Lattice

LATTICE = Lattice.over(0, 40, 0, 20, 20, [50, 60])


@pytest.fixture
def path(tmp_path):
    gain_db = -np.arange(24, dtype=float).reshape(2, 2, 2, 3)
    RadioMap.build(["a", "b"], LATTICE, gain_db, gain_db > -10).save(tmp_path / "map.nc")
    return tmp_path / "map.nc"


def virtual(file, folder):
    layout = h5py.VirtualLayout((2, 2, 2, 3), "f4")
    layout[:] = h5py.VirtualSource(str(folder / "secret.nc"), "gain_db", (2, 2, 2, 3))
    file.create_virtual_dataset("gain_db", layout)


def two_deflates(file, folder):
    plan = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    plan.set_chunk((1, 1, 2, 3))
    plan.set_deflate(9)
    plan.set_filter(h5py.h5z.FILTER_DEFLATE, 0, (9,))
    h5py.h5d.create(file.id, b"gain_db", h5py.h5t.NATIVE_FLOAT, h5py.h5s.create_simple((2, 2, 2, 3)), plan)


def inflating_piece(file, folder):
    gain = gains(file, chunks=(2, 2, 2, 3), compression="gzip")
    packer = zlib.compressobj(9)
    data = b"".join(packer.compress(bytes(2**20)) for _ in range(8)) + packer.flush()
    gain.id.write_direct_chunk((0, 0, 0, 0), data)


def gains(file, shape=(2, 2, 2, 3), **how):
    return file.create_dataset("gain_db", shape, "f4", **how)


def numbers(make, count):
    for number in range(count):
        make(f"a{number}", number)


HOSTILE = {  # name -> array that is removed first, what is done to the file, and words of the message
    "external link": ("gain_db", lambda file, _: file.__setitem__("gain_db", h5py.ExternalLink("secret.nc", "gain_db")), "'gain_db' is a link"),
    "soft link": ("gain_db", lambda file, _: file.__setitem__("gain_db", h5py.SoftLink("/los")), "'gain_db' is a link"),
    "external storage": ("gain_db", lambda file, folder: gains(file, external=[(folder / "secret.bin", 0, 96)]), "from other files"),
    "virtual": ("gain_db", virtual, "takes its values from other files"),
    "another filter": ("gain_db", lambda file, _: gains(file, chunks=(1, 1, 2, 3), compression="lzf"), "other filters"),
    "two deflates": ("gain_db", two_deflates, "other filters"),
    "group": (None, lambda file, _: file.create_group("more"), "'more' is not an array"),
    "compound": (None, lambda file, _: file.create_dataset("more", (2,), np.dtype([("a", "f4"), ("b", "i4")])), "neither numbers nor texts"),
    "reference": (None, lambda file, _: file.create_dataset("more", (2,), h5py.ref_dtype), "neither numbers nor texts"),
    "reference attribute": (None, lambda file, _: file.attrs.__setitem__("more", file["los"].ref), "neither a number nor a text"),
    "sparse": ("gain_db", lambda file, _: gains(file, (1, 1, 60_000, 60_000), chunks=(1, 1, 1000, 1000), compression="gzip"),
               "3,600,000,000 values.*RADIOTWIN_MAX_MAP_VALUES"),
    "many pieces": ("gain_db", lambda file, _: gains(file, (1, 1, 20_000, 20_000), chunks=(1, 1, 1, 1)),
                    "400,000,000 pieces.*RADIOTWIN_MAX_MAP_CHUNKS"),
    "wide piece": ("gain_db", lambda file, _: gains(file, chunks=(2, 2, 2, 30_000_000), maxshape=(2, 2, 2, None)),
                   "pieces of 240,000,000 values"),
    "inflating piece": ("gain_db", inflating_piece, "compressed piece larger than it is"),
    "million devices": ("device", lambda file, _: file.create_dataset("device", (1_000_000,), "S8", chunks=(1000,), compression="gzip"),
                        "readable"),
    "many attributes": (None, lambda file, _: numbers(file.attrs.__setitem__, 1200), "attributes.*RADIOTWIN_MAX_MAP_ATTRIBUTES"),
    "large attribute": (None, lambda file, _: file.attrs.create("more", "a" * 20_000_000), "its attributes.*RADIOTWIN_MAX"),
    "many objects": (None, lambda file, _: numbers(file.__setitem__, 1100), "more than 1000 objects")}


@pytest.mark.parametrize("name", HOSTILE)
def test_what_no_radio_map_has_is_refused_before_memory_is_taken(path, tmp_path, name):
    removed, change, message = HOSTILE[name]
    path.rename(tmp_path / "secret.nc")
    (tmp_path / "secret.bin").write_bytes(bytes(96))
    (tmp_path / "map.nc").write_bytes((tmp_path / "secret.nc").read_bytes())
    with h5py.File(path, "r+") as file:
        if removed is not None:  # with it, dimension scales that refer to it
            del file[removed]
        change(file, tmp_path)
    tracemalloc.start()
    try:
        with pytest.raises(BadInput, match=message):
            RadioMap.load(path)
        assert tracemalloc.get_traced_memory()[1] < 100e6
    finally:
        tracemalloc.stop()


def test_a_piece_that_swells_is_refused(path, monkeypatch):
    monkeypatch.setattr("radiotwin.io.array_stores._MAX_INFLATED", 2**16)
    with h5py.File(path, "r+") as file:
        del file["gain_db"]
        gain = file.create_dataset("gain_db", (1, 1, 100, 100), "f4", chunks=(1, 1, 100, 100), compression="gzip")
        gain.id.write_direct_chunk((0, 0, 0, 0), zlib.compress(bytes(2**22), 9))
    with pytest.raises(BadInput, match="a piece of more than 40,000 bytes when decompressed"):
        RadioMap.load(path)


def test_netcdf_of_other_writers_is_read(path, tmp_path):
    """With shuffle and fletcher32, a boolean `los`, other variables, and packed gains."""
    dataset = RadioMap.load(path).dataset
    dataset["more"] = ("t", np.arange(3.0))
    dataset.to_netcdf(tmp_path / "other.nc", engine="h5netcdf", encoding={
        "gain_db": {"dtype": "int16", "scale_factor": 0.5, "_FillValue": -9999, "zlib": True, "shuffle": True,
                    "fletcher32": True}})
    again = RadioMap.load(tmp_path / "other.nc")
    np.testing.assert_array_equal(again.gain_db, dataset["gain_db"].values)
    assert set(again.dataset.data_vars) == {"gain_db", "los"} and again.los.dtype == bool
    assert isinstance(again.dataset, xr.Dataset)
