"""What the project says of itself in the statistical truth of the paper, on the shipped RBM scene.

Rationale: with truth and noise known, the best that any channel model can reach is the noise itself, and a located
    device has a known position.
Expected behaviour: from 5 random-waypoint flights, in each of 6 seeds, the channel network's error on 5 other
    flights is within 8 % of the noise (LoS √2 dB, NLoS √5 dB); over 7 unknown devices and 6 seeds the position error
    is at most 3 m in the median and 12 m for 90 %, and at most 1 device in 42 is off by more than 50 m.
Results: docs/results.md, with ten seeds.
"""

from pathlib import Path

import numpy as np
import pytest

from radiotwin.inference.gaussian import mean_if_detected
from radiotwin.links import link_geometry
from radiotwin.maps.survey import fly_survey, segmented_truth
from radiotwin.scene import Scene
from radiotwin.twin import fit_twin

pytestmark = pytest.mark.slow

RBM = Path(__file__).parents[1] / "scenes" / "rbm"
SEEDS = range(6)
FLIGHTS = 5


@pytest.fixture(scope="module")
def runs():
    """(seed, twin, held-out measurements) of every seed."""
    scene = Scene.load(RBM)
    truth = segmented_truth(scene)
    results = []
    for seed in SEEDS:
        flown = fly_survey(scene, truth, flights=2 * FLIGHTS, pattern="random-waypoint", seed=seed, noise_db=0.0)
        early = flown.table["flight"].isin(flown.flights[:FLIGHTS]).to_numpy()
        twin = fit_twin(flown.select(early), scene, "segmented_nn", seed=seed)
        results.append((seed, twin, flown.select(~early)))
    return scene, results


def test_channel_error_is_within_8_percent_of_the_noise(runs):
    scene, results = runs
    for seed, twin, test in results:
        links = link_geometry(scene.device_m, test.receiver_m, test.device_index, scene.city)
        predicted_db = mean_if_detected(*twin.channel.predict(links), scene.config.gain_limit_db)
        error_db = predicted_db - test.level_db
        # Within 8 dB of the limit only the upper part of the noise is seen: the floor is not σ there, but less.
        inside = np.isfinite(error_db) & (predicted_db > scene.config.gain_limit_db + 8)
        for los, floor_db in ((True, 2**0.5), (False, 5**0.5)):
            mask = inside & (links.los == los)
            assert mask.sum() > 1000
            rmse_db = np.sqrt(np.mean(error_db[mask] ** 2))
            assert rmse_db <= 1.08 * floor_db, (seed, los, rmse_db)


def test_unknown_devices_are_found(runs):
    scene, results = runs
    error_m = np.array([np.hypot(device.x_m - x_m, device.y_m - y_m) for _, twin, _ in results
                        for device, (x_m, y_m, _) in zip(twin.devices, scene.device_m) if device.role == "unknown"])
    assert len(error_m) == 7 * len(SEEDS)
    assert np.median(error_m) <= 3
    assert np.quantile(error_m, 0.9) <= 12
    assert (error_m > 50).sum() <= 1


def test_credible_radii_hold_what_they_say(runs):
    """90 % radii hold the truth in 81 % of 70 such cases (docs/results.md); below 70 % something has been broken."""
    scene, results = runs
    within = [np.hypot(device.x_m - x_m, device.y_m - y_m) <= device.credible_radius_m
              for _, twin, _ in results
              for device, (x_m, y_m, _) in zip(twin.devices, scene.device_m) if device.role == "unknown"]
    assert np.mean(within) >= 0.7
