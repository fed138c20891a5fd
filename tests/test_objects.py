"""What Python shows of scenes, measurements, maps, twins and residuals: text, plots, tables, files, pickles."""

import pickle
import sys
from dataclasses import replace

import matplotlib
import numpy as np
import pandas as pd
import pytest
from pyproj import Geod

import radiotwin as rt
from radiotwin.scene.lattice import Lattice
from tests.worlds import placed

matplotlib.use("Agg")
BAD = "<b>&\x1b"


def make_map(gain_db, devices=("a", "b"), x_m=(0.0, 10.0, 20.0), ground_m=None, **attributes):
    """A map of altitudes above the datum, or above a ground that is level."""
    ground_m = None if ground_m is None else np.full((2, len(x_m)), ground_m)
    lattice = Lattice(np.array(x_m), np.array([0.0, 10.0]), np.array([30.0, 40.0]), ground_m=ground_m)
    gain_db = np.broadcast_to(np.asarray(gain_db, dtype=float), (len(devices), *lattice.shape))
    return rt.RadioMap.build(list(devices), lattice, gain_db, np.ones(gain_db.shape, bool), attributes=attributes)


@pytest.fixture(scope="module")
def measured(small_scene):
    return rt.fly_survey(small_scene, "segmented", flights=1)


@pytest.fixture(scope="module")
def twin(small_scene, measured):
    return rt.fit_twin(measured, small_scene, model="log_distance")


def residuals():
    """Ten links to a device; the residual grows eastwards, and one link is not detected."""
    count = 10
    table = pd.DataFrame({
        "time_s": np.arange(count, dtype=float), "flight": "f", "receiver": "r", "receiver_x_m": np.arange(count) * 5.0,
        "receiver_y_m": 0.0, "receiver_z_m": 50.0, "device": "d", "device_x_m": 3.0, "device_y_m": 4.0,
        "device_z_m": 1.5, "los": 1, "measured_db": -80.0, "before_db": np.arange(count) - 3.0,
        "after_db": np.r_[np.nan, np.full(count - 1, 2.0)]})
    return rt.Residuals(table)


def test_lines_are_short_and_have_units(small_scene, measured, twin):
    assert repr(small_scene) == "<Scene: small, 300 × 300 m, 7 devices, 2 UAVs, 2.4 GHz>"
    assert repr(measured).startswith(f"<Measurements: {len(measured.table):,} links, 2 receivers, 7 devices, 1 flight, "
                                     "gain_db −") and " dB, 0.0% not detected>" in repr(measured)
    assert repr(twin).startswith("<Twin: log_distance, 7 devices, ") and "of 4 unknown ones located" in repr(twin)
    level = make_map(-80.0, source="raytrace")
    assert repr(level) == ("<RadioMap: raytrace, 2 devices, 3 × 2 × 2 positions (x, y, z), 10 m apart, "
                           "gain −80 to −80 dB>")
    assert repr(residuals()) == "<Residuals: 10 links, RMSE 3.24 dB before, 2.00 dB after>"
    assert repr(level - make_map(-82.5, source="twin")) == (
        "<MapDifference: raytrace − twin, 2 devices, RMS 2.50 dB, mean +2.50 dB>")
    assert len(small_scene) == len(twin) == 7 and len(measured) == len(measured.table) and len(level) == 2
    assert len(residuals()) == 10 and not any("\n" in repr(each) for each in (small_scene, measured, twin, level))


def test_tables_of_notebooks_escape_names(small_scene, twin):
    scene = placed(small_scene)
    level = make_map(-80.0, devices=[BAD, "b"], source=BAD)
    shown = [scene._repr_html_(), level._repr_html_(), (level - level)._repr_html_(), residuals()._repr_html_(),
             replace(twin, provenance={"scene": BAD})._repr_html_()]
    assert all("<table>" in html and "<b>" not in html and "\x1b" not in html for html in shown)
    assert "&lt;b&gt;&amp;\\x1b" in shown[1] and "latitude 47.5°" in shown[0] and "&lt;b&gt;" in shown[4]


def test_a_difference_is_that_of_the_same_links():
    first, second = make_map(-80.0, source="one"), make_map([[[[-83.0, np.nan, -81.0]]]], source="two")
    difference = first - second
    assert np.array_equal(difference.difference_db[1, 1, 0], [3.0, np.nan, 1.0], equal_nan=True)
    assert difference.rmse_db == pytest.approx(np.sqrt(5.0)) and difference.mean_db == pytest.approx(2.0)
    values = np.array([-80.0, -90.0]).reshape(2, 1, 1, 1)
    turned = make_map(values) - make_map(values[::-1], devices=("b", "a"))
    assert not turned.difference_db.any(), "devices are compared by name"
    nothing = first - make_map(np.nan)
    assert np.isnan(nothing.rmse_db) and np.isnan(nothing.mean_db) and "nan" in repr(nothing)


@pytest.mark.parametrize("other, parts", [
    (make_map(-80.0, devices=("a", "c")), ["different devices", "a, c"]),
    (make_map(-80.0, x_m=(0.0, 10.0, 25.0)), ["different positions", "x goes from 0 to 20 m"]),
    (make_map(-80.0, x_m=(0.0, 10.0)), ["different positions"]),
    (make_map(-80.0, origin_latitude_deg=47.6, origin_longitude_deg=8.7), ["different frames", "47.6"])])
def test_maps_of_other_places_are_not_subtracted(other, parts):
    with pytest.raises(rt.BadInput) as error:
        make_map(-80.0, origin_latitude_deg=47.5, origin_longitude_deg=8.7) - other
    assert all(part in str(error.value) for part in parts)
    with pytest.raises(TypeError):
        other - 3.0


def drawn(ax):
    """The values of the first mesh or points of some axes."""
    return np.ma.filled(ax.collections[0].get_array(), np.nan)


def test_plots_have_the_values_the_labels_and_the_titles(small_scene, measured, twin):
    gain_db = -80.0 - np.arange(24.0).reshape(2, 2, 2, 3)
    level = make_map(gain_db, source="trace $x$")
    ax = level.plot("b", 40.0)
    assert np.array_equal(drawn(ax), gain_db[1, 1].astype(np.float32)) and ax.get_xlabel() == "x, east [m]"
    assert ax.get_title() == r"trace \$x\$: device b at 40 m" and ax.figure.axes[1].get_ylabel() == "channel gain [dB]"
    difference = level - make_map(gain_db + 1.0)
    ax = difference.plot()
    mesh = ax.collections[0]
    assert (drawn(ax) == -1.0).all() and mesh.norm.vmin == -mesh.norm.vmax and mesh.cmap.name == "RdBu_r"
    own = matplotlib.figure.Figure().subplots()
    assert small_scene.plot(own) is own and own.get_title() == "small (2.4 GHz)"
    assert {text.get_text() for text in own.get_legend().get_texts()} == {"anchor", "device to be found", "UAV start"}
    ax = measured.plot("d0", scene=small_scene)
    assert ax.get_title().startswith("device d0: ") and "channel gain [dB]" in [each.get_ylabel() for each in
                                                                               ax.figure.axes]
    ax = twin.plot(scene=small_scene)
    assert {"anchor", "located"} <= {text.get_text() for text in ax.get_legend().get_texts()}
    ax = residuals().plot("before")
    assert sorted(drawn(ax)) == sorted(np.arange(10) - 3.0) and ax.get_title().endswith("before: RMSE 3.24 dB")
    assert len(drawn(residuals().plot())) == 9, "what was never measured is no residual"
    matplotlib.pyplot.close("all")


def test_plots_in_degrees_where_the_origin_is_known(small_scene, measured):
    scene = placed(small_scene)
    for ax in (scene.plot(), make_map(-80.0, origin_latitude_deg=47.5, origin_longitude_deg=8.7, origin_altitude_m=0.0).plot(),
               measured.plot(scene=scene)):
        assert (ax.get_xlabel(), ax.get_ylabel()) == ("longitude [°]", "latitude [°]")
        assert 8.69 < np.mean(ax.get_xlim()) < 8.71 and 47.49 < np.mean(ax.get_ylim()) < 47.51
    assert scene.plot(geographic=False).get_xlabel() == "x, east [m]"
    with pytest.raises(rt.BadInput, match="origin"):
        small_scene.plot(geographic=True)
    matplotlib.pyplot.close("all")


@pytest.mark.parametrize("draw", [
    lambda: make_map(-80.0).plot("z"), lambda: make_map(-80.0).plot(altitude_m=31.0), lambda: residuals().plot("later"),
    lambda: residuals().plot(device="z"), lambda: (make_map(-80.0) - make_map(-80.0)).plot("z")])
def test_what_is_not_there_is_not_drawn(draw):
    with pytest.raises(rt.BadInput):
        draw()


def test_tables_for_gis_programs(small_scene, measured, twin):
    pytest.importorskip("geopandas", reason="the extra geo is not installed")
    scene = placed(small_scene)
    buildings, devices = scene.to_geodataframe(), scene.to_geodataframe("devices")
    roofs_m = scene.to_xarray(2.0)["height_m"]
    assert buildings.area.sum() == pytest.approx(float((roofs_m > 0.5).sum()) * 4, rel=0.06)
    assert buildings["height_m"].max() == pytest.approx(float(roofs_m.max()), abs=0.01)
    longitude, latitude, _ = Geod(ellps="WGS84").fwd(8.7, 47.5, np.degrees(np.arctan2(80, 40)), np.hypot(80, 40))
    point = devices.to_crs(4326).geometry[0]  # d0 at (80, 40)
    assert (point.x, point.y) == (pytest.approx(longitude, abs=1e-8), pytest.approx(latitude, abs=1e-8))
    with pytest.raises(rt.BadInput, match="layer 'roads'"):
        scene.to_geodataframe("roads")
    links = measured.to_geodataframe()
    assert links.crs is None and len(links) == len(measured)
    assert links.geometry.x.tolist() == measured.table["receiver_x_m"].tolist()
    level = make_map(-80.0 - np.arange(24.0).reshape(2, 2, 2, 3)).to_geodataframe()
    row = level[(level["device"] == "b") & (level["z_m"] == 40) & (level["y_m"] == 10) & (level["x_m"] == 20)]
    assert len(level) == 24 and row["gain_db"].item() == -103.0 and row.geometry.item().coords[0] == (20.0, 10.0)
    lost = replace(twin.devices[1], x_m=np.nan, y_m=np.nan, located=False)
    assert replace(twin, devices=[twin.devices[0], lost]).to_geodataframe().geometry.isna().tolist() == [False, True]
    assert residuals().to_geodataframe().geometry.x.tolist() == (np.arange(10) * 5.0).tolist()


def test_without_geopandas_it_is_said_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "geopandas", None)
    with pytest.raises(rt.BadInput, match=r"pip install 'radiotwin\[geo\]'"):
        make_map(-80.0).to_geodataframe()


def test_datasets_have_units(small_scene, measured):
    links = measured.to_xarray()
    assert links.sizes == {"link": len(measured)} and links["gain_db"].attrs["units"] == "dB"
    assert links["device_x_m"].values[links["device"].values == "d0"].tolist()[0] == 80.0
    assert links["receiver_x_m"].attrs["units"] == "m" and links["time_s"].attrs["units"] == "s"
    level = make_map(-80.0)
    copied = level.to_xarray()
    copied["gain_db"][:] = 0.0
    assert (level.gain_db == -80.0).all(), "a copy"
    raster = placed(small_scene).to_xarray(10.0)
    assert raster["height_m"].shape == (30, 30) and raster.attrs["origin_latitude_deg"] == 47.5
    with pytest.raises(rt.BadInput, match="step_m"):
        small_scene.to_xarray(0.0)


def test_load_brings_back_what_save_wrote(small_scene, measured, twin, tmp_path):
    for name, each in (("m.csv", measured), ("level.nc", make_map(-80.0)), ("twin", twin), ("residuals.csv.gz", residuals())):
        each.save(tmp_path / name)
        assert repr(type(each).load(tmp_path / name)) == repr(each)
    with pytest.raises(rt.BadInput, match="allowed are .csv"):
        residuals().save(tmp_path / "residuals.txt")


def test_a_saved_scene_is_the_same_and_erases_nothing(small_scene, tmp_path):
    moved = placed(small_scene, name="another")
    moved.save(tmp_path / "copy")
    back = rt.Scene.load(tmp_path / "copy")
    assert back.content_hash() == small_scene.content_hash() and back.config == moved.config
    moved.save(tmp_path / "copy")  # again: a scene is replaced
    with pytest.raises(rt.BadInput, match="holds the scene itself"):
        back.save(tmp_path / "copy")
    (tmp_path / "copy" / "thesis.tex").write_text("years of work")
    with pytest.raises(rt.BadInput, match="thesis.tex"):
        moved.save(tmp_path / "copy")


def test_a_scene_pickles_without_its_map(small_scene):
    assert small_scene.city.height_at(30.0, 30.0) > 1  # Embree's part, which cannot be pickled, is there
    data = pickle.dumps(small_scene)
    assert len(data) < 20_000
    assert pickle.loads(data).city.height_at(30.0, 30.0) == small_scene.city.height_at(30.0, 30.0)


def test_maps_over_other_ground_are_not_subtracted():
    above_80_m = make_map(-80.0, ground_m=80.0)
    assert (above_80_m - make_map(-75.0, ground_m=80.0)).mean_db == -5.0
    for other in (make_map(-75.0), make_map(-75.0, ground_m=20.0)):
        with pytest.raises(rt.BadInput, match="ground"):
            above_80_m - other


def test_a_table_of_a_map_above_the_ground_has_both_heights():
    table = make_map(-80.0, ground_m=80.0).to_geodataframe()
    assert (table["z_m"] == table["above_ground_m"] + 80.0).all()
