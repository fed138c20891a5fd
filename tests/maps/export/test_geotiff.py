import numpy as np
import pytest
import rasterio
from pyproj import CRS, Transformer

from radiotwin.errors import BadInput, RunFailed
from radiotwin.geo import to_geographic
from radiotwin.maps.export.geotiff import write_geotiff
from radiotwin.maps.export.tables import write_csv
from radiotwin.maps.radiomap import RadioMap
from radiotwin.scene.lattice import Lattice


@pytest.fixture
def file(radio_map, scene, tmp_path):
    write_geotiff(radio_map, scene, tmp_path / "map.tif")
    with rasterio.open(tmp_path / "map.tif") as file:
        yield file


def test_a_band_for_each_device_and_altitude(file, radio_map):
    assert file.descriptions == ("d0 at 50 m", "d0 at 60 m", "d1 at 50 m", "d1 at 60 m")
    assert file.units == ("dB",) * 4 and set(file.dtypes) == {"float32"}
    assert file.tags(3) == {"device": "d1", "z_m": "50"} and file.tags()["source"] == "test"
    assert np.isnan(file.nodata)
    masked = file.read(3, masked=True)
    assert masked.mask.sum() == 1 and masked.mask[0, 3]  # y = 40 m is the first row, x = 60 m the last column
    np.testing.assert_array_equal(file.read(), radio_map.gain_db.reshape(4, 3, 4)[:, ::-1])


def test_values_lie_at_their_position_on_the_globe(file, radio_map, scene):
    """A GIS asks by longitude and latitude: through the file's own reference system to row and column."""
    to_file = Transformer.from_crs("EPSG:4326", CRS.from_wkt(file.crs.to_wkt()), always_xy=True)
    for x_m, y_m in ((0.0, 0.0), (60.0, 40.0), (20.0, 40.0)):
        longitude, latitude = to_geographic(scene.config.origin, [x_m], [y_m])
        (values,) = file.sample([to_file.transform(longitude[0], latitude[0])])
        np.testing.assert_array_equal(
            values, radio_map.dataset["gain_db"].sel(x=x_m, y=y_m).values.ravel())


def test_without_an_origin_coordinates_are_local(radio_map, small_scene, tmp_path):
    write_geotiff(radio_map, small_scene, tmp_path / "map.tif")
    with rasterio.open(tmp_path / "map.tif") as file:
        assert file.crs is None and file.bounds == (-10, -10, 70, 50)


def test_uneven_positions_make_no_picture(scene, tmp_path):
    lattice = Lattice(np.array([0.0, 1.0, 3.0]), np.array([0.0, 1.0]), np.array([50.0]))
    radio_map = RadioMap.build(["d0"], lattice, np.zeros((1, 6)), np.zeros((1, 6)))
    with pytest.raises(BadInput, match="not equally far apart"):
        write_geotiff(radio_map, scene, tmp_path / "map.tif")
    assert not list(tmp_path.iterdir())


def test_a_large_map_is_written_in_parts(scene, tmp_path, monkeypatch):
    monkeypatch.setattr("radiotwin.maps.export.geotiff._WHOLE_VALUES", 1000)
    monkeypatch.setattr("radiotwin.maps.file.BLOCK_VALUES", 700)
    gain_db = np.random.default_rng(0).uniform(-120, -60, (2, 2, 50, 90)).astype(np.float32)
    lattice = Lattice(np.arange(90.0), np.arange(50.0), np.array([50.0, 60.0]))
    radio_map = RadioMap.build(["d0", "d1"], lattice, gain_db, gain_db > -80)
    write_geotiff(radio_map, scene, tmp_path / "map.tif")
    with rasterio.open(tmp_path / "map.tif") as file:
        np.testing.assert_array_equal(file.read(), gain_db.reshape(4, 50, 90)[:, ::-1])
        assert file.interleaving.value == "BAND" and file.descriptions[3] == "d1 at 60 m"
    many = RadioMap.build([f"d{i}" for i in range(70_000)], Lattice.over(0, 0, 0, 0, 20, [50]),
                          np.zeros((70_000, 1)), np.ones((70_000, 1)))
    with pytest.raises(BadInput, match="at most 65,535 bands, and the map has 70,000"):
        write_geotiff(many, scene, tmp_path / "many.tif")


def test_a_large_file_that_is_not_what_was_written_is_not_kept(radio_map, scene, tmp_path, monkeypatch):
    """As on a full disk, of which GDAL says nothing."""
    sums = iter(range(1000))
    monkeypatch.setattr("radiotwin.maps.export.geotiff._WHOLE_VALUES", 0)
    monkeypatch.setattr("radiotwin.maps.export.geotiff.zlib.crc32", lambda data: next(sums))
    with pytest.raises(RunFailed, match="cannot write .*map.tif"):
        write_geotiff(radio_map, scene, tmp_path / "map.tif")
    assert not list(tmp_path.iterdir())


def test_a_large_table_is_written_in_parts(radio_map, scene, tmp_path, monkeypatch):
    write_csv(radio_map, scene, tmp_path / "whole.csv")
    monkeypatch.setattr("radiotwin.maps.file.BLOCK_VALUES", 3)
    write_csv(radio_map, scene, tmp_path / "parts.csv")
    assert (tmp_path / "parts.csv").read_bytes() == (tmp_path / "whole.csv").read_bytes()
