"""Sectors whose azimuths a table declares, one of them held out: what nobody measured is predicted.

Levels are made here: a law, a cardioid raised to a power (no pattern of 3GPP), a level of each sector's own.
"""

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

import radiotwin as rt
from radiotwin.closeloop.output.corrected_twin import corrected_twin
from radiotwin.closeloop.predict.baselines import EXTRA_TREES, grow_trees
from radiotwin.closeloop.search.declared import add_declared
from radiotwin.closeloop.search.stages import SearchState, search
from radiotwin.effects.antennas import SectorPattern
from radiotwin.effects.base import GainEffect
from radiotwin.effects.catalogue.declared_sectors import DeclaredSectors
from radiotwin.effects.registry import BUILT_IN
from radiotwin.links import prepare_links
from radiotwin.links.measurements import Measurements
from radiotwin.links.variables import link_features
from radiotwin.report.closeloop_figures import waterfall_figure
from radiotwin.twin.model.blend import Blend
from radiotwin.twin.model.uncertainty import estimates, linearise
from tests.closeloop.looking import based

MASTS_M = np.array([[150.0, 200.0, 25.0], [420.0, 330.0, 25.0]])
AZIMUTHS_DEG = (20.0, 140.0, 260.0)
SEEDS = [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))]
NAMES = [f"{mast}{sector}" for mast in "AB" for sector in range(3)]


def network(seed, noise_db=3.0, points=400, tilts_deg=None):
    """Drive through the streets below two masts of three sectors, flat or with tilts of each mast's own."""
    rng = np.random.default_rng(seed)
    parts = []
    for flight in range(5):
        turn = rng.normal(0, 0.1, points // 5).cumsum() + rng.uniform(0, 2 * np.pi)
        place_m = rng.uniform(50, 500, 2) + 12 * np.cumsum(np.column_stack([np.cos(turn), np.sin(turn)]), axis=0)
        place_m = 275 + 260 * np.sin((place_m - 275) / 260)
        for number, name in enumerate(NAMES):
            to_m = place_m - MASTS_M[number // 3, :2]
            off = np.radians(np.degrees(np.arctan2(to_m[:, 0], to_m[:, 1])) - AZIMUTHS_DEG[number % 3])
            antenna_db = 10 * np.log10(0.006 + 0.994 * np.cos(off / 2) ** 8)
            distance_m = np.hypot(np.linalg.norm(to_m, axis=1), 23.5)
            if tilts_deg is not None:
                above = -np.arcsin(23.5 / distance_m) - np.radians(tilts_deg[number // 3])
                antenna_db += 10 * np.log10(0.01 + 0.99 * np.cos(np.clip(above, -1.5, 1.5)) ** 50)
            level_db = -30 - 30 * np.log10(distance_m) + antenna_db + (number % 3 - 1)
            parts.append(pd.DataFrame({
                "time_s": 1000.0 * flight + np.arange(len(place_m)), "flight": f"f{flight}", "receiver": "car",
                "receiver_x_m": place_m[:, 0], "receiver_y_m": place_m[:, 1], "receiver_z_m": 1.5, "device": name,
                "gain_db": level_db + rng.normal(0, noise_db, len(place_m))}))
    where_m = MASTS_M[np.arange(len(NAMES)) // 3]
    devices = pd.DataFrame({"device": NAMES, "x_m": where_m[:, 0], "y_m": where_m[:, 1], "z_m": where_m[:, 2],
                            "role": "anchor", "frequency_hz": 3.6e9, "azimuth_deg": np.tile(AZIMUTHS_DEG, 2)})
    return Measurements(pd.concat(parts, ignore_index=True), devices)


def taken(measurements):
    """Return the base log-distance, a device held out, with what is declared, the score and the notes."""
    base, inputs = based(measurements, *(effect() for effect in BUILT_IN), by="device")
    result = search(SearchState(base), [add_declared], inputs)
    whole, parameters = result.model.whole, {}
    for each, estimate in zip(whole.effects, estimates(linearise(whole)), strict=True):
        parameters |= each.parameters(inputs.links, estimate)
    return SimpleNamespace(before_db=base.rmse_db(), after_db=result.model.rmse_db(), scores=result.log.trials,
                           params=whole.effects[0].params if whole.effects else None, parameters=parameters,
                           variants=[each.variant for each in whole.effects],
                           note=([*result.model.links.notes, *result.notes] or [""])[-1])


@pytest.mark.parametrize("seed", SEEDS)
def test_a_sector_that_was_not_measured_is_predicted_by_its_declared_azimuth(seed):
    found = taken(network(seed))
    assert found.variants == [DeclaredSectors.variant]
    assert found.before_db > 6.5
    assert found.after_db < 4.2  # the noise is 3 dB, levels of sectors 0.8 dB
    assert f"{found.after_db:.2f} dB, and {found.before_db:.2f} dB without them" in found.note


@pytest.mark.parametrize("turn_deg", [pytest.param(60.0, marks=pytest.mark.slow), 180.0])
def test_azimuths_that_the_readings_contradict_are_left_out_and_told(turn_deg):
    """Between the neighbours, or backwards: the table is wrong, and is not believed."""
    measurements = network(2)
    devices = measurements.devices.assign(azimuth_deg=(measurements.devices["azimuth_deg"] + turn_deg) % 360)
    found = taken(replace(measurements, devices=devices))
    assert found.variants == []
    assert found.after_db == found.before_db
    turned = re.search(r"left out: they fit azimuths that are all turned by ([+-]\d+)°", found.note)
    assert abs((float(turned[1]) + turn_deg + 180) % 360 - 180) < 10


@pytest.mark.parametrize(("wrong", "by_deg"), [(None, 0.0), (4, 120.0), (1, -60.0)])
def test_one_wrong_azimuth_is_named_among_right_ones(wrong, by_deg):
    """All azimuths are 2 degrees off, one by more: its own readings put it back, and nobody else is named."""
    measurements = network(1)
    azimuth_deg = measurements.devices["azimuth_deg"].to_numpy() + 2
    if wrong is not None:
        azimuth_deg[wrong] += by_deg
    devices = measurements.devices.assign(azimuth_deg=azimuth_deg % 360)
    model, inputs = based(replace(measurements, devices=devices), by="block")
    view = model.whole.view
    (params,) = DeclaredSectors().propose(view)
    assert list(params.own_turns_deg) == ([] if wrong is None else [wrong])
    for turn_deg, sd_deg in params.own_turns_deg.values():
        assert abs(turn_deg + by_deg) < 12 and sd_deg < 12
    said = DeclaredSectors().with_params(params).contradicted_declarations(inputs.links)
    assert [NAMES[wrong] in each for each in said] == ([] if wrong is None else [True])


def test_where_no_azimuth_is_declared_nothing_is_said_of_it():
    measurements = network(2)
    found = taken(replace(measurements, devices=measurements.devices.drop(columns="azimuth_deg")))
    assert (found.variants, found.scores, found.note) == ([], (), "")


@pytest.mark.usefixtures("short_report")
def test_the_loop_begins_with_what_is_declared_and_calls_it_no_cause():
    loop = rt.close_loop(network(0, points=150), base="log-distance", hold_out="device")
    report = rt.make_report(loop)
    assert [each["variant"] for each in report["effects"]] == [DeclaredSectors.variant]
    assert report["verdict"] != "effect"
    [effect] = report["effects"]
    assert effect["probability"] is None and effect["is_declared"]
    assert effect["parameters"]["azimuth_offset_deg"]["low"] < 3 and effect["parameters"]["azimuth_offset_deg"]["high"] > -3
    assert effect["parameters"]["beamwidth_deg"]["unit"] == "deg"
    assert not any("azimuth_deg" in name for name in effect["parameters"])  # declared, not found
    assert report["error"]["before"]["rmse_db"] < 4.5  # part of the base
    labels = [label.get_text().replace("\n", " ") for label in waterfall_figure(report).axes[0].get_xticklabels()]
    assert labels == ["before: log-distance with its own effects"]


@pytest.mark.usefixtures("quick_report")
def test_a_sector_that_is_only_planned_is_predicted_by_the_stored_twin(tmp_path):
    """B2 is in the table of devices and was never on air; its readings are those of the year after."""
    everything = network(6, points=200)
    planned = (everything.table["device"] == "B2").to_numpy()
    loop = rt.close_loop(everything.select(~planned), base="log-distance", hold_out="block")
    assert loop.after.whole.effects[0].is_declared
    corrected_twin(loop, None).save(tmp_path / "twin")
    later = prepare_links(everything.select(planned), None)
    expected = rt.Twin.load(tmp_path / "twin").predict(later)
    error_db = later.level_db - expected.mean_db
    assert len(error_db) == 200
    assert np.sqrt(np.mean(error_db**2)) < 4.5  # the noise is 3 dB
    assert np.mean(np.abs(error_db) < 1.645 * expected.sd_db) > 0.85
    assert expected.sd_db.mean() > 4.0  # its level is another than the others'


@pytest.mark.slow
def test_of_a_sector_that_nothing_tells_the_twin_knows_that_it_knows_little(tmp_path):
    """The others have antennas of their own: another one's level is theirs in the mean, and as far off as they are."""
    everything = network(7, points=200)
    everything = replace(everything, devices=everything.devices.drop(columns="azimuth_deg"))
    error_db, within = [], []
    for name in ("A0", "A1", "A2", "B2"):
        planned = (everything.table["device"] == name).to_numpy()
        loop = rt.close_loop(everything.select(~planned), base="log-distance", hold_out="block")
        assert "antenna_pattern" in {each.name for each in loop.after.whole.effects}
        corrected_twin(loop, None).save(tmp_path / name)
        twin = rt.Twin.load(tmp_path / name)
        assert twin.fitted.unheard.devices == (NAMES.index(name),)
        later, heard = (prepare_links(everything.select(rows), None) for rows in (planned, ~planned))
        expected, known = twin.predict(later), twin.predict(heard)
        error_db.append(later.level_db - expected.mean_db)
        within.append(np.abs(error_db[-1]) < 1.645 * expected.sd_db)
        assert known.sd_db.mean() < 0.7 * expected.sd_db.mean()
    assert np.mean(within) > 0.8
    assert abs(np.mean(error_db)) < 4.0


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_declared_tilts_that_differ_predict_better_than_one_for_all(seed):
    measurements = network(seed, tilts_deg=(-3.0, -20.0))
    told = measurements.devices.assign(tilt_deg=np.repeat([-3.0, -20.0], 3))
    flat, tilted = taken(measurements), taken(replace(measurements, devices=told))
    assert flat.variants == tilted.variants == [DeclaredSectors.variant]
    assert tilted.after_db < flat.after_db
    # cos^50 is 3 dB down 9.6° above and below; one tilt for all makes it 13 to 67°.
    assert tilted.parameters["vertical_beamwidth_deg"].value == pytest.approx(19.2, abs=5)
    patterns = list(tilted.params.devices.values())
    assert patterns[0].tilt_deg - patterns[3].tilt_deg == pytest.approx(17.0)
    assert abs(tilted.params.tilt_offset_deg) < 8
    assert tilted.parameters.keys() - flat.parameters.keys() == {"tilt_offset_deg"}
    assert flat.parameters.keys() - tilted.parameters.keys() == {"tilt_deg"}


@pytest.mark.slow
def test_a_sector_without_a_declared_tilt_has_that_of_the_others():
    measurements = network(3, tilts_deg=(-3.0, -20.0))
    told = measurements.devices.assign(tilt_deg=[-3.0, -3.0, np.nan, -20.0, np.nan, -3.0])
    tilts_deg = [each.tilt_deg for each in taken(replace(measurements, devices=told)).params.devices.values()]
    np.testing.assert_allclose(np.subtract(tilts_deg, tilts_deg[0]), [0, 0, 0, -17, 0, 0], atol=1e-9)


def test_one_declared_azimuth_is_too_few():
    measurements = network(3)
    devices = measurements.devices.assign(azimuth_deg=[20.0] + [np.nan] * 5)
    reason = DeclaredSectors().unavailable(prepare_links(replace(measurements, devices=devices), None))
    assert reason == "azimuth_deg of 2 devices of known position is not declared"
    assert DeclaredSectors().unavailable(prepare_links(measurements, None)) is None


def test_all_sectors_share_a_pattern_and_a_level_and_keep_their_azimuths():
    links = prepare_links(network(4), None)
    shape = SectorPattern(beamwidth_deg=80.0)
    params = DeclaredSectors.Params(devices={device: shape.model_copy(update={"azimuth_deg": azimuth})
                                           for device, azimuth in enumerate(links.boresight_deg)})
    variation = DeclaredSectors().with_params(params).variation()
    wider = variation.effect(variation.values + np.array([3.0, 2.0, 5.0, 0, 0, 0])).params
    assert [each.azimuth_deg for each in wider.devices.values()] == [23, 143, 263] * 2
    assert {each.beamwidth_deg for each in wider.devices.values()} == {85.0}
    assert {each.tilt_deg for each in wider.devices.values()} == {2.0}
    term = DeclaredSectors().with_params(params).term(links, None)
    np.testing.assert_allclose(term.columns[:, 0], 1.0)  # of a sector without a reading, too
    np.testing.assert_allclose(term.columns[:, 1:].sum(axis=1), 1.0)
    assert term.prior_sd_db[0] > 2.5 * term.prior_sd_db[1:].max()


def antenna_db(links):
    off = np.radians(links.azimuth_deg - links.boresight_deg[links.device])
    return 10 * np.log10(0.006 + 0.994 * np.cos(off / 2) ** 8)


class Half(GainEffect):
    name, variant, is_declared = "thing", "half of it", True

    def gain_db(self, links):
        return 0.5 * antenna_db(links)


class All(Half):
    variant = "all of it"

    def gain_db(self, links):
        return antenna_db(links)


@pytest.mark.parametrize("forms", [(Half, All), (All, Half)])
def test_of_two_forms_held_out_links_choose(forms):
    model, inputs = based(network(5), *(form() for form in forms), by="device")
    result = search(SearchState(model), [add_declared], inputs)
    [effect] = result.model.whole.effects
    assert effect.variant == "all of it"
    assert [each.reason for each in result.log.trials if not each.kept] == ["all of it gain more"]
    assert len(result.log.kept) == 1


def test_trees_of_a_stored_blend_know_the_azimuths_and_nobody_need_tell_them_again():
    links = prepare_links(network(7), None)
    forest = grow_trees(EXTRA_TREES, link_features(links, receivers=False), links.level_db, 0, 20)
    azimuths = np.column_stack([np.arange(6), links.boresight_deg])
    blend = Blend({"named_and_trees": (1.0, 1.0)}, 30.0, (1.0, 1.0), True, links.receiver_m[:50], links.device[:50],
                  {"named_and_trees": forest}, {}, azimuths)
    arrays, settings = blend.state()
    again = Blend.from_state(arrays, settings, 6)
    later = links.with_ends(boresight_deg=np.full(6, np.nan))  # a map's links declare nothing
    zero, one = np.zeros(len(links)), np.ones(len(links))
    expected_db = forest.predict(link_features(links, receivers=False))
    np.testing.assert_allclose(again.apply(later, zero, one, 5.0, (zero, one))[0], expected_db, atol=1e-5)
    with pytest.raises(ValueError, match="belongs to no device"):
        Blend.from_state(arrays | {"boresights_deg": azimuths + [6, 0]}, settings, 6)


@pytest.mark.slow
def test_a_held_out_sector_is_predicted_as_the_twin_that_lacks_it_predicts_it():
    """Shadowing is scaled by the spread of heard sectors, however uncertain the level of an unheard one is."""
    base, inputs = based(network(8), *(effect() for effect in BUILT_IN), by="device")
    result = search(SearchState(base), [add_declared], inputs)
    shadowing = [fit.fit_shadowing(0) for fit in result.model.fits]
    model = result.model.map(lambda fit, field: replace(fit, shadowing=field), shadowing)
    mean_db, scale_db = model.held_out_reading
    spread_db, unheard_db = model.held_out_scales
    assert np.median(unheard_db) > 3.0 and np.median(spread_db) < 4.0
    t_sd = np.sqrt(model.whole.model.dof / (model.whole.model.dof - 2))
    for number, (fold, field) in enumerate(zip(model.folds, shadowing[1:])):
        held_out = model.index == number
        assert len(np.unique(fold.links.device[held_out])) == 1
        twin = replace(fold.learnt, shadowing=field).predict(inputs.links.select(held_out))
        np.testing.assert_allclose(mean_db[held_out], twin.mean_db, atol=1e-6)
        np.testing.assert_allclose(twin.sd_db, t_sd * scale_db[held_out], rtol=1e-6)
        assert (scale_db[held_out] > unheard_db[held_out]).all()


@pytest.mark.parametrize("groups", [[[0]] * 5000, [[0, 0]], [[0, 9]], [[0, 1]] * 3])
def test_groups_of_levels_in_a_file_are_those_of_its_devices(groups):
    shape = SectorPattern()
    with pytest.raises(ValueError, match="groups are not of two devices"):
        DeclaredSectors.Params(devices={0: shape, 1: shape}, groups=groups)
