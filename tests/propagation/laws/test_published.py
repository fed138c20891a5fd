"""Published laws against numbers of their recommendations, worked out by hand or of published tables, and what all of
them have in common."""

import dataclasses

import numpy as np
import pytest
import trimesh

from radiotwin.errors import BadInput
from radiotwin.links import LinkGeometry
from radiotwin.propagation.laws.aerial import (
    AlHouraniDenseUrban,
    AlHouraniHighRise,
    AlHouraniSuburban,
    AlHouraniUrban,
    UrbanMacro,
    UrbanMicro,
)
from radiotwin.propagation.laws.published import (
    P1411,
    PublishedLaw,
    WalfischIkegami,
    WalfischIkegamiMetropolitan,
)
from radiotwin.propagation.laws.registry import BUILT_IN, decode_both, encode_channel
from radiotwin.scene.citymap import CityMap

LAWS = [each for each in BUILT_IN if issubclass(each, PublishedLaw)]


def link(high_m, low_m=1.5, *, ground_m=None, distance_m=None, los=True, **given):
    """One link of a device at `low_m` and a receiver at `high_m`, so far apart on the ground, or through the air."""
    flat_m = ground_m if distance_m is None else np.sqrt(distance_m**2 - (high_m - low_m) ** 2)
    return LinkGeometry(np.array([[0.0, 0, low_m]]), np.array([[flat_m, 0.0, high_m]]), np.array([los]),
                        np.zeros(1, int), **given)


def turned(links):
    """The same with exchanged ends: a mast's link with a phone."""
    return dataclasses.replace(links, device_m=links.receiver_m, receiver_m=links.device_m)


def loss_db(law, links):
    return -law.predict(links)[0][0]


@pytest.fixture
def block():
    """A map with a block of 20 m and one of 10 m, equally large, on a plane."""
    boxes = [trimesh.creation.box(extents=(40, 40, 20)), trimesh.creation.box(extents=(40, 40, 10))]
    boxes[0].apply_translation((100, 100, 10))
    boxes[1].apply_translation((300, 100, 5))
    plane = trimesh.Trimesh([(0, 0, 0), (400, 0, 0), (400, 200, 0), (0, 200, 0)], [(0, 1, 2), (0, 2, 3)])
    mesh = trimesh.util.concatenate([*boxes, plane])
    return CityMap(mesh.vertices, mesh.faces)


@pytest.mark.parametrize("law, los, expected_db, sd_db", [
    # TR 36.777, Table B-2 and B-3, at 60 m, 500 m, 2.4 GHz: 28 + 22 log 500 + 20 log 2.4;
    # -17.5 + (46 - 7 log 60) log 500 + 20 log(40 pi 2.4 / 3); 4.64 exp(-0.396)
    (UrbanMacro, True, 94.982, 3.123), (UrbanMacro, False, 113.104, 6.0),
    # the greater of free space (94.03) and 30.9 + (22.25 - 0.5 log 60) log 500 + 20 log 2.4;
    # 32.4 + (43.2 - 7.6 log 60) log 500 + 20 log 2.4; 5 exp(-0.6)
    (UrbanMicro, True, 96.157, 2.744), (UrbanMicro, False, 120.126, 8.0),
])
def test_tr_36777_at_60_m(law, los, expected_db, sd_db):
    mean_db, found_sd_db = law(2.4e9, True).predict(link(60.0, distance_m=500.0, los=los))
    assert -mean_db[0] == pytest.approx(expected_db, abs=2e-3) and found_sd_db[0] == pytest.approx(sd_db, abs=1e-3)


@pytest.mark.parametrize("high_m, ground_m, macro, micro", [  # Table B-1
    (50.0, 300.0, 0.94027, 0.58720), (50.0, 1000.0, 0.77205, 0.14162), (100.0, 600.0, 0.92558, 0.46376),
    (30.0, 200.0, 0.93140, 0.59937), (50.0, 50.0, 1.0, 1.0), (150.0, 3000.0, 1.0, 0.07152)])
def test_tr_36777_probability_of_line_of_sight(high_m, ground_m, macro, micro):
    links = link(high_m, ground_m=ground_m)
    assert UrbanMacro(2.4e9).los_probability(links)[0] == pytest.approx(macro, abs=1e-5)
    assert UrbanMicro(2.4e9).los_probability(links)[0] == pytest.approx(micro, abs=1e-5)


@pytest.mark.parametrize("law, best_deg", [(AlHouraniSuburban, 20.34), (AlHouraniUrban, 42.44),
                                           (AlHouraniDenseUrban, 54.62), (AlHouraniHighRise, 75.52)])
def test_al_hourani_reaches_farthest_at_the_elevations_of_the_paper(law, best_deg):
    """Table of the letter at 2 GHz: the elevation at which a given loss is met farthest away on the ground."""
    elevation = np.radians(np.arange(5, 89, 0.01))
    ends_m = 1000 * np.column_stack([np.cos(elevation), 0 * elevation, np.sin(elevation)])
    links = LinkGeometry(np.zeros_like(ends_m), ends_m, np.ones(len(ends_m), bool), np.zeros(len(ends_m), int))
    reach = law(2e9).predict(links)[0] / 20 + np.log10(np.cos(elevation))
    assert np.degrees(elevation[reach.argmax()]) == pytest.approx(best_deg, abs=0.1)


def test_al_hourani_adds_its_excess_loss_to_free_space():
    """Urban, 2 GHz: 98.47 dB of free space at 1 km, and 1 or 20 dB; shadowing 10.39 exp(-0.05 * 30) and 29.6 exp(-0.9)."""
    for los, excess_db, sd_db in ((True, 1.0, 2.318), (False, 20.0, 12.034)):
        links = link(501.5, distance_m=1000.0, los=los)  # 500 m up, 1000 m away: 30 degrees
        mean_db, found_sd_db = AlHouraniUrban(2e9, True).predict(links)
        assert -mean_db[0] == pytest.approx(98.47 + excess_db, abs=0.01)
        assert found_sd_db[0] == pytest.approx(sd_db, abs=2e-3)


@pytest.mark.parametrize("los, high_m, ghz, distance_m, line_db", [
    # Sec. 4.2.1, over roofs: reference values beside the software of ITU-R Study Group 3
    # (github.com/eeveetza/p1411, reference_p1411.csv)
    (True, 30, 2.2, 55, 75.16579013), (True, 30, 28, 800, 123.4450581),
    (False, 30, 2.2, 260, 107.6230516), (False, 30, 28, 800, 154.4602851),
    # Sec. 4.1.1, Table 4 by hand: 21.2 log d + 29.2 + 21.1 log f; 40 log d + 10.2 + 23.6 log f
    (True, 10, 2.4, 100, 79.62227), (True, 10, 28, 300, 112.24995), (False, 10, 2.4, 100, 99.17299),
    (False, 10, 28, 300, 143.43835), (False, 10, 2.4, 60, 90.29904), (False, 10, 2.4, 10, 59.17299)])
def test_p1411_is_a_line_and_without_sight_a_sum_with_free_space(los, high_m, ghz, distance_m, line_db):
    """Without sight: free space, and 10 log10(10^(A / 10) + 1) on top, where A is what the line exceeds it by."""
    free_db = 20 * np.log10(4 * np.pi * distance_m * ghz * 1e9 / 299_792_458)
    expected_db = line_db if los else free_db + 10 * np.log10(10 ** ((line_db - free_db) / 10) + 1)
    law = P1411(ghz * 1e9, True, roof_m=15.0)
    assert loss_db(law, link(high_m, distance_m=distance_m, los=los)) == pytest.approx(expected_db, abs=2e-3)


@pytest.mark.parametrize("law, high_m, kilometres, los, expected_db", [
    # 900 MHz, roofs at 15 m, mobile at 1.5 m, w = 17.5 m, b = 35 m, across the street:
    # 42.6 + 26 log 1 + 20 log 900
    (WalfischIkegami, 30.0, 1.0, True, 101.685),
    # free space 91.535; L_rts -16.9 - 12.430 + 29.542 + 22.607 + 0.01 = 22.829;
    # L_msd -18 log 16 + 54 + 0 + (-4 + 0.7 * (900 / 925 - 1)) 2.954 - 13.897 = 6.556
    (WalfischIkegami, 30.0, 1.0, False, 120.920),
    (WalfischIkegamiMetropolitan, 30.0, 1.0, False, 120.856),
    # base below the roofs at 300 m: k_a = 54 + 0.8 * 5 * 0.6, k_d = 18 + 15 * 5 / 15
    (WalfischIkegami, 10.0, 0.3, False, 122.510),
    (WalfischIkegami, 1.5, 0.01, True, 51.535)])  # free space within 20 m: 32.45 + 20 log(900 * 0.01)
def test_walfisch_ikegami_by_hand(law, high_m, kilometres, los, expected_db):
    links = link(high_m, distance_m=1000 * kilometres, los=los)
    assert loss_db(law(900e6, True, roof_m=15.0), links) == pytest.approx(expected_db, abs=2e-3)


def test_without_a_map_both_branches_are_mixed():
    """Mean and variance of a mixture, by drawing from it."""
    law, links = UrbanMicro(2.4e9), link(60.0, ground_m=300.0)
    share = law.los_probability(links)[0]
    (seen_db, seen_sd_db), (hidden_db, hidden_sd_db) = (
        [value[0] for value in UrbanMicro(2.4e9, True).predict(dataclasses.replace(links, los=np.array([los])))]
        for los in (True, False))
    rng = np.random.default_rng(0)
    drawn_db = np.where(rng.uniform(size=400_000) < share, rng.normal(seen_db, seen_sd_db, 400_000),
                        rng.normal(hidden_db, hidden_sd_db, 400_000))
    mean_db, sd_db = law.predict(links)
    assert mean_db[0] == pytest.approx(drawn_db.mean(), abs=0.1) and sd_db[0] == pytest.approx(drawn_db.std(), rel=0.01)


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("high_m", [20.0, 60.0])
def test_the_ends_may_change_places_and_what_was_stored_predicts_the_same(law, high_m):
    """But for TR 36.777: a receiver at 60 m is a UAV, and a device there is a mast."""
    fitted = law(2e9, True, roof_m=15.0, power_dbm=20.0)
    for los in (True, False):
        links = link(high_m, ground_m=300.0, los=los)
        if law not in (UrbanMacro, UrbanMicro) or high_m < 22.5:
            np.testing.assert_allclose(fitted.predict(links), fitted.predict(turned(links)))
        assert fitted.predict(links)[0] == law(2e9, True, roof_m=15.0).predict(links)[0] + 20.0
        stored, _ = decode_both(encode_channel(fitted), "test")
        np.testing.assert_array_equal(stored.predict(links), fitted.predict(links))


@pytest.mark.parametrize("law", LAWS)
def test_levels_decide_nothing(law, block, world):
    """Frequency and roofs, whose mean height counts by area, are all that is taken from links, of which there may be none."""
    data = world(0, 50)
    links = dataclasses.replace(data.links, frequency_hz=2e9, city=block)
    of_none, of_all = (law().fit(some, level_db, None) for some, level_db in (
        (links.select(np.zeros(50, bool)), np.zeros(0)), (links, data.level_db + 40)))
    np.testing.assert_array_equal(of_none.predict(links), of_all.predict(links))
    assert of_all.roof_m == pytest.approx(0.0 if law in (UrbanMacro, UrbanMicro) else 15.0, abs=0.5)


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("frequency_hz, message", [(np.nan, "is not known"), (1e8, "0.1 GHz"), (4e11, "400 GHz")])
def test_a_frequency_far_outside_is_refused(law, block, frequency_hz, message):
    with pytest.raises(BadInput, match=message):
        law().fit(link(60.0, ground_m=300.0, frequency_hz=frequency_hz, city=block), np.zeros(1), None)


@pytest.mark.parametrize("law", [each for each in LAWS if each.needs_map])
def test_laws_of_cities_need_one(law):
    with pytest.raises(BadInput, match="needs a 3D map"):
        law().fit(link(60.0, ground_m=300.0, frequency_hz=2e9), np.zeros(1), None)
    plane = CityMap([(0, 0, 0), (400, 0, 0), (400, 200, 0)], [(0, 1, 2)])
    with pytest.raises(BadInput, match="no building"):
        law().fit(link(60.0, ground_m=300.0, frequency_hz=2e9, city=plane), np.zeros(1), None)


@pytest.mark.parametrize("law, high_m, ground_m, ghz, los_db, nlos_db, probability", [
    # TR 38.901, Table 7.4.1-1 and -2, base station at 10 to 25 m, terminal at 1.5 m: breakpoints at
    # 4 (high - 1) 0.5 f / c = 304.2 m (20 m, 2.4 GHz), 320.2 m (25 m, 2 GHz) and 120.1 m (10 m, 2 GHz)
    (UrbanMacro, 20.0, 100.0, 2.4, 79.765, 99.590, 0.34767), (UrbanMacro, 20.0, 1000.0, 2.4, 110.896, 138.387, 0.018),
    (UrbanMicro, 20.0, 100.0, 2.4, 82.158, 101.356, 0.23098), (UrbanMicro, 20.0, 1000.0, 2.4, 112.812, 136.401, 0.018),
    (UrbanMacro, 25.0, 200.0, 2.0, 84.709, 109.601, 0.12805), (UrbanMacro, 25.0, 500.0, 2.0, 96.879, 125.055, 0.03634),
    (UrbanMicro, 10.0, 100.0, 2.0, 80.453, 99.467, 0.23098)])
def test_tr_38901_of_low_receivers_and_of_masts_however_high(law, high_m, ground_m, ghz, los_db, nlos_db, probability):
    """The higher end is a base station: the device, or a receiver up to 22.5 m."""
    ends = [turned(link(high_m, ground_m=ground_m))] + ([link(high_m, ground_m=ground_m)] if high_m < 22.5 else [])
    for links in ends:
        for los, expected_db in ((True, los_db), (False, nlos_db)):
            seen = dataclasses.replace(links, los=np.array([los]))
            assert loss_db(law(ghz * 1e9, True), seen) == pytest.approx(expected_db, abs=2e-3)
        assert law(ghz * 1e9).los_probability(links)[0] == pytest.approx(probability, abs=2e-5)
    assert law(2e9).los_probability(link(20.0, ground_m=10.0))[0] == 1.0
    across = [loss_db(law(2e9), turned(link(mast_m, ground_m=200.0))) for mast_m in (23.0, 22.0)]
    assert across[0] == pytest.approx(across[1], abs=0.2)


@pytest.mark.parametrize("law, links, expected", [
    (UrbanMacro(2e9, True), link(60.0, 25.0, distance_m=400.0), []),  # as in the report
    (WalfischIkegami(900e6, True, roof_m=15.0), link(30.0, distance_m=400.0), []),
    (UrbanMicro(2e9, True), link(60.0, 25.0, distance_m=400.0),
     ["the height of the lower end is 25 m, published is 1.5 to 22.5 m"]),
    (UrbanMacro(2e9, True), link(150.0, distance_m=400.0), []),
    (UrbanMacro(2e9, True), link(150.0, distance_m=400.0, los=False),
     ["the height of the higher end is 150 m, published is 1.5 to 100 m"]),
    (UrbanMacro(2e9), link(150.0, distance_m=4500.0), ["the distance is 4,500 m, published is 10 to 4000 m"]),
    (UrbanMacro(2e9), link(20.0, distance_m=4500.0), []),
    (P1411(0.9e9, True, roof_m=20.0), link(10.0, distance_m=400.0), []),
    (P1411(0.9e9, True, roof_m=20.0), link(60.0, distance_m=400.0),
     ["the frequency is 0.9 GHz, published is 2.2 to 73 GHz"]),
    (P1411(3e9, True, roof_m=20.0), link(10.0, distance_m=1000.0), ["the distance is 1,000 m, published is 5 to 660 m"]),
    (P1411(3e9, True, roof_m=20.0), link(60.0, distance_m=200.0, los=False),
     ["the distance is 200 m, published is 260 to 1200 m"]),
    (AlHouraniUrban(2e9, True, roof_m=15.0), link(2.0, distance_m=100.0),
     ["the height of the higher end is 2 m, published is 15 and more m"]),
    (AlHouraniUrban(2e9, True, roof_m=15.0), link(16.0, distance_m=100.0), [])])
def test_each_branch_has_the_range_that_it_was_published_for(law, links, expected):
    notes = law.outside(links)
    assert len(notes) == len(expected) and all(each in note for each, note in zip(expected, notes))
    assert law.inside(links).tolist() == [not expected]


@pytest.mark.parametrize("law", [UrbanMacro, UrbanMicro])
def test_above_the_published_heights_the_highest_of_them_holds(law):
    for los in (True, False):
        found = [law(2.4e9, True).predict(link(high_m, distance_m=1000.0, los=los))[0][0] for high_m in (300.0, 450.0)]
        assert found[0] == found[1]


def test_what_is_outside_is_named_once_each():
    law = WalfischIkegami(2.4e9, True, roof_m=15.0)
    two = [link(60.0, 1.5, distance_m=400.0), link(70.0, 1.5, distance_m=400.0)]
    both = LinkGeometry(*(np.concatenate([getattr(each, name) for each in two])
                          for name in ("device_m", "receiver_m", "los", "device")))
    notes = law.outside(both)
    assert len(notes) == 2
    assert "the frequency is 2.4 GHz, published is 0.8 to 2 GHz" in notes[0]
    assert "height of the higher end is 60 to 70 m in 100% of the links, published is 4 to 50 m" in notes[1]


@pytest.mark.parametrize("change, message", [
    ({"frequency_hz": 1e12}, "frequency_hz"), ({"with_map": 1}, "with_map"), ({"with_map": False}, "needs a map"),
    ({"roof_m": 0.0}, "roof_m"), ({"more": 1}, "more")])
def test_damaged_ones_are_refused(change, message):
    settings = P1411(2e9, True, roof_m=15.0).state()[1] | change
    with pytest.raises(ValueError, match=message):
        P1411.from_state({}, settings)
