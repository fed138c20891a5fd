"""What the project says of itself against the ray-traced truth, on the two cities that ship with theirs.

Rationale: the shipped maps were made by `radiotwin trace` at default quality; the last test traces some of their links
    again, so that they cannot be anything else.
Expected behaviour: from 5 flights, the mean over 2 seeds of the segmented network's RMSE is at least 25 % below the
    log-distance model's, and at least 60 % below on LoS links, on 5 held-out flights and over the whole map.
Results: docs/results.md, with ten seeds.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from radiotwin.maps.radiomap import RadioMap
from radiotwin.maps.survey import fly_survey
from radiotwin.scene import Scene
from radiotwin.twin.compare import compare_models, split_flights

pytestmark = pytest.mark.slow

SCENES = Path(__file__).parents[1] / "scenes"
CITIES = ("rbm", "rdm")
SEEDS = range(2)


@pytest.fixture(scope="module", params=CITIES)
def city(request):
    scene = Scene.load(SCENES / request.param)
    return scene, RadioMap.load(scene.folder / "truth.nc")


@pytest.fixture(scope="module")
def scores(city):
    """RMSE [dB], mean over the seeds, by (against, positions, links, model)."""
    scene, truth = city
    tables = []
    for seed in SEEDS:
        flown = fly_survey(scene, truth, flights=10, pattern="random-waypoint", seed=seed)
        tables.append(compare_models(*split_flights(flown, 5), scene, truth, seed=seed,
                                     models=("log_distance", "segmented_nn")).scores)
    return pd.concat(tables).groupby(["against", "positions", "links", "model"])["rmse_db"].mean()


@pytest.mark.parametrize("against", ["held-out flights", "whole map"])
@pytest.mark.parametrize(("links", "share"), [("all", 0.75), ("LoS", 0.40)])
@pytest.mark.parametrize("positions", ["estimated", "true"])
def test_the_twin_is_well_below_the_log_distance_model(scores, against, links, share, positions):
    part = scores[against, positions, links]
    assert part["segmented_nn"] <= share * part["log_distance"], part.to_dict()


def test_shipped_maps_pass_the_gates(city):
    """Friis' law written out: no LoS link below free space, none far above; nothing above 0 dB; noise floor known."""
    scene, truth = city
    assert truth.dataset.attrs["scene_hash"] == scene.content_hash()
    position_m = scene.lattice.positions_m
    distance_m = np.array([np.linalg.norm(position_m - device_m, axis=1) for device_m in scene.device_m])
    free_space_db = -20 * np.log10(4 * np.pi * distance_m * scene.config.radio.frequency_hz / 299_792_458)
    gain_db, los = truth.gain_db.reshape(distance_m.shape), truth.los.reshape(distance_m.shape)
    assert np.nanmax(gain_db) < 0
    excess_db = (gain_db - free_space_db)[los]
    assert np.nanmin(excess_db) > -0.1 and 0 < np.nanmedian(excess_db) < 3
    again = np.array([scene.city.line_of_sight(position_m, device_m[None]) for device_m in scene.device_m])
    assert (los != again).mean() < 1e-4, "rays cast the other way differ only where they graze an edge"
    assert 0 < truth.dataset.attrs["noise_floor_db"] < 2


@pytest.mark.llvm
def test_shipped_maps_are_what_the_tracer_gives(city):
    """60 positions of each device, traced now in other batches: the same but for the ground.

    The maps were traced with Sionna RT's own diffraction, and with flat ground as a slab of 0.1 m; it is a half space now.
    """
    from radiotwin.trace import SolverSettings, trace_gains

    scene, truth = city
    index = np.random.default_rng(0).choice(len(scene.lattice.positions_m), 60, replace=False)
    settings = replace(SolverSettings.of_quality(), diffraction="sionna")
    again_db = trace_gains(scene, scene.device_m[:3], scene.lattice.positions_m[index], settings)
    again_db[again_db < scene.config.gain_limit_db] = np.nan
    shipped_db = truth.gain_db.reshape(len(truth.devices), -1)[:3, index]
    both = np.isfinite(again_db) & np.isfinite(shipped_db)
    assert both.sum() > 60
    assert (np.isfinite(again_db) != np.isfinite(shipped_db)).mean() < 0.05
    difference_db = np.abs(again_db - shipped_db)[both]
    assert np.median(difference_db) < 0.3 and np.quantile(difference_db, 0.9) < 1.5
