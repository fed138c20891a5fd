"""Unknown devices where paths put them, in a city traced by Sionna RT, whose code the paths do not share."""

from pathlib import Path

import numpy as np
import pytest

from radiotwin.closeloop import relocation
from radiotwin.closeloop.bases import TwinBase
from radiotwin.closeloop.raytraced import RaytraceBase
from radiotwin.closeloop.records import make_records
from radiotwin.measurements import Measurements
from radiotwin.radiomap import RadioMap
from radiotwin.scene import Scene
from radiotwin.survey import fly_survey

RBM = Path(__file__).parents[2] / "scenes" / "rbm"
IN_A_NARROW_STREET = "d4"


@pytest.fixture(scope="module")
def city():
    """Anchors and one unknown device in a narrow street: where it is, and its links."""
    scene = Scene.load(RBM)
    table = fly_survey(scene, RadioMap.read(RBM / "truth.nc"), flights=3, pattern="random-waypoint", seed=0,
                       noise_db=1.0)
    devices = table.devices[(table.devices["role"] == "anchor") | (table.devices["device"] == IN_A_NARROW_STREET)]
    every_third = np.unique(table.table["time_s"], return_inverse=True)[1] % 3 == 0
    links = table.table[table.table["device"].isin(devices["device"]) & every_third]
    place_m = next(np.array([each.x_m, each.y_m]) for each in scene.config.devices
                   if each.device == IN_A_NARROW_STREET)
    return scene, place_m, Measurements(links.reset_index(drop=True), devices.reset_index(drop=True))


def found(base):
    """Where a fitted base has the device, and its circle's radius."""
    device = next(each for each in base.found if each.device == IN_A_NARROW_STREET)
    return np.array([device.x_m, device.y_m]), device.credible_radius_m


def test_paths_find_a_device_in_a_narrow_street_that_a_law_puts_where_it_would_see_more(city, monkeypatch):
    scene, place_m, measured = city
    records = make_records(measured, scene)
    law = TwinBase(scene, 0)
    base = RaytraceBase(law)
    assert np.linalg.norm(found(law.fit(records))[0] - place_m) > 15
    there_m, radius_m = found(base.fit(records))
    assert np.linalg.norm(there_m - place_m) < min(4.0, max(radius_m, 2.0))
    # A part of the links asks for the same paths and a few more places.
    followed = {place: len(ends) for place, ends in base._relocation.powers.items()}
    part = records.select(records.flight != 0)
    there_m, _ = found(base.fit(part))
    assert np.linalg.norm(there_m - place_m) < 4.0
    assert all(len(base._relocation.powers[place]) == count for place, count in followed.items())
    assert max(followed.values()) <= relocation.LINKS < (records.device == records.device_names.index(
        IN_A_NARROW_STREET)).sum()
    # Where its errors are too large beside those of others, or devices are too many, it stays.
    for limit in ("MOST_MISFIT", "MOST_DEVICES"):
        with monkeypatch.context() as changed:
            changed.setattr(relocation, limit, 0)
            assert base.fit(part).found == law.fit(part).found


def test_a_device_that_may_be_anywhere_stays_where_the_law_has_it(city):
    """Its levels are those of open ground, which the law cannot place in a city."""
    scene, _, measured = city
    table, place_m = measured.table.copy(), np.array([300.0, 300.0])
    mine = table["device"] == IN_A_NARROW_STREET
    distance_m = np.hypot(table["receiver_x_m"] - place_m[0], table["receiver_y_m"] - place_m[1])
    noise_db = np.random.default_rng(2).normal(0, 1, len(table))
    table.loc[mine, "gain_db"] = (-60 - 22 * np.log10(np.hypot(distance_m, 50.0)) + noise_db)[mine]
    records = make_records(Measurements(table, measured.devices), scene)
    law = TwinBase(scene, 0)
    assert found(law.fit(records))[1] > relocation.MOST_RADIUS_M
    assert RaytraceBase(law).fit(records).found == law.fit(records).found
