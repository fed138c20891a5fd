"""Which of the cheap models predicts best what it has not seen."""

import numpy as np
import pytest

from radiotwin.errors import BadInput
from radiotwin.links import LinkGeometry
from radiotwin.twin import fit_twin
from radiotwin.twin.selection import HeldOut

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


@pytest.mark.parametrize("level_at, best", [(line, "log_distance"), (classes, "segmented_log_distance"),
                                            (shadows, "regression_kriging")])
def test_the_model_that_made_the_levels_is_the_best(level_at, best):
    links, flight, level_db = links_with(level_at)
    models = ("log_distance", "segmented_log_distance", "regression_kriging")
    found = HeldOut.of(links, flight, level_db, None, 0, models)
    assert found.by == "flight" and found.best == best and list(found.rmse_db) == list(models)
    assert found.rmse_db[best] < (6.0 if level_at is shadows else 2.4)
    assert "is the best of them, or as good" in found.sentence(best)
    assert HeldOut.kept({"held_out": found.record}) == found
    if best != "log_distance":
        assert f"{best} would be better: " in found.sentence("log_distance")
    assert HeldOut.of(links, np.zeros(COUNT, int), level_db, None, 0, models).by == "block"
    few = np.where(np.arange(COUNT) < 25, level_db, np.nan)
    assert HeldOut.of(links, flight, few, -200.0, 0, models) is None


def test_auto_takes_it_and_the_twin_says_what_was_tried(small_scene, flown, tmp_path):
    twin = fit_twin(flown, small_scene, "auto")
    tried = HeldOut.kept(twin.provenance)
    assert twin.channel.name == tried.best and len(tried.rmse_db) == 4
    twin.save(tmp_path / "twin")
    assert HeldOut.kept(type(twin).load(tmp_path / "twin").provenance) == tried
    with pytest.raises(BadInput, match="allowed are .*log_distance"):
        fit_twin(flown, small_scene, "automatic")
