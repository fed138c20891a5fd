"""Radio maps as Zarr: the same map as in NetCDF, in parts, and refused where a stranger's folder is not one."""

import gzip
import json
import os
import shutil
import warnings

import numpy as np
import pytest
import xarray as xr

from radiotwin.errors import BadInput
from radiotwin.maps.file import BLOCK_VALUES, write_parts
from radiotwin.maps.radiomap import RadioMap
from radiotwin.report import export_map
from tests.maps.conftest import DTYPES, small_map

zarr = pytest.importorskip("zarr", reason="the package zarr is not installed")


def example(ground=False):
    return small_map(ground, origin_latitude_deg=47.5, origin_longitude_deg=8.7, seed=3, noise_floor_db=float("nan"),
                     bounds_m=np.array([0.0, 40.0]), source="tést")


@pytest.fixture
def folder(tmp_path):
    example().save(tmp_path / "map.zarr")
    return tmp_path / "map.zarr"


def edit(path, **changes):
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


@pytest.mark.parametrize("ground", [False, True])
def test_zarr_and_netcdf_hold_the_same(tmp_path, ground):
    for name in ("map.nc", "map.zarr"):
        example(ground).save(tmp_path / name)
    ours, theirs = (RadioMap.load(tmp_path / name).dataset for name in ("map.zarr", "map.nc"))
    xr.testing.assert_identical(ours, theirs)
    xr.testing.assert_identical(ours, example(ground).dataset)
    assert ours["los"].dtype == bool and ours["gain_db"].dtype == np.float32
    with RadioMap.open(tmp_path / "map.zarr") as opened:
        opened.save(tmp_path / "again.nc")
        assert not opened.dataset["gain_db"].variable._in_memory
    xr.testing.assert_identical(RadioMap.load(tmp_path / "again.nc").dataset, theirs)
    with RadioMap.open(tmp_path / "again.nc") as opened:
        assert not opened.dataset["los"].variable._in_memory and opened.devices == ["a", "bé"]
        xr.testing.assert_identical(opened.dataset.load(), theirs)


def test_others_read_it_with_units_reference_system_and_dask(folder):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", zarr.errors.UnstableSpecificationWarning)
        dataset = xr.open_zarr(folder, consolidated=False, chunks={})
    assert dataset["gain_db"].chunks == ((1, 1), (2,), (2,), (3,))
    assert dataset["gain_db"].attrs["units"] == "dB" and dataset["x"].attrs["axis"] == "X"
    assert dataset["crs"].attrs["latitude_of_projection_origin"] == 47.5
    assert float(dataset["gain_db"].sel(device="bé", x=0, y=0, z=50).compute()) == -12


def test_a_large_map_is_written_a_block_a_piece(tmp_path, large_stream):
    stream, made = large_stream
    write_parts(stream.header, DTYPES, stream.blocks(), tmp_path / "map.zarr")
    pieces = [path for path in (tmp_path / "map.zarr" / "gain_db" / "c").rglob("*") if path.is_file()]
    assert len(pieces) == len(made) > 3 and max(map(np.prod, made)) <= BLOCK_VALUES
    xr.testing.assert_identical(RadioMap.load(tmp_path / "map.zarr").dataset, RadioMap.collect(stream).dataset)


def test_the_size_is_said_before_a_large_map_is_written(small_scene, tmp_path, monkeypatch):
    lattice, said = small_scene.lattice, []
    gain_db = np.full((2, *lattice.shape), -80.0)
    radio_map = RadioMap.build(["a", "b"], lattice, gain_db, gain_db < 0)
    export_map(radio_map, small_scene, tmp_path / "map.zarr", tell=said.append)
    assert not said
    monkeypatch.setattr("radiotwin.report.folders.TOLD_LINKS", 100)
    export_map(radio_map, small_scene, tmp_path / "map.zarr", tell=said.append)
    links = int(np.prod(lattice.shape))
    assert f"{2 * links:,} links in 2 parts, of which one ({links:,} links) is in memory" in said[0]


def test_a_run_that_fails_leaves_the_older_map(folder):
    def broken():
        yield next(example().blocks())
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_parts(example().header, DTYPES, broken(), folder)
    assert [path.name for path in folder.parent.iterdir()] == ["map.zarr"]
    xr.testing.assert_identical(RadioMap.load(folder).dataset, example().dataset)


def test_a_folder_with_other_things_is_not_replaced(tmp_path):
    (tmp_path / "map.zarr").mkdir()
    (tmp_path / "map.zarr" / "diary.txt").write_text("dear")
    with pytest.raises(BadInput, match="holds diary.txt, and no zarr.json of an earlier run"):
        example().save(tmp_path / "map.zarr")
    assert (tmp_path / "map.zarr" / "diary.txt").read_text() == "dear"
    with pytest.raises(BadInput, match="no part of a radio map"):
        RadioMap.load(tmp_path / "map.zarr")
    (tmp_path / "file.zarr").touch()
    with pytest.raises(BadInput, match="is a file; give the name of a folder"):
        example().save(tmp_path / "file.zarr")


def piece(folder):
    return folder / "gain_db" / "c" / "0" / "0" / "0" / "0"


def zstd_bomb(folder):
    """A frame of a few bytes that declares, and holds, a gigabyte of zeros."""
    block = (2**17 << 3 | 1 << 1).to_bytes(3, "little") + b"\0"
    last = (2**17 << 3 | 1 << 1 | 1).to_bytes(3, "little") + b"\0"
    piece(folder).write_bytes(b"\x28\xb5\x2f\xfd\xa0" + (2**30).to_bytes(4, "little") + block * (2**13 - 1) + last)


def two_frames(folder):
    piece(folder).write_bytes(piece(folder).read_bytes() * 2)


def gzip_bomb(folder):
    edit(folder / "gain_db" / "zarr.json", codecs=[{"name": "bytes", "configuration": {"endian": "little"}},
                                                   {"name": "gzip", "configuration": {"level": 5}}])
    for path in (folder / "gain_db" / "c").rglob("0"):
        if path.is_file():
            path.write_bytes(gzip.compress(bytes(48)))
    piece(folder).write_bytes(gzip.compress(bytes(10**5)))


def link_out(folder):
    shutil.copy(piece(folder), folder.parent / "elsewhere")
    piece(folder).unlink()
    piece(folder).symlink_to(folder.parent / "elsewhere")


def linked_array(folder):
    (folder / "gain_db").rename(folder.parent / "gain_db")
    (folder / "gain_db").symlink_to(folder.parent / "gain_db")


def pipe(folder):
    piece(folder).unlink()
    os.mkfifo(piece(folder))


def bad_name(folder):
    described = json.loads((folder / "device" / "zarr.json").read_text())
    (folder / "device" / "c" / "0").write_bytes(b"\xff" * described["data_type"]["configuration"]["length_bytes"] * 2)
    edit(folder / "device" / "zarr.json", codecs=[{"name": "bytes", "configuration": {"endian": "little"}}])


def array(**changes):
    return lambda folder: edit(folder / "gain_db" / "zarr.json", **changes)


def codecs(*names):
    return array(codecs=[{"name": name, "configuration": {}} for name in names])


@pytest.mark.parametrize(("change", "message"), [
    (lambda f: (f / "zarr.json").unlink(), "has no zarr.json"),
    (lambda f: (f / "zarr.json").write_text("{"), "not readable JSON"),
    (lambda f: edit(f / "zarr.json", zarr_format=2), "does not describe a Zarr group of format 3"),
    (lambda f: (f / ".zgroup").write_text("{}"), "of Zarr format 2"),
    (lambda f: (f / "refs.json").write_text("{}"), "holds 'refs.json', which is no part"),
    (lambda f: (f / "gain_db" / "c" / "9").mkdir(), "holds '9', which is no piece"),
    (lambda f: (f / "gain_db" / "c" / "..x").mkdir(), "which is no piece"),
    (codecs("bytes", "blosc"), "stored by the codecs"),
    (codecs("sharding_indexed"), "stored by the codecs"),
    (codecs("vlen-utf8"), "stored by the codecs"),
    (codecs("numcodecs.pickle"), "stored by the codecs"),
    (codecs("bytes", "zstd", "zstd"), "stored by the codecs"),
    (array(data_type="string"), "values of the type 'string'"),
    (array(data_type={"name": "numpy.object"}), "values of the type"),
    (array(shape=[2, 2, 2, -1]), "is damaged"),
    (array(shape=[2, 2, 2, 10**30]), "RADIOTWIN_MAX_MAP_STREAM_VALUES"),
    (array(chunk_grid={"name": "regular", "configuration": {"chunk_shape": [2**10] * 4}}), "RADIOTWIN_MAX_MAP_PIECE_BYTES"),
    (array(shape=[1000, 1000, 100, 100], chunk_grid={"name": "regular", "configuration": {"chunk_shape": [1, 1, 1, 1]}}),
     "RADIOTWIN_MAX_MAP_CHUNKS"),
    (array(chunk_grid={"name": "rectangular"}), "not cut into equal pieces"),
    (array(storage_transformers=[{"name": "x"}]), "not cut into equal pieces"),
    (array(chunk_key_encoding={"name": "v2"}), "otherwise than c/0/0"),
    (array(attributes={str(i): i for i in range(2000)}), "RADIOTWIN_MAX_MAP_ATTRIBUTES"),
    (lambda f: piece(f).write_bytes(b"\x28\xb5\x2f\xfd"), "is damaged, or another size"),
    (zstd_bomb, "is damaged, or another size"),
    (gzip_bomb, "is damaged, or another size"),
    (two_frames, "not a readable Zarr folder"),
    (link_out, "is a link"),
    (linked_array, "is a link"),
    (pipe, "is a link, a pipe or a device"),
    (bad_name, "not a readable Zarr folder"),
    (lambda f: shutil.rmtree(f / "los"), "lacks los"),
    (lambda f: (f / "x" / "c" / "0").unlink(), "lacks 1 of 1 pieces, which would stand for a number"),
    (lambda f: (shutil.rmtree(f / "x" / "c"), (f / "x" / "c").write_text("")), "not a readable Zarr folder"),
])
def test_what_a_stranger_must_not_do_is_refused(folder, change, message):
    change(folder)
    with pytest.raises(BadInput, match=message):
        RadioMap.load(folder)


def test_values_no_link_has_are_found_in_any_part(folder):
    zarr.open_group(folder, mode="r+")["gain_db"][1, 1, 1, 2] = 1000
    with pytest.raises(BadInput, match="gain_db goes from .* to 1000 dB"), RadioMap.open(folder):
        pass


def test_pieces_that_are_not_there_are_not_detected_and_it_is_said(folder):
    piece(folder).unlink()
    with pytest.warns(UserWarning, match=r"lacks 1 pieces of its arrays \(gain_db\)"):
        found = RadioMap.load(folder)
    assert np.isnan(found.gain_db[0]).all() and np.isfinite(found.gain_db[1, 1]).all()


def test_others_standard_codecs_are_read(tmp_path):
    dataset = example().dataset.drop_attrs(deep=False)
    dataset["device"] = dataset["device"].astype(str)
    codec = {"compressors": [zarr.codecs.GzipCodec(), zarr.codecs.Crc32cCodec()], "chunks": (2, 1, 2, 2)}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        dataset.to_zarr(tmp_path / "map.zarr", zarr_format=3, encoding={"gain_db": codec, "los": {"compressors": None}})
    np.testing.assert_array_equal(RadioMap.load(tmp_path / "map.zarr").gain_db, example().gain_db)


def test_the_package_that_is_missing_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "zarr", None)
    with pytest.raises(BadInput, match=r"pip install 'radiotwin\[zarr\]'"):
        example().save(tmp_path / "map.zarr")
