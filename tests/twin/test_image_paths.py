"""A twin that follows paths, of a city traced by Sionna RT, whose code the paths do not share."""

import numpy as np
import pytest

from radiotwin.errors import BadInput
from radiotwin.links.measurements import Measurements
from radiotwin.maps.radiomap import RadioMap
from radiotwin.maps.survey import fly_survey, segmented_truth
from radiotwin.runtime import pieces
from radiotwin.twin import Twin, fit_twin
from radiotwin.twin.compare import predict
from radiotwin.twin.localize import Relocation


@pytest.fixture(scope="module")
def twin(narrow_street, tmp_path_factory):
    folder = tmp_path_factory.mktemp("raytraced") / "twin"
    fit_twin(narrow_street.measured, narrow_street.scene, model="paths", seed=0).save(folder)
    return Twin.load(folder)


def rmse_db(twin, scene, devices, seed):
    """Return the RMSE on flights of another seed, of all links and of those in the shadow [dB]."""
    flown = fly_survey(scene, RadioMap.load(scene.folder / "truth.nc"), flights=1, pattern="random-waypoint", seed=seed,
                       noise_db=0.0)
    flown = flown.select(flown.table["device"].isin(devices).to_numpy())
    error_db = predict(twin, scene, flown) - flown.level_db
    los = scene.city.line_of_sight(flown.device_m[flown.device_index], flown.receiver_m)
    return [np.sqrt(np.nanmean(error_db[rows] ** 2)) for rows in (slice(None), ~los)]


def test_it_predicts_other_flights_far_better_than_a_law(narrow_street, twin):
    scene, measured = narrow_street.scene, narrow_street.measured
    law = fit_twin(measured, scene, model="segmented_nn", seed=0)
    devices = list(measured.devices["device"])
    for by_paths, by_law in zip(*(rmse_db(each, scene, devices, 5) for each in (twin, law))):
        assert by_paths < 3.5 and by_paths < 0.6 * by_law
    device = next(each for each in twin.devices if each.role == "unknown")
    assert np.hypot(*((device.x_m, device.y_m) - narrow_street.position_m)) < 4.0
    assert device.located and device.credible_radius_m < 15


def test_an_earlier_twin_saves_most_of_the_search(narrow_street, twin, monkeypatch):
    positions = set()
    follow = Relocation.follow

    def counted(self, city, position_m, *others):
        positions.add(position_m)
        return follow(self, city, position_m, *others)

    monkeypatch.setattr(Relocation, "follow", counted)
    again = fit_twin(narrow_street.measured, narrow_street.scene, model="paths", seed=0, start=twin)
    for before, after in zip(twin.devices, again.devices):
        assert np.hypot(before.x_m - after.x_m, before.y_m - after.y_m) <= 1.5
    assert 0 < len(positions) < 20  # at least that many cells are tried where nothing is known


def test_a_map_that_does_not_explain_the_levels_is_warned_of(narrow_street):
    scene = narrow_street.scene
    flown = fly_survey(scene, segmented_truth(scene), flights=1, pattern="random-waypoint", seed=0, noise_db=0.0)
    anchors = flown.select(flown.is_anchor[flown.device_index])
    measured = Measurements(anchors.table, narrow_street.measured.devices)
    with pytest.warns(UserWarning, match="explain these levels worse than a law"):
        fit_twin(measured, scene, model="paths", seed=0)


def test_paths_do_not_go_indoors(narrow_street):
    with pytest.raises(BadInput, match="outside buildings only"):
        fit_twin(narrow_street.measured, narrow_street.scene, model="paths", seed=0, allow_indoor=True)


def test_what_was_not_heard_is_not_invented(narrow_street):
    """Anchors with line of sight alone, stronger than paths bring, and a device that was heard three times."""
    scene, measured, name = narrow_street.scene, narrow_street.measured, narrow_street.name
    table = measured.table.assign(gain_db=measured.table["gain_db"] + 6.0)
    mine = (table["device"] == name).to_numpy()
    los = scene.city.line_of_sight(measured.device_m[measured.device_index], measured.receiver_m)
    table.loc[np.flatnonzero(mine)[3:], "gain_db"] = np.nan
    some = Measurements(table[mine | los].reset_index(drop=True), measured.devices)
    with pytest.warns(UserWarning, match=r"only 0 links without line of sight .* others, [56]\.\d dB") as warned:
        twin = fit_twin(some, scene, model="paths", seed=0)
    assert not any("worse than a law" in str(each.message) for each in warned)
    los_db, nlos_db = twin.fitted.level_coefficients[:2]
    assert los_db == nlos_db == pytest.approx(6.0, abs=0.6)
    device = next(each for each in twin.devices if each.device == name)
    assert not device.located or device.credible_radius_m > 15


@pytest.mark.slow
def test_a_killed_fit_goes_on_and_ends_equal_to_the_bit(narrow_street, tmp_path, monkeypatch):
    monkeypatch.setattr(pieces, "MIN_SECONDS", 0.0)
    put = pieces.PieceStore.put

    def files(folder):
        fit_twin(narrow_street.measured, narrow_street.scene, model="paths", seed=0).save(folder)
        return [(folder / name).read_bytes() for name in ("twin.json", "channel.safetensors")]

    def killed(self, name, *args):
        put(self, name, *args)
        if name.startswith("position-"):
            raise KeyboardInterrupt

    whole = files(tmp_path / "whole")
    with monkeypatch.context() as patched, pieces.keep_pieces() as store, pytest.raises(KeyboardInterrupt):
        patched.setattr(pieces.PieceStore, "put", killed)
        files(tmp_path / "killed")
    monkeypatch.setattr(Relocation, "follow", lambda *_: pytest.fail("searched for again"))
    with pieces.keep_pieces() as again:
        assert files(tmp_path / "resumed") == whole
    assert again.earlier == store.saved >= 3
