"""Tiles of a large city: which geometry is kept, which links are solved together, and what it costs in decibels."""

import numpy as np
import pytest
import trimesh

from radiotwin.scene.folder import CityShape, read_city
from radiotwin.scene.materials import Material
from radiotwin.trace import SolverSettings, trace_gains, trace_map
from radiotwin.trace.link_job import (
    PackedCity,
    batches_by_place,
    lattice_pieces,
    longest_path_m,
    tile_of,
    with_radius,
)

RAYS = {"samples_per_src": 3_000, "batch_receivers": 40, "max_num_paths_per_src": 20_000}


def boxes(rng, count, side_m=1000.0):
    """(n, 4) rectangles x0, y0, x1, y1 all over a square."""
    low = rng.uniform(0, side_m, (count, 2))
    return np.hstack([low, low + rng.uniform(5, 40, (count, 2))])


def city_of(rectangles, materials=(Material("brick", itu="brick"), Material("concrete", itu="concrete"))):
    return [CityShape(f"b{i}", trimesh.creation.box(bounds=[[x0, y0, 0], [x1, y1, 10]]), materials[i % len(materials)])
            for i, (x0, y0, x1, y1) in enumerate(rectangles)]


def test_kept_are_the_boxes_within_the_radius_of_a_line():
    """Brute force: distances from 4,000 points of the line to each rectangle, by its definition."""
    rng = np.random.default_rng(0)
    rectangles = boxes(rng, 300)
    device_m, end_m, radius_m = np.array([100.0, 200.0, 2.0]), np.array([[850.0, 640.0, 60.0]]), 120.0
    along = np.linspace(0, 1, 4_000)[:, None]
    line_m = device_m[:2] + along * (end_m[0, :2] - device_m[:2])
    aside_m = np.maximum(np.maximum(rectangles[:, None, :2] - line_m, line_m - rectangles[:, None, 2:]), 0)
    distance_m = np.linalg.norm(aside_m, axis=2).min(axis=1)
    kept = PackedCity.of(city_of(rectangles)).near(tile_of(device_m, end_m, radius_m, 1e6))
    sure = np.abs(distance_m - radius_m) > 0.01
    assert (kept == (distance_m <= radius_m))[sure].all() and sure.sum() > 290
    assert 20 < kept.sum() < 200


def test_a_part_has_the_same_triangles():
    shapes = city_of(boxes(np.random.default_rng(2), 30))
    kept = np.arange(30) % 3 == 0
    part = PackedCity.of(shapes).part(kept)
    assert len(part) == 2  # one a material

    def triangles(some, material):
        return sorted(map(tuple, np.concatenate([shape.mesh.triangles for shape in some if shape.material == material])
                          .reshape(-1, 9).round(6).tolist()))

    for material in {shape.material for shape in shapes}:
        assert triangles(part, material) == triangles([each for each, keep in zip(shapes, kept) if keep], material)


def test_the_ground_stays_whole(small_scene):
    shapes = read_city(small_scene.xml_path)
    city = PackedCity.of(shapes)
    spans_m = np.array([np.ptp(shape.mesh.bounds[:, :2], axis=0).min() for shape in shapes])
    device_m = small_scene.device_m[0]
    kept = city.near(tile_of(device_m, device_m[None] + [5, 0, 30], 1.0, 1e6))
    assert kept[spans_m.argmax()] and kept.sum() < len(shapes)


def test_longer_paths_leave_the_line_by_more(small_scene):
    """A path of length L by a point r beside the middle of a line of length d: L² = d² + 4 r². The longest one is 20 dB
    below the limit in free space."""
    device_m, points_m = np.zeros(3), np.array([[300.0, 0.0, 0.0], [0.0, 400.0, 0.0]])
    for radius_m, longest_m, expected_m in ((1e3, 500.0, 200.0), (150.0, 500.0, 150.0), (150.0, 100.0, 0.0)):
        assert tile_of(device_m, points_m, radius_m, longest_m).radius_m == pytest.approx(expected_m)
    frequency_hz = small_scene.config.radio.frequency_hz
    loss_db = 20 * np.log10(longest_path_m(small_scene)) + 20 * np.log10(frequency_hz) - 147.55  # Friis, in Hz and m
    assert loss_db == pytest.approx(20 - small_scene.config.gain_limit_db, abs=0.01)


@pytest.mark.parametrize("count", [0, 1, 40, 41, 1234])
def test_batches_by_place_are_full_and_compact(count):
    rng = np.random.default_rng(count)
    points_m = rng.uniform(0, 1000, (count, 3))
    parts = batches_by_place(points_m, 40)
    assert sorted(np.concatenate([[], *parts])) == list(range(count))
    assert len(parts) == -(-count // 40) and sum(len(part) < 40 for part in parts) <= 1
    if count >= 1000:
        assert np.median([np.ptp(points_m[part, :2], axis=0).max() for part in parts]) < 350


def test_small_cities_are_traced_whole_and_large_ones_by_tiles(small_scene, own_scene, monkeypatch):
    settings = SolverSettings()
    assert with_radius(small_scene, settings) is settings
    monkeypatch.setattr("radiotwin.trace.link_job.MANY_SHAPES", 3)
    assert with_radius(own_scene, settings).radius_m == 400.0
    for given in (float("inf"), 50.0):
        assert with_radius(own_scene, SolverSettings(radius_m=given)).radius_m == given
    assert with_radius(own_scene, SolverSettings(solver="map")).radius_m is None


def test_what_is_solved_together_in_a_small_city_stays_as_it_was(small_scene):
    """Its gains stay the same to the bit: consecutive positions, of the whole city, under the same names."""
    for settings in (SolverSettings(), SolverSettings(radius_m=float("inf"))):
        pieces, order = lattice_pieces(small_scene, settings, [1])
        lattice_m = small_scene.lattice.positions_m
        assert order.tolist() == list(range(len(lattice_m)))
        assert [piece.name for piece in pieces][:2] == ["device-001-batch-00000", "device-001-batch-00001"]
        assert all(piece.tile is None for piece in pieces)
        assert all(np.array_equal(piece.points_m, lattice_m[100 * k:100 * k + 100]) for k, piece in enumerate(pieces))


@pytest.mark.llvm
def test_links_in_the_open_need_nothing_beside_them(small_scene):
    """Culled to 25 m, a link above the roofs keeps its direct path; those beside it are weaker."""
    device_m, lattice_m = small_scene.device_m[:1], small_scene.lattice.positions_m
    seen_m = lattice_m[small_scene.city.line_of_sight(device_m, lattice_m)]
    points_m = seen_m[np.linalg.norm(seen_m - device_m, axis=1).argsort()[:40]]
    whole, culled = (trace_gains(small_scene, device_m, points_m, SolverSettings(**RAYS, radius_m=radius_m))[0]
                     for radius_m in (np.inf, 25.0))
    difference_db = np.abs(whole - culled)
    assert len(points_m) > 20 and np.isfinite(difference_db).all()
    assert np.median(difference_db) < 0.5 and difference_db.max() < 4.0


def test_a_map_by_tiles(own_scene, law, tmp_path):
    """The positions of a map are where they belong, and it says what it was made with."""
    whole = trace_map(own_scene, SolverSettings(batch_receivers=7), tmp_path / "whole.nc", ["d3", "d0"])
    tiled = trace_map(own_scene, SolverSettings(batch_receivers=7, radius_m=30.0), tmp_path / "tiled.nc", ["d3", "d0"])
    assert tiled.gain_db.tobytes() == whole.gain_db.tobytes()
    assert tiled.dataset.attrs["radius_m"] == 30.0 and "radius_m" not in whole.dataset.attrs
    assert tiled.dataset.attrs["trace_hash"] != whole.dataset.attrs["trace_hash"]
