"""The channel model is chosen by its error on held-out links."""

import numpy as np
import pytest

from radiotwin.errors import BadInput, MissingPackage
from radiotwin.links import LinkGeometry
from radiotwin.links.measurements import Measurements
from radiotwin.propagation.laws.registry import encode_channel
from radiotwin.twin import fit_twin
from radiotwin.twin.selection import HeldOut, standard_error

RNG_SEED, COUNT = 3, 360


def links_with(level_at):
    """Links of two devices on three flights, half of them with line of sight, and their levels."""
    rng = np.random.default_rng(RNG_SEED)
    receiver_m = np.column_stack([rng.uniform(0, 400, (COUNT, 2)), np.full(COUNT, 50.0)])
    device = np.arange(COUNT) % 2
    device_m = np.array([[50.0, 60.0, 2.0], [330.0, 300.0, 2.0]])[device]
    los = rng.random(COUNT) < 0.5
    distance_m = np.linalg.norm(receiver_m - device_m, axis=1)
    level_db = level_at(distance_m, los, receiver_m, rng)
    return LinkGeometry(device_m, receiver_m, los, device), np.arange(COUNT) // 120, level_db


def line(distance_m, los, receiver_m, rng):
    return -40 - 25 * np.log10(distance_m) + rng.normal(0, 2.0, COUNT)


def classes(distance_m, los, receiver_m, rng):
    return line(distance_m, los, receiver_m, rng) - 15.0 * ~los


def shadows(distance_m, los, receiver_m, rng):
    return line(distance_m, los, receiver_m, rng) + 12 * np.sin(receiver_m[:, 0] / 40) * np.cos(receiver_m[:, 1] / 40)


@pytest.mark.parametrize("level_at, best, worse", [
    (line, "log_distance", ()), (classes, "segmented_log_distance", ("log_distance",)),
    (shadows, "kriging", ("log_distance", "segmented_log_distance"))])
def test_the_simplest_model_within_a_standard_error_of_the_least_error_is_the_best(level_at, best, worse):
    links, flight, level_db = links_with(level_at)
    models = ("log_distance", "segmented_log_distance", "kriging")
    found = HeldOut.of(links, flight, level_db, None, 0, models)
    assert found.by == "flight" and found.best == best and list(found.rmse_db) == list(models)
    assert found.rmse_db[best] < (6.0 if level_at is shadows else 2.4)
    assert set(models) - set(found.as_good) == set(worse)
    says = "has the least" if found.rmse_db[best] == min(found.rmse_db.values()) else "is as good as the best, and the simplest"
    assert f"{best} {says}" in found.sentence(best)
    assert all(f"{best} would be better: " in found.sentence(each) for each in worse)
    assert HeldOut.from_provenance({"held_out": found.record}) == found


def test_few_flights_are_held_out_by_block_of_ground_and_few_readings_not_at_all():
    links, flight, level_db = links_with(classes)
    models = ("log_distance", "segmented_log_distance")
    assert HeldOut.of(links, np.zeros(COUNT, int), level_db, None, 0, models).by == "block"
    few = np.where(np.arange(COUNT) < 25, level_db, np.nan)
    assert HeldOut.of(links, flight, few, -200.0, 0, models) is None


def test_links_close_together_count_as_one_where_models_are_compared():
    """Two errors that stay for a block of ten links each: no more certain than two readings."""
    value, block = np.repeat([3.0, 1.0], 10), np.repeat([0, 1], 10)
    assert standard_error(value, block) == pytest.approx(1.0)
    assert standard_error(value, np.arange(20)) == pytest.approx(np.std(value, ddof=1) / np.sqrt(20))


def test_by_default_the_best_model_predicts_and_the_network_locates(small_scene, flown, tmp_path):
    twin, network = fit_twin(flown, small_scene), fit_twin(flown, small_scene, "segmented_nn")
    tried = HeldOut.from_provenance(twin.provenance)
    assert twin.channel.name == tried.best == "segmented_log_distance" and len(tried.rmse_db) == 4
    assert twin.devices == network.devices and twin.provenance["located_by"] == "segmented_nn"
    named = fit_twin(flown, small_scene, tried.best)
    assert encode_channel(twin.channel) == encode_channel(named.channel) and "held_out" not in named.provenance
    twin.save(tmp_path / "twin")
    assert HeldOut.from_provenance(type(twin).load(tmp_path / "twin").provenance) == tried
    with pytest.raises(BadInput, match="allowed are .*log_distance"):
        fit_twin(flown, small_scene, "automatic")


def test_of_readings_too_few_to_hold_any_out_the_segmented_law_is_learnt(small_scene, flown):
    anchors = flown.devices["device"][flown.devices["role"] == "anchor"]
    heard = flown.table["device"].isin(anchors[:2]).to_numpy() & np.isfinite(flown.level_db)
    twin = fit_twin(flown.select(heard & (np.cumsum(heard) <= 28)), small_scene)
    assert twin.channel.name == "segmented_log_distance" and HeldOut.from_provenance(twin.provenance) is None


def test_without_torch_the_best_of_the_other_models_predicts_and_the_segmented_law_locates(small_scene, flown, monkeypatch):
    def absent():
        raise MissingPackage("no torch")

    monkeypatch.setattr("radiotwin.twin.fit.require_torch", absent)
    with pytest.warns(UserWarning, match=r"segmented_nn is not among the models .*radiotwin\[nn\]"):
        twin = fit_twin(flown, small_scene)
    assert list(HeldOut.from_provenance(twin.provenance).rmse_db) == ["log_distance", "segmented_log_distance", "kriging"]
    assert twin.provenance["located_by"] == "segmented_log_distance" and np.isfinite(twin.device_m).all()


def test_a_map_that_hides_every_link_is_refused_even_if_a_law_without_a_map_is_the_best(small_scene, flown):
    devices = flown.devices[flown.devices["role"] == "anchor"].reset_index(drop=True)
    of_anchors = Measurements(flown.table[flown.table["device"].isin(devices["device"])].reset_index(drop=True), devices)
    at_m = small_scene.device_m[flown.is_anchor][of_anchors.device_index]
    hidden = of_anchors.select(~small_scene.city.line_of_sight(at_m, of_anchors.receiver_m))
    with pytest.raises(BadInput, match="all links NLoS"):
        fit_twin(hidden, small_scene)
