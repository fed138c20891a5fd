"""A twin of a map that is wrong, of a city traced by Sionna RT, whose code the paths do not share."""

from dataclasses import replace

import numpy as np
import pytest

from radiotwin.links import prepare_links
from radiotwin.maps.radiomap import RadioMap
from radiotwin.maps.survey import fly_survey
from radiotwin.propagation.laws.log_distance import SegmentedLogDistance
from radiotwin.scene.citymap import CityMap
from radiotwin.twin import Twin, fit_twin
from radiotwin.twin import fit_paths as fit_wrong_map
from radiotwin.twin.compare import predict
from radiotwin.twin.fit_links import fit_links
from radiotwin.twin.fit_paths import LOST_M, _calibrated, _with_copies
from radiotwin.twin.localize.estimate import TwinDevice

SHIFT_M = np.array([2.5, -1.5])


def with_map(scene, city):
    other = replace(scene)
    other.__dict__["city"] = city
    return other


@pytest.fixture(scope="module")
def shifted(narrow_street, tmp_path_factory):
    """A scene whose map is shifted, and its twin, loaded from its folder."""
    city = narrow_street.scene.city
    scene = with_map(narrow_street.scene, CityMap(city.vertices + [*SHIFT_M, 0.0], city.faces, city.materials,
                                                  city.material))
    with pytest.warns(UserWarning, match="the 3D map seems to be off: it lies"):
        twin = fit_twin(narrow_street.measured, scene, model="path_kriging", seed=0)
    twin.save(tmp_path_factory.mktemp("shifted") / "twin")
    return scene, Twin.load(tmp_path_factory.getbasetemp() / "shifted0" / "twin")


@pytest.mark.slow
def test_a_shifted_map_is_moved_back_and_devices_stay_in_the_users_frame(narrow_street, shifted):
    scene, twin = shifted
    error = twin.channel.map_error
    assert np.hypot(*(np.array(error.shift_m[:2]) - SHIFT_M)) <= max(error.shift_m[2], 0.75)
    device = next(each for each in twin.devices if each.role == "unknown")
    assert len(twin.devices) == len(narrow_street.measured.devices)
    off_m = np.hypot(*((device.x_m, device.y_m) - narrow_street.position_m))
    assert off_m <= device.credible_radius_m < 30
    anchors = [each for each in twin.devices if each.role == "anchor"]
    declared = narrow_street.measured.devices.set_index("device")
    for each in anchors:
        np.testing.assert_allclose([each.x_m, each.y_m], declared.loc[each.device, ["x_m", "y_m"]].astype(float))


@pytest.mark.slow
def test_over_a_shifted_map_it_predicts_better_than_paths_alone(narrow_street, shifted):
    scene, twin = shifted
    flown = fly_survey(narrow_street.scene, RadioMap.load(scene.folder / "truth.nc"), flights=1,
                       pattern="random-waypoint", seed=5, noise_db=0.0)
    anchors = [each.device for each in twin.devices if each.role == "anchor"]
    flown = flown.select(flown.table["device"].isin(anchors).to_numpy())
    paths = fit_twin(narrow_street.measured, scene, model="paths", seed=0)
    own, theirs = (np.sqrt(np.nanmean((predict(each, scene, flown) - flown.level_db) ** 2)) for each in (twin, paths))
    assert own < 0.8 * theirs and own < 2.5


def test_some_anchors_are_measured_again_as_unknown_devices(narrow_street):
    links = prepare_links(narrow_street.measured, narrow_street.scene)
    doubled = _with_copies(links)
    anchors, count = sorted(links.anchors), len(links.device_names)
    assert len(doubled.device_names) == count + len(anchors) and doubled.anchors == links.anchors
    assert np.isnan(doubled.device_m[count:, :2]).all()
    for number, anchor in enumerate(anchors):
        for field in ("level_db", "receiver_m", "time_s"):
            np.testing.assert_array_equal(getattr(doubled, field)[doubled.device == count + number],
                                          getattr(links, field)[links.device == anchor])
    known = narrow_street.measured.select(narrow_street.measured.is_anchor[narrow_street.measured.device_index])
    no_unknown = prepare_links(replace(known, devices=known.devices[known.devices["role"] == "anchor"]),
                               narrow_street.scene)
    assert _with_copies(no_unknown) is no_unknown


@pytest.mark.parametrize("off_m, factor", [(0.0, 1.0), (5.0, 1.0), (20.0, 2.5)])
def test_radii_grow_as_the_errors_of_anchors_show(narrow_street, off_m, factor):
    """Within a radius of 10 m that holds 90 %, the mean square of errors is 10² / ln 10."""
    links = prepare_links(narrow_street.measured, narrow_street.scene)
    own = [TwinDevice(name, 0.0, 0.0, 1.5, "unknown", True, 8.0, None) for name in links.device_names]
    copies = [TwinDevice("copy", *(links.device_m[anchor, :2] + [off_m, 0.0]), 1.5, "unknown", True, 10.0, None)
              for anchor in sorted(links.anchors)]
    found = _calibrated(own + copies, links)
    n = len(copies)
    expected = max(np.sqrt((2 + n * np.log(10) * (off_m / 10) ** 2) / (2 + n)), 1.0)
    assert len(found) == len(own) and abs(expected - factor) < 0.4
    np.testing.assert_allclose([each.credible_radius_m for each in found], 8.0 * expected)
    assert found[0].credible_radius_m < LOST_M


def test_a_copy_that_is_not_located_says_nothing(narrow_street):
    links = prepare_links(narrow_street.measured, narrow_street.scene)
    own = [TwinDevice(name, 0.0, 0.0, 1.5, "unknown", True, 8.0, None) for name in links.device_names]
    copies = [TwinDevice("copy", 1e4, 1e4, 1.5, "unknown", False, 10.0, None) for _ in links.anchors]
    assert [each.credible_radius_m for each in _calibrated(own + copies, links)] == [8.0] * len(own)


def test_where_the_map_is_shifted_back_an_anchor_beside_a_wall_is_right_and_an_earlier_twin_moves_too(
        narrow_street, monkeypatch):
    scene, measured = narrow_street.scene, narrow_street.measured
    links = prepare_links(measured, scene)
    anchor_m = links.device_m[sorted(links.anchors)]
    steps_m = np.stack(np.meshgrid(np.arange(-60.0, 61, 3), np.arange(-60.0, 61, 3), [0.0]), axis=-1).reshape(-1, 3)
    shift_m = next(step_m for step_m in steps_m if scene.city.inside(anchor_m + step_m).any())
    assert not scene.city.inside(anchor_m).any()
    seen = {}

    def paths(moved, scene, seed, start, executor):
        law = fit_links(moved, scene, SegmentedLogDistance, seed)
        seen.update(law=law, start=start)
        raise KeyboardInterrupt

    monkeypatch.setattr(fit_wrong_map, "_shift", lambda links, seed: (shift_m[0], shift_m[1], 1.0))
    monkeypatch.setattr(fit_wrong_map, "fit_along_paths", paths)
    earlier = fit_twin(measured, scene, model="segmented_log_distance", seed=0)
    with pytest.raises(KeyboardInterrupt):
        fit_twin(measured, scene, model="path_kriging", seed=0, start=earlier)
    for device, before in zip(seen["start"].devices, earlier.devices, strict=True):
        np.testing.assert_allclose([device.x_m, device.y_m], [before.x_m + shift_m[0], before.y_m + shift_m[1]])
    on_map_m = [(each.x_m, each.y_m) for each in seen["law"].devices if each.role == "anchor"]
    np.testing.assert_allclose(on_map_m[:len(anchor_m)], (anchor_m + shift_m)[:, :2])
