"""Twins as folders: what comes back is what was saved, and damage is one message."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from radiotwin.closeloop.output.corrected_twin import corrected_twin
from radiotwin.closeloop.run import close_loop
from radiotwin.effects import catalogue
from radiotwin.effects.places import Roof
from radiotwin.errors import BadInput
from radiotwin.twin import Twin, check_twin_target, fit_twin
from radiotwin.twin.model.model import FittedModel

STORED = Path(__file__).parent / "stored"
NO_MAP = SimpleNamespace(config=SimpleNamespace(radio=SimpleNamespace(frequency_hz=2.4e9)), city=None)


@pytest.mark.parametrize("model", ["log_distance", "segmented_log_distance", "segmented_nn", "kriging"])
def test_saved_and_loaded_it_predicts_the_same(small_scene, flown, tmp_path, model):
    twin = fit_twin(flown, small_scene, model=model, seed=0)
    twin.save(tmp_path / "twin")
    again = Twin.load(tmp_path / "twin")
    assert again.devices == twin.devices and again.provenance == twin.provenance
    here, there = (t.radio_map(small_scene) for t in (twin, again))
    np.testing.assert_array_equal(here.gain_db, there.gain_db)
    np.testing.assert_array_equal(here.dataset["sigma_db"], there.dataset["sigma_db"])


def assert_equal(one, other):
    for name, value in vars(one).items():
        np.testing.assert_array_equal(value, getattr(other, name), err_msg=name)


@pytest.mark.usefixtures("quick_report")
def test_a_twin_with_effects_predicts_the_same_after_loading(open_ground, only_effects, tmp_path):
    only_effects("device_gain_offset", "receiver_gain_offset")
    world = open_ground.fly(20)
    world.gain_db[world.receiver == 1] += 6.0
    world.gain_db[world.device == 2] -= 7.0
    measurements = open_ground.measured(world).select(world.slot % 2 == 0)
    loop = close_loop(measurements, base="log-distance")
    twin = corrected_twin(loop, None)
    assert {each.name for each in twin.effects} == {"device_gain_offset", "receiver_gain_offset"}
    twin.save(tmp_path / "twin")
    again = Twin.load(tmp_path / "twin")
    assert again.description == twin.description and again.limit_db == twin.limit_db
    assert again.fitted.receivers == twin.fitted.receivers == ("r0", "r1")
    assert_equal(twin.predict(loop.links), again.predict(loop.links))
    faultless = [each.links(world.receiver_m[:50], world.device[:50], NO_MAP) for each in (twin, again)]
    assert_equal(twin.predict(faultless[0]), again.predict(faultless[1]))


@pytest.mark.slow
@pytest.mark.usefixtures("quick_report")
def test_a_curve_that_only_describes_is_drawn_on_the_maps_of_a_stored_twin(open_ground, only_effects, tmp_path):
    only_effects("antenna_pattern", "device_gain_offset")
    world = open_ground.fly(8)
    azimuth_deg = np.degrees(np.arctan2(world.offset_m[:, 0], world.offset_m[:, 1]))
    world.gain_db += 5.0 * np.sin(np.radians(3 * azimuth_deg))  # no effect of the catalogue does so at all devices
    measurements = open_ground.measured(world).select(world.slot % 2 == 0)
    loop = close_loop(measurements, base="log-distance")
    assert loop.verdict in ("located", "undecided")
    corrected_twin(loop, None).save(tmp_path / "twin")
    twin = Twin.load(tmp_path / "twin")
    assert [each.variant for each in twin.effects] == ["over azimuth_deg"]
    # Round each device, far from what was measured: a wave three times round, as far as eight knots follow one.
    around_deg = np.arange(0, 360, 5.0)
    offset_m = 150.0 * np.column_stack([np.sin(np.radians(around_deg)), np.cos(np.radians(around_deg)), 0.3 + 0 * around_deg])
    links = twin.links(twin.device_m[0] + offset_m, np.zeros(len(around_deg), dtype=int), NO_MAP)
    wave = np.sin(np.radians(3 * around_deg))
    assert np.corrcoef(twin.predict(links).mean_db, wave)[0, 1] > 0.7


def test_a_damaged_twin_is_bad_input(twin, tmp_path):
    with pytest.raises(BadInput, match="not a twin's folder"):
        Twin.load(tmp_path)
    twin.save(tmp_path / "twin")
    path = tmp_path / "twin" / "twin.json"
    text = path.read_text()
    for broken in (text[:100], text.replace('"devices"', '"gadgets"'), text.replace('"x_m": 80.0', '"x_m": "far"'),
                   text.replace('"gain_db"', '"loudness"'), text.replace('"d1"', '"d0"'),
                   text.replace('"anchor"', '"boss"')):
        assert broken != text
        path.write_text(broken)
        with pytest.raises(BadInput, match="damaged"):
            Twin.load(tmp_path / "twin")
    path.write_text(json.dumps(json.loads(text) | {"schema": "radiotwin.twin/99"}))
    with pytest.raises(BadInput, match="schema is"):
        Twin.load(tmp_path / "twin")


def test_a_twin_is_replaced_with_its_page_and_nothing_else_is_lost(twin, tmp_path):
    twin.save(tmp_path / "twin")
    (tmp_path / "twin" / "report.html").write_text("made of the twin before")
    twin.save(tmp_path / "twin")
    assert not (tmp_path / "twin" / "report.html").exists()
    (tmp_path / "twin" / "notes.txt").write_text("mine")
    with pytest.raises(BadInput, match="notes.txt"):
        twin.save(tmp_path / "twin")
    assert (tmp_path / "twin" / "notes.txt").read_text() == "mine"
    (tmp_path / "file").write_text("")
    with pytest.raises(BadInput, match="file"):
        check_twin_target(tmp_path / "file")


@pytest.mark.parametrize("name", ["twin.json", "channel.safetensors"])
def test_a_twin_reads_nothing_outside_its_folder(tmp_path, name):
    (tmp_path / name).touch()
    shutil.copytree(STORED / "raytrace", tmp_path / "twin")
    (tmp_path / "twin" / name).unlink()
    (tmp_path / "twin" / name).symlink_to(tmp_path / name)
    with pytest.raises(BadInput, match="leads out of"):
        Twin.load(tmp_path / "twin")


OF_MAPS = {
    "building_entry": {"building": "traditional", "frequency_hz": 2.4e9}, "diffraction": {"strength_db": 3.0, "level_db": -40.0},
    "mapped_vegetation": {"kind": "wood"}, "removed_obstacle": {"building": 0, "centre_m": (0.0, 0.0, 9.0)},
    "roof_heights": {"roofs": (Roof(0, 1.0, 1.0, 9.0, 1.0, 2.0),)}, "uncertain_sight": {"contrast_db": 20.0},
    "wall_reflection": {"strength_db": 3.0, "level_db": -40.0}}


def test_every_effect_that_needs_a_map_is_tried():
    assert {each.name for each in catalogue() if each.needs_map} == {*OF_MAPS, "antenna_pattern"}  # whose params other tests have


@pytest.mark.parametrize("name", OF_MAPS)
def test_a_twin_with_an_effect_that_needs_a_map_comes_back_without_one(twin, tmp_path, name):
    effect = next(each() for each in catalogue() if each.name == name)
    params = effect.Params(**OF_MAPS[name])
    fitted = FittedModel(twin.channel, (effect.with_params(params),), (np.zeros(0),), np.zeros(2), np.array([3.0]), 5.0,
                         twin.device_m, ("r0",), np.nan, 0.0)
    replace(twin, fitted=fitted).save(tmp_path / "twin")
    (again,) = Twin.load(tmp_path / "twin").effects
    assert type(again) is type(effect) and again.params == params
