"""Values that can be read and can hardly be meant: heights of buildings, units, voids and steps of a terrain."""

import numpy as np
import pandas as pd
import pytest
import shapely

from radiotwin.errors import BadInput
from radiotwin.io.forms import Origin
from radiotwin.scene.readers import build_scene
from radiotwin.scene.readers.plausible import steep_steps, zero_voids
from radiotwin.scene.readers.terrain import read_heights
from tests.scene.readers.conftest import write_table
from tests.scene.readers.test_published_schemas import built, geojson
from tests.terrains import write_dem

ORIGIN = Origin(latitude_deg=10.0, longitude_deg=20.0)
BOX_M = (-300.0, 300.0, -200.0, 200.0)


@pytest.mark.parametrize(("heights", "more", "said"), [
    ([535.5, 541.0], {"ground": [520.0, 521.0]}, "--height-column height --ground-column ground"),
    ([650, 900], {}, "'feature 2: 900 m tall, 12 m wide'"), ([8, 12, 330], {}, "1 building(s) are taller than 300 m"),
    ([8, 12, 295], {}, "1 building(s) are taller than 300 m, or than 24 times their width"),  # 12 m wide
    ([1, 2, 2], {}, "median height of 2 m, less than a room has. If a column counts storeys, say --height-column NAME:st"),
    ([80, 90, 20], {}, "2 of 3 building(s) are taller than 60 m, more than half, as in no city"),
    ([None, None], {"floors": [120.0, 150.0]}, "If 'floors' does not count storeys, say --height-column floors"),
    ([8, 12, 30], {}, None), ([280], {}, None), ([200, 12, 9], {}, None), ([55, 58, 59], {}, None)])
def test_heights_that_no_city_has_are_told(tmp_path, heights, more, said):
    rows = [(100 * row, {"height": height} | {key: values[row] for key, values in more.items()})
            for row, height in enumerate(heights)]
    told = built(tmp_path, geojson(tmp_path, rows))[1]
    assert told == "" if said is None else said in told


@pytest.fixture
def houses_in_feet(tmp_path):
    """A house of 100 by 100 feet in a plan of New York in feet, with a height without unit."""
    area = shapely.transform(shapely.box(0, 0, 100, 100), lambda points: points + [990_000, 200_000])
    return write_table(tmp_path / "a.gpkg", [area], "EPSG:2263", HEIGHT=[100.0])


def test_heights_without_unit_in_a_plan_in_feet_are_asked_for(houses_in_feet, tmp_path):
    with pytest.raises(BadInput, match=r"plan is in feet .* 'height'; say --height-column height:ft or .* height:m"):
        build_scene(houses_in_feet, tmp_path / "out")
    for unit, top_m in (("ft", 30.48), ("m", 100.0)):
        build_scene(houses_in_feet, tmp_path / unit, height_column=f"height:{unit}")
        assert pd.read_csv(tmp_path / unit / "buildings.csv")["top_m"].tolist() == [top_m]


def test_a_terrain_without_unit_in_a_plan_in_feet_is_asked_for(tmp_path):
    rasterio = pytest.importorskip("rasterio")
    path = tmp_path / "a.tif"
    with rasterio.open(path, "w", driver="GTiff", width=40, height=40, count=1, dtype="float32", crs="EPSG:2263",
                       transform=rasterio.Affine(50, 0, 990_000, 0, -50, 202_000)) as file:
        file.write(np.full((1, 40, 40), 1000.0, dtype="float32"))
    from pyproj import Transformer

    lon, lat = Transformer.from_crs("EPSG:2263", "EPSG:4326", always_xy=True).transform(991_000, 201_000)
    origin, box_m = Origin(latitude_deg=lat, longitude_deg=lon), (-90.0, 90.0, -90.0, 90.0)
    with pytest.raises(BadInput, match="names no unit of its heights.* --terrain-unit ft or --terrain-unit m"):
        read_heights(path, origin, box_m)
    assert read_heights(path, origin, box_m, "ft").height_m.mean() == pytest.approx(1000 * 1200 / 3937)
    assert read_heights(path, origin, box_m, "m").height_m.mean() == pytest.approx(1000.0)


def test_a_unit_that_the_terrain_names_itself(tmp_path):
    path = write_dem(tmp_path / "a.tif", lambda x_m, y_m: 100.0 + 0 * x_m)
    with pytest.raises(BadInput, match="names the unit of its heights itself; leave --terrain-unit out"):
        read_heights(path, ORIGIN, BOX_M, "ft")


def plain(x_m, y_m):
    return 500.0 + 0.02 * x_m


def with_void(x_m, y_m):
    """A plain at 500 m with a hole of zeros, and with what an interpolation makes of its rim."""
    away_m = np.maximum(np.abs(x_m - 45), np.abs(y_m - 45))
    return np.select([away_m < 39, away_m < 45, away_m < 55], [0.0, 150.0, 400.0], plain(x_m, y_m))


def clipped(x_m, y_m):
    return np.where(x_m + y_m > 350, 0.0, plain(x_m, y_m))


def cliff_and_beach(x_m, y_m):
    return np.where((x_m < 0) & (y_m < 150), 0.0, np.where(x_m < 0, 0.2 * (y_m - 150), 200.0))


@pytest.mark.parametrize(("height", "nodata", "are_void", "note"), [
    (with_void, None, True, "121 pixel(s) are 0 amid heights that are not"), (clipped, None, True, "are 0 amid"),
    # Where the file declares another value as no data, zeros are heights
    (with_void, -9999.0, False, "falls by up to 250 m between neighbouring pixels 10 m apart"),
    (lambda x_m, y_m: np.maximum(0.3 * x_m, 0.0), None, False, ""),  # a coast
    (lambda x_m, y_m: np.where(np.abs(x_m) < 100, 0.0, 12.0), None, False, ""),  # a harbour of 12 m
    (cliff_and_beach, None, False, ""), (lambda x_m, y_m: 0.0 * x_m, None, False, "")])
def test_zeros_amid_heights_are_no_data_and_the_sea_is_at_zero(tmp_path, height, nodata, are_void, note):
    grid = read_heights(write_dem(tmp_path / "a.tif", height, nodata=nodata), ORIGIN, BOX_M)
    said = " ".join(grid.notes)
    assert note in said and ("are 0 amid" in said) == are_void == (grid.filled > 0)
    assert grid.height_m.min() > 490 if are_void else grid.height_m.min() == 0.0


@pytest.mark.parametrize(("middle_m", "pixel_m", "voids", "steps"), [
    (400.0, 10.0, 0, (0.0, 0)), (0.0, 10.0, 1, (400.0, 4)), (0.0, 100.0, 1, (400.0, 0)), (0.0, 1000.0, 0, (400.0, 0))])
def test_a_pit_of_one_pixel(middle_m, pixel_m, voids, steps):
    pit = np.full((5, 5), 400.0)
    pit[2, 2] = middle_m
    assert zero_voids(pit, pixel_m).sum() == voids and steep_steps(pit, pixel_m) == steps
