"""The scene that `--write-scene` writes: read back by the loader, and traced."""

import json
import shutil
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
import trimesh

from radiotwin.closeloop.output import corrected_scene
from radiotwin.closeloop.output.corrected_scene import (
    _free_position,
    _moved,
    check_corrected_target,
    write_corrected_scene,
)
from radiotwin.effects import registry
from radiotwin.effects.boxes import buildings
from radiotwin.effects.places import Roof
from radiotwin.errors import BadInput
from radiotwin.scene import Scene
from radiotwin.scene.build import BuildOptions
from radiotwin.scene.citymap import CityMap
from radiotwin.scene.folder import CityShape, write_city
from radiotwin.scene.materials import STANDARD, itu_material, with_materials
from radiotwin.scene.plot import draw_preview
from radiotwin.scene.readers import build_scene_from_map
from radiotwin.trace import SolverSettings, trace_gains
from tests.terrains import incline, terrain_map

pytestmark = pytest.mark.usefixtures("plain")

BOX = [130.0, 45.0, 24.0, 14.0, 70.0, 30.0]  # on a street of the small scene


@pytest.fixture
def plain(plain_preview, monkeypatch):
    monkeypatch.setattr(corrected_scene, "draw_preview", plain_preview)


def loop_of(scene, *found):
    """Return what `write_corrected_scene` reads of a loop that found these: (effect, its parameters by name)."""
    links = SimpleNamespace(device_names=[d.device for d in scene.config.devices], device_m=scene.device_m)
    effects = [effect().with_params(effect.Params(**params)) for effect, params in found]
    return SimpleNamespace(after=SimpleNamespace(whole=SimpleNamespace(effects=effects, links=links)))


def corrected(folder, scene, *found, name=None):
    """Return what is told of a scene that is written as a loop found it, and that scene; `name`: of its first device."""
    loop = loop_of(scene, *found)
    if name:
        loop.after.whole.links.device_names[0] = name
    return write_corrected_scene(loop, scene, folder), Scene.load(folder)


def ends(x_m, y_m, turn_deg, reach_m, z_m):
    """Return two points on both sides of a position, along a direction."""
    turn = np.radians(turn_deg)
    step = reach_m * np.array([np.cos(turn), np.sin(turn)])
    return (np.array([[x_m + sign * step[0], y_m + sign * step[1], z_m]]) for sign in (-1, 1))


def tallest(scene):
    """Return index, x, y [m] and height [m] of the highest building."""
    centres_m = buildings(scene.city)[1]
    return int(centres_m[:, 2].argmax()), *centres_m[centres_m[:, 2].argmax()]


def test_a_traced_box_is_in_the_way_as_long_wide_and_turned_as_it_was_found(small_scene, tmp_path, monkeypatch):
    monkeypatch.setattr(corrected_scene, "draw_preview", draw_preview)
    changes, again = corrected(tmp_path / "new", small_scene, (registry.MissingObstacle, {"box": BOX, "scattered_db": 0.0}))
    assert (tmp_path / "new" / "preview.png").stat().st_size > 10_000
    assert changes == ["a box of 24 x 14 m, 70 m high, stands at (130, 45) m"]
    city = again.city
    for turn_deg, half_m in ((30.0, 12.0), (120.0, 7.0)):  # along it and across
        a_m, b_m = ends(*BOX[:2], turn_deg, 40.0, 60.0)
        assert small_scene.city.line_of_sight(a_m, b_m)[0] and not city.line_of_sight(a_m, b_m)[0]
        assert city.metres_inside(a_m, b_m)[0] == pytest.approx(2 * half_m, abs=0.01)
    a_m, b_m = ends(*BOX[:2], 30.0, 40.0, 71.0)
    assert city.line_of_sight(a_m, b_m)[0]
    assert again.config.provenance.pop("corrected") == changes[0]
    assert again.config == small_scene.config


def test_a_building_that_is_gone_lets_links_through_and_others_do_not(small_scene, tmp_path):
    building, x_m, y_m, height_m = tallest(small_scene)
    (change,), new = corrected(tmp_path / "new", small_scene,
                               (registry.RemovedObstacle, {"building": building, "centre_m": [x_m, y_m, height_m]}))
    assert "is taken out" in change
    city = new.city
    above, below = np.array([[x_m, y_m, height_m + 1]]), np.array([[x_m, y_m, 0.5]])
    assert not small_scene.city.line_of_sight(above, below)[0] and city.line_of_sight(above, below)[0]
    assert len(buildings(city)[1]) == len(buildings(small_scene.city)[1]) - 1
    assert len(list((tmp_path / "new" / "meshes").iterdir())) == len(list(small_scene.folder.glob("meshes/*"))) - 1
    for mesh in (tmp_path / "new" / "meshes").iterdir():
        assert mesh.read_bytes() == (small_scene.folder / "meshes" / mesh.name).read_bytes()


@pytest.mark.parametrize("roof", ["default", "metal"])  # in the mesh of the walls, and in one of its own
def test_roofs_that_are_off_are_raised_and_lowered_and_the_table_follows(tmp_path, roof):
    (tmp_path / "town.geojson").write_text(json.dumps({"type": "FeatureCollection", "features": [
        {"type": "Feature", "properties": {"height": height}, "geometry": {"type": "Polygon", "coordinates": [
            [[east, 47.0], [east + 3e-4, 47.0], [east + 3e-4, 47.0002], [east, 47.0002], [east, 47.0]]]}}
        for east, height in ((8.0, 12), (8.001, 20), (8.002, None))]}))
    materials = STANDARD if roof == "default" else with_materials(STANDARD, {"roof": roof})
    build_scene_from_map(tmp_path / "town.geojson", tmp_path / "scene",
                         BuildOptions(default_height_m=9.0, material_table=materials))
    scene = Scene.load(tmp_path / "scene")
    centres_m = buildings(scene.city)[1]
    by_height = {round(height_m): number for number, (_, _, height_m) in enumerate(centres_m)}
    roofs = tuple(Roof(by_height[height_m], *centres_m[by_height[height_m]].tolist(), offset_m, 0.6)
                  for height_m, offset_m in ((12, 3.0), (9, -4.0)))
    gone = {"building": by_height[20], "centre_m": centres_m[by_height[20]].tolist()}
    changes, new = corrected(tmp_path / "new", scene, (registry.RoofHeights, {"roofs": roofs}), (registry.RemovedObstacle, gone))
    assert any("is 15.0 m high, and 12.0 m on the map" in change for change in changes)
    for each in roofs:
        assert new.city.height_at(each.x_m, each.y_m) == pytest.approx(each.height_m + each.offset_m, abs=1e-3)
    assert sorted(np.round(buildings(new.city)[1][:, 2], 3)[-2:]) == [5.0, 15.0]  # walls, too
    table = pd.read_csv(tmp_path / "new" / "buildings.csv")
    assert sorted(zip(table["top_m"], table["height_from"], table["height_sd_m"])) == [
        (5.0, "close-loop", 0.6), (15.0, "close-loop", 0.6)]
    told_m = new.city.height_sd_m
    assert set(told_m[np.isfinite(told_m)]) == {0.6}


def test_an_anchor_that_is_moved_stays_as_high_above_a_slope():
    scene = SimpleNamespace(city=terrain_map(incline(0.2, 0.0)), config=SimpleNamespace(
        extent=SimpleNamespace(bounds=(-300.0, 300.0, -300.0, 300.0))))
    ground_m = float(scene.city.ground_height_m(0.0, 0.0))
    device = SimpleNamespace(x_m=0.0, y_m=0.0, z_m=ground_m + 1.5)
    x_m, y_m, z_m = _free_position(np.array([40.0, 10.0]), device, scene, scene.city)
    assert (x_m, y_m) == (40.0, 10.0) and z_m == pytest.approx(ground_m + 8.0 + 1.5, abs=0.02)


def test_an_anchor_with_no_free_place_near_stays_and_that_is_said(small_scene, tmp_path, monkeypatch):
    monkeypatch.setattr(CityMap, "inside", lambda city, points_m: np.ones(len(points_m), dtype=bool))
    loop = loop_of(small_scene, (registry.DevicePositionError, {"device": 0, "move_m": [0.0, 20.0]}))
    (moved,), links = loop.after.whole.effects, loop.after.whole.links
    config, changes = _moved([moved.correction(links)], links, small_scene, small_scene.city)
    assert config.devices[0] == small_scene.config.devices[0]
    assert "d0 is not moved from (80, 40) to (80, 60) m: there is no place" in changes[0]


def test_one_building_of_a_mesh_that_holds_several(small_scene, tmp_path):
    """A city whose buildings are one mesh: the others stay."""
    shutil.copytree(small_scene.folder, tmp_path / "one")
    shutil.rmtree(tmp_path / "one" / "meshes")
    mesh = trimesh.Trimesh(small_scene.city.vertices, small_scene.city.faces, process=False)
    write_city(tmp_path / "one", [CityShape("all", mesh, itu_material("concrete"))])
    scene = Scene.load(tmp_path / "one")
    building, x_m, y_m, height_m = tallest(scene)
    _, one = corrected(tmp_path / "new", scene, (registry.RemovedObstacle, {"building": building, "centre_m": (x_m, y_m, height_m)}))
    new = buildings(one.city)[1]
    old = np.delete(buildings(scene.city)[1], building, axis=0)
    assert np.sort(new, axis=0) == pytest.approx(np.sort(old, axis=0))


def test_an_anchor_is_where_it_was_found(small_scene, tmp_path):
    told, new = corrected(tmp_path / "new", small_scene, (registry.DevicePositionError, {"device": 0, "move_m": [0.0, 20.0]}),
                          (registry.DevicePositionError, {"device": 0, "move_m": [5.0, 0.0]}),
                          (registry.ReceiverDrift, {"receivers": {0: ("step", 150.0)}}))
    assert told == ["d0 is moved from (80, 40) to (85, 60) m"]
    assert new.device_m[0] == pytest.approx(small_scene.device_m[0] + (5, 20, 0))
    assert (new.device_m[1:] == small_scene.device_m[1:]).all()
    assert new.xml_path.read_bytes() == small_scene.xml_path.read_bytes()


SECTOR = {"azimuth_deg": 205.0, "beamwidth_deg": 60.0, "front_to_back_db": 25.0, "tilt_deg": -8.0,
          "vertical_beamwidth_deg": 12.0}


def sector_dbi(azimuth_deg, elevation_deg):
    """Attenuation of 3GPP TR 38.901, Table 7.3-1, written out, without the gain of its maximum."""
    off = (np.asarray(azimuth_deg) - 205.0 + 180) % 360 - 180
    horizontal, vertical = (12 * (off / 60) ** 2).clip(max=25), (12 * ((elevation_deg + 8.0) / 12) ** 2).clip(max=25)
    return -(horizontal + vertical).clip(max=25)


def rays(azimuth_deg, elevation_deg):
    azimuth, elevation = np.radians(azimuth_deg), np.radians(elevation_deg)
    return np.stack([np.sin(azimuth) * np.cos(elevation), np.cos(azimuth) * np.cos(elevation), np.sin(elevation)], -1)


def test_an_antenna_that_was_found_is_declared(small_scene, tmp_path):
    name = small_scene.config.devices[0].device
    changes, new = corrected(tmp_path / "new", small_scene, (registry.SectorAntenna, {"devices": {0: SECTOR}}))
    assert changes == [f"{name} has a sector antenna that looks to 205° and is 60° wide"]
    antenna, *others = new.device_antennas
    assert others == [None] * len(others)
    azimuth, elevation = np.meshgrid(np.arange(0, 360, 10.0), np.arange(-88.0, 89.0, 4.0))
    gain_dbi = antenna.gain_dbi(rays(azimuth, elevation))
    peak_dbi = antenna.gain_dbi(rays(205.0, -8.0))
    np.testing.assert_allclose(gain_dbi - peak_dbi, sector_dbi(azimuth, elevation), atol=0.15)
    weight = np.cos(np.radians(elevation))
    assert 10 * np.log10((weight * 10 ** (gain_dbi / 10)).sum() / weight.sum()) == pytest.approx(0, abs=0.1)
    again, other = corrected(tmp_path / "new", small_scene, (registry.SectorAntenna, {"devices": {1: SECTOR}}))
    assert len(again) == 1 and other.device_antennas[0] is None


def test_devices_whose_names_differ_in_a_dot_have_antennas_of_their_own(small_scene, tmp_path):
    loop = loop_of(small_scene, (registry.SectorAntenna, {"devices": {0: SECTOR, 1: SECTOR | {"beamwidth_deg": 90.0}}}))
    loop.after.whole.links.device_names = ["bs.1", "bs_1"]
    write_corrected_scene(loop, small_scene, tmp_path / "new")
    first, second = Scene.load(tmp_path / "new").device_antennas[-2:]
    side = rays(205.0 + 60.0, -8.0)
    assert second.gain_dbi(side) - first.gain_dbi(side) > 3.0


@pytest.mark.parametrize("name", ["LTE 262-1-5-7", "BS@1", "02:1b:44:11:3a:b7"])
def test_an_anchor_that_no_scene_can_name_is_left_out_and_told(small_scene, tmp_path, name):
    [change], new = corrected(tmp_path / "new", small_scene, (registry.SectorAntenna, {"devices": {0: SECTOR}}), name=name)
    assert change.startswith(f"{name!r} has a sector antenna, and is not in the scene")
    assert len(new.config.devices) == len(small_scene.config.devices)


def test_an_anchor_that_the_scene_lacks_is_declared_with_its_antenna(small_scene, tmp_path):
    loop = loop_of(small_scene, (registry.SectorAntenna, {"devices": {0: SECTOR}}))
    loop.after.whole.links.device_names = ["mast"]
    write_corrected_scene(loop, small_scene, tmp_path / "new")
    first, last = small_scene.config.devices[0], Scene.load(tmp_path / "new").config.devices[-1]
    assert (last.device, last.x_m, last.y_m, last.z_m, last.role) == ("mast", first.x_m, first.y_m, first.z_m, "anchor")
    loop.after.whole.links.device_m = np.array([[1e5, 0.0, 30.0]])
    (told,) = write_corrected_scene(loop, small_scene, tmp_path / "far")
    assert "mast has a sector antenna, and is not in the scene" in told


def test_positions_that_cannot_be_are_moved_to_the_nearest_that_can(small_scene, tmp_path):
    """An anchor found within a building or off the map, and a box over a device: each as near as it can be."""
    building, x_m, y_m, _ = tallest(small_scene)
    box = [*small_scene.device_m[1, :2] + (8.0, 0.0), 30.0, 20.0, 40.0, 0.0]
    loop = loop_of(
        small_scene, (registry.DevicePositionError, {"device": 0, "move_m": [x_m - 80.0, y_m - 40.0]}),
        (registry.DevicePositionError, {"device": 6, "move_m": [0.0, 100.0]}),
        (registry.MissingObstacle, {"box": box, "scattered_db": 0.0}))
    write_corrected_scene(loop, small_scene, tmp_path / "new")
    new = Scene.load(tmp_path / "new")  # refuses devices inside buildings and outside the extent
    assert new.device_m[6] == pytest.approx((80.0, 300.0, 1.5))
    assert np.hypot(*(new.device_m[0, :2] - (x_m, y_m))) < 60
    assert new.city.height_at(*(small_scene.device_m[1, :2] + (12.0, 0.0))) == pytest.approx(40.0)


def test_what_was_corrected_can_be_corrected_again(small_scene, tmp_path):
    _, scene = corrected(tmp_path / "a", small_scene, (registry.MissingObstacle, {"box": BOX, "scattered_db": 0.0}))
    other = [110.0, 100.0, 10.0, 10.0, 50.0, 0.0]
    _, again = corrected(tmp_path / "b", scene, (registry.MissingObstacle, {"box": other, "scattered_db": 0.0}))
    assert again.city.height_at([110.0, 130.0], [100.0, 45.0]) == pytest.approx([50.0, 70.0])
    assert again.config.provenance["corrected"].count("a box of") == 2


def test_where_nothing_is_to_be_corrected_nothing_is_written(small_scene, tmp_path):
    loop = loop_of(small_scene, (registry.ReceiverDrift, {"receivers": {0: ("step", 150.0)}}))
    assert write_corrected_scene(loop, small_scene, tmp_path / "new") == []
    assert not (tmp_path / "new").exists()


def test_folders_that_cannot_be_written_are_refused_before_the_work(small_scene, tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("")
    (tmp_path / "file").write_text("")
    out = tmp_path / "out"
    for folder, scene, message in (
            (tmp_path / "new", None, "give it with --scene"), (tmp_path / "mine", small_scene, "holds thesis.txt"),
            (tmp_path / "file", small_scene, "is a file"), (out, small_scene, "the report"),
            (small_scene.folder, small_scene, "the declared scene"),
            (small_scene.folder.parent, small_scene, "the declared scene")):
        with pytest.raises(BadInput, match=message):
            check_corrected_target(folder, scene, out)
    check_corrected_target(out / "scene", small_scene, out)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "mine"]


@pytest.mark.llvm
def test_sionna_rt_traces_it(small_scene, tmp_path):
    """Rationale: the map that Sionna RT loads is `city.xml`, not ours.

    Expected behaviour: a link loses more than 6 dB where the box is put in its way, and gains more than 6 dB where the
    building that blocked it is taken out.
    """
    building, x_m, y_m, height_m = tallest(small_scene)
    _, new = corrected(tmp_path / "new", small_scene, (registry.MissingObstacle, {"box": BOX, "scattered_db": 0.0}),
                       (registry.RemovedObstacle, {"building": building, "centre_m": (x_m, y_m, height_m)}))
    links = [*zip(*ends(*BOX[:2], 30.0, 40.0, 60.0)), *zip(*ends(x_m, y_m, 0.0, 60.0, 0.5 * height_m))]
    change_db = []
    for a_m, b_m in links:
        before_db, after_db = (float(trace_gains(scene, a_m[None], b_m[None], SolverSettings.of_quality("fast"))[0, 0])
                               for scene in (small_scene, new))
        change_db.append(np.nan_to_num(after_db, nan=-200.0) - np.nan_to_num(before_db, nan=-200.0))
    assert change_db[0] < -6 and change_db[1] > 6
