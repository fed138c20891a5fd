"""The quality that reaches an error target; gains come from a law whose error is known for every number of rays."""

import numpy as np
import pytest

from radiotwin.errors import BadInput, RunFailed
from radiotwin.runtime import pieces
from radiotwin.trace import choose_quality


@pytest.fixture
def rays(monkeypatch):
    """Gains of -80 dB, with ten times as many rays of -80 dB plus the error of the fewer ones; notes the calls."""

    class Rays:
        errors_db: dict = {30_000: 2.5, 100_000: 1.2, 500_000: 0.3}  # noqa: RUF012
        below = 0  # points of each call that are not detected
        calls: list = []  # noqa: RUF012

        def __init__(self, xml_path, frequency_hz, settings):
            self.settings = settings

        def batches(self, n):
            return [slice(0, n)]

        def gains(self, device_m, points_m, antennas):
            Rays.calls.append((self.settings.samples_per_src, device_m.tolist(), points_m.tolist()))
            gain_db = np.full(len(points_m), -80.0 + self.errors_db.get(self.settings.samples_per_src // 10, 0.0))
            gain_db[:Rays.below] = np.nan
            return gain_db

    Rays.calls.clear()
    monkeypatch.setattr("radiotwin.trace.plan.PathGains", Rays)
    return Rays


def outdoors(scene):
    return scene.lattice.positions_m[~scene.blocked.ravel()]


@pytest.mark.parametrize(("target_db", "names"), [(3.0, ["fast"]), (2.0, ["fast", "default"]), (1.0, ["fast", "default", "high"])])
def test_the_fewest_rays_that_reach_the_target(small_scene, rays, target_db, names):
    tried = choose_quality(small_scene, outdoors(small_scene), target_db, combining="coherent", seed=7)
    assert [rung.quality for rung in tried] == names
    assert [rung.rms_db for rung in tried] == pytest.approx([2.5, 1.2, 0.3][:len(names)])
    assert [rung.bias_db for rung in tried] == pytest.approx([-2.5, -1.2, -0.3][:len(names)])
    chosen = tried[-1].settings
    assert chosen.samples_per_src == {"fast": 30_000, "default": 100_000, "high": 500_000}[names[-1]]
    assert chosen.combining == "coherent" and chosen.seed == 7
    assert tried[-1].links == 160 and tried[-1].seconds_per_link >= 0


@pytest.mark.parametrize(("arguments", "message"), [
    ({"target_db": float("nan")}, "allowed is 0.05 to 20 dB"), ({"target_db": 1.0, "solver": "map"}, "needs the solver 'paths'"),
    ({"target_db": 1.0, "devices": ["d9"]}, "'d9' is not in"), ({"target_db": 1.0, "combining": "sum"}, "combining = 'sum' is unknown"),
    ({"target_db": 0.1}, "no quality reaches it here; .* over 160 links: fast 2.50 dB, default 1.20 dB, high 0.30 dB")])
def test_what_cannot_be_asked(small_scene, rays, arguments, message):
    with pytest.raises(BadInput, match=message):
        choose_quality(small_scene, outdoors(small_scene), **arguments)


def test_points_in_buildings_say_nothing(small_scene, rays):
    lattice_m = small_scene.lattice.positions_m
    low_m = np.column_stack([lattice_m[:, :2], np.full(len(lattice_m), 2.0)])
    inside = small_scene.city.inside(low_m)
    with pytest.raises(BadInput, match="points are inside buildings"):
        choose_quality(small_scene, low_m[inside], 1.0)
    choose_quality(small_scene, low_m, 3.0)
    solved = {tuple(point_m) for _, _, points_m in rays.calls for point_m in points_m}
    assert solved and solved.isdisjoint(map(tuple, low_m[inside].tolist()))


def test_few_points_are_enough_but_not_few_detected_links(small_scene, rays):
    tried = choose_quality(small_scene, outdoors(small_scene)[:7], 3.0, devices=["d2"])
    assert tried[-1].links == 28 and {tuple(device_m) for _, device_m, _ in rays.calls} == {tuple(small_scene.device_m[2])}
    rays.below = 36
    with pytest.raises(RunFailed, match="of 160 links of the pilot 16 are detected; at least 20 are needed"):
        choose_quality(small_scene, outdoors(small_scene), 1.0)


def test_the_same_question_solves_the_same_links_and_a_second_time_none(small_scene, rays, monkeypatch):
    monkeypatch.setattr(pieces, "MIN_SECONDS", 0.0)
    with pieces.keep_pieces():
        first, calls = choose_quality(small_scene, outdoors(small_scene), 2.0), list(rays.calls)
        assert choose_quality(small_scene, outdoors(small_scene), 2.0) == first and rays.calls == calls
    rays.calls.clear()
    choose_quality(small_scene, outdoors(small_scene), 2.0)
    assert rays.calls == calls
