"""Antennas that a scene declares, in the gains that are traced."""

import numpy as np
import pytest

from radiotwin.errors import BadInput
from radiotwin.scene import Scene
from radiotwin.scene.antennas import read_pattern
from radiotwin.trace import SolverSettings, trace_map, trace_points
from radiotwin.trace.solver import PathGains

SECTOR = "azimuth_deg,elevation_deg,gain_dbi\n" + "\n".join(
    f"{a},{e},{10 - 12 * (min(a, 360 - a) / 90) ** 2 - abs(e) / 30}"
    for a in range(0, 360, 5) for e in range(-90, 91, 10))
DIPOLE = "azimuth_deg,elevation_deg,gain_dbi\n" + "\n".join(f"{a},{e},{2 - abs(e) / 10}"
                                                             for a in (0, 90, 180, 270) for e in range(-90, 91, 10))


@pytest.fixture
def with_antennas(own_scene):
    """`preset:small`: d0 has a sector antenna that looks east and 5 degrees up, the UAVs have dipoles."""
    folder = own_scene.folder
    (folder / "antennas").mkdir()
    (folder / "antennas" / "sector.csv").write_text(SECTOR)
    (folder / "antennas" / "dipole.csv").write_text(DIPOLE)
    text = (folder / "scene.toml").read_text()
    text = text.replace('device = "d0"\n', 'device = "d0"\nantenna = "antennas/sector.csv"\nazimuth_deg = 90\n'
                        "tilt_deg = 5\n", 1)
    text = text.replace("[[uavs]]", '[[uavs]]\nantenna = "antennas/dipole.csv"')
    (folder / "scene.toml").write_text(text)
    return folder


def test_the_scene_knows_its_antennas(with_antennas, small_scene):
    scene = Scene.load(with_antennas)
    assert [antenna is not None for antenna in scene.device_antennas] == [True] + [False] * 6
    assert scene.device_antennas[0].gain_dbi(np.array([1.0, 0, np.tan(np.radians(5))])) == pytest.approx(10)
    assert scene.uav_antenna.gain_dbi(np.array([0, 0, -3.0])) == pytest.approx(-7)
    hashes = {small_scene.content_hash(), scene.content_hash()}
    (with_antennas / "antennas" / "dipole.csv").write_text(DIPOLE.replace("\n0,0,2", "\n0,0,3"))
    hashes.add(Scene.load(with_antennas).content_hash())
    text, path = (with_antennas / "scene.toml").read_text(), with_antennas / "scene.toml"
    mounted = 'antenna = "antennas/sector.csv"\nazimuth_deg = 90\ntilt_deg = 5\n'
    path.write_text(text.replace(mounted, "", 1).replace('device = "d1"\n', 'device = "d1"\n' + mounted, 1))
    moved = Scene.load(with_antennas)
    assert [antenna is not None for antenna in moved.device_antennas] == [False, True] + [False] * 5
    assert len(hashes | {moved.content_hash()}) == 4  # a map for other antennas, or at other devices, is another map


@pytest.mark.llvm
def test_free_space_has_both_antennas_in_it(with_antennas):
    """Expected: Friis with the gains of both patterns along the straight line, each in its own direction."""
    scene = Scene.load(with_antennas)
    settings = SolverSettings(samples_per_src=1000, batch_receivers=8, diffraction="off")
    solver = PathGains(None, 2.4e9, settings)
    way_m = np.array([[100, 0, 0], [100, 0, 50], [-100, 0, 20], [60, -80, 30], [0, 90, -40], [50, 50, 50]], dtype=float)
    antennas = scene.device_antennas[0], scene.uav_antenna
    difference_db = solver.solve(np.zeros(3), way_m, antennas) - solver.solve(np.zeros(3), way_m)
    azimuth_deg = np.degrees(np.arctan2(way_m[:, 0], way_m[:, 1]))
    elevation_deg = np.degrees(np.arcsin(way_m[:, 2] / np.linalg.norm(way_m, axis=1)))
    flat = read_pattern(with_antennas / "antennas" / "dipole.csv").at(0, -elevation_deg)
    assert difference_db == pytest.approx(antennas[0].gain_dbi(way_m) + flat, abs=1e-3)
    # the sector's own closed form where its boresight is: 5 degrees up in the east
    assert difference_db[0] == pytest.approx(10 - 5 / 30 + 2, abs=0.02)
    off_deg = np.abs(azimuth_deg - 90)
    assert np.all(np.diff(difference_db[np.argsort(off_deg)][[0, -1]]) < -20)


@pytest.mark.llvm
def test_gains_and_maps_have_the_antennas(with_antennas, small_scene, tmp_path):
    scene = Scene.load(with_antennas)
    points_m = np.array([[140.0, 40.0, 55.0], [60.0, 40.0, 55.0]])  # east and west of d0, both with line of sight
    plain, turned = (trace_points(world, points_m, SolverSettings.of_quality("fast"), devices=["d0", "d1"])
                     for world in (small_scene, scene))
    gained_db = (turned["gain_db"] - plain["gain_db"]).to_numpy()
    assert plain["los"][:2].all() and gained_db[0] > 3 and gained_db[1] < -3  # ahead of the sector, behind it
    d1_db = gained_db[2:]  # d1 is isotropic, the UAV's dipole is not
    assert np.nanmax(d1_db) < 2.1 and np.nanmin(d1_db) > -7.1
    small = scene.config.model_copy(update={"lattice": scene.config.lattice.model_copy(
        update={"step_m": 60.0, "altitudes_m": [55.0]}), "uavs": scene.config.uavs[:1]})
    radio_map = trace_map(Scene(scene.folder, small), SolverSettings.of_quality("fast"), tmp_path / "map.nc", ["d0"])
    lattice_m = radio_map.lattice.positions_m
    at_points = trace_points(scene, lattice_m, SolverSettings.of_quality("fast"), devices=["d0"])["gain_db"]
    assert radio_map.gain_db.ravel() == pytest.approx(at_points.to_numpy(), abs=1e-3, nan_ok=True)


def test_cells_have_no_directions(with_antennas, tmp_path):
    with pytest.raises(BadInput, match="declares antennas, which the solver 'map' does not know"):
        trace_map(Scene.load(with_antennas), SolverSettings.of_quality("fast", solver="map"), tmp_path / "map.nc")


@pytest.mark.parametrize(("old", "new", "message"), [
    ("antennas/sector.csv", "antennas/none.csv", "none.csv does not exist"),
    ("antennas/sector.csv", "../sector.csv", "below the scene folder"),
    ("antennas/sector.csv", "city.xml", "unknown format '.xml' of an antenna"),
    ('antenna = "antennas/sector.csv"\n', "", "azimuth_deg and tilt_deg belong to an antenna"),
    ("azimuth_deg = 90", "azimuth_deg = 900", "azimuth_deg = 900"),
    ('uav = "uav0"', 'antenna = "antennas/sector.csv"\nuav = "uav0"', "not readable TOML"),
    ('antenna = "antennas/dipole.csv"\nuav = "uav1"', 'uav = "uav1"', "uavs have different antennas")])
def test_what_cannot_be_declared(with_antennas, old, new, message):
    path = with_antennas / "scene.toml"
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new, 1))
    with pytest.raises(BadInput, match=message):
        Scene.load(with_antennas)
