"""Radii by which positions are as uncertain as held-out devices show, whatever the model believes."""

from dataclasses import replace

import numpy as np
import pytest

from radiotwin.inference.gaussian import LogDistanceLine
from radiotwin.links import prepare_links
from radiotwin.propagation.laws.log_distance import LogDistance
from radiotwin.twin.localize import calibrate_radii, locate, misfit
from radiotwin.twin.localize.calibration import radius_factor
from radiotwin.twin.model.model import FittedModel

AREA_M = (-100.0, 600.0, -100.0, 600.0)


def overconfident(scale_db):
    channel = LogDistance(LogDistanceLine(-35.0, 2.6, 2.0))
    return FittedModel(channel, (), (), np.zeros(2), np.array([scale_db]), 5.0, np.zeros((5, 3)), ("r0", "r1"), 0.0, 0.0)


def folds_of(open_ground, seed, noise_db=6.0, count=4):
    links = prepare_links(open_ground.measured(open_ground.fly(seed, noise_db)), None)
    rng = np.random.default_rng(seed)
    return [links.select(np.sort(rng.choice(len(links), 60, replace=False))) for _ in range(count)]


def test_the_factor_is_the_conformal_quantile_and_few_devices_far_off_widen():
    assert radius_factor(np.arange(1, 20) / 10.0) == pytest.approx(1.8)  # the 18th of 19
    assert radius_factor(np.full(30, 0.2)) == 1.0
    assert radius_factor(np.array([3.0, 4.0])) > 2.0 and radius_factor(np.array([0.3, 0.5])) == 1.0


def test_radii_of_a_model_that_believes_too_much_hold_afterwards(open_ground):
    model = overconfident(1.0)
    found = calibrate_radii([model] * 4, folds_of(open_ground, 3), AREA_M, 0)
    assert found.radius_factor > 1.5
    corrected, inside, before = replace(model, **vars(found)), [], []
    for fold in folds_of(open_ground, 4):
        for radii, with_model in ((inside, corrected), (before, model)):
            for each in locate(with_model, fold, AREA_M):
                true_m = fold.device_m[fold.device_names.index(each.device), :2]
                radii.append(np.hypot(*(true_m - (each.x_m, each.y_m))) <= each.credible_radius_m)
    assert np.mean(before) < 0.7 and np.mean(inside) >= 0.75  # 20 positions: 0.9 +- 2 * 0.07


def test_without_anchors_nothing_is_known(open_ground):
    (fold, *_) = folds_of(open_ground, 3)
    unknown = fold.with_ends(anchors=frozenset())
    found = calibrate_radii([overconfident(2.0)], [unknown], AREA_M, 0)
    assert found.radius_factor == 1.0 and np.isnan(found.typical_misfit)


def test_a_receiver_that_has_changed_shows_in_the_misfit(open_ground):
    model = overconfident(6.0)
    found = calibrate_radii([model] * 4, folds_of(open_ground, 5), AREA_M, 0)
    fold = folds_of(open_ground, 6)[0]
    changed = fold.with_columns(level_db=fold.level_db + np.where(fold.receiver == 1, 25.0, 0.0))
    misfits = [misfit(model, changed.select(changed.device == changed.device_names.index(each.device)), each)
               for each in locate(model, changed, AREA_M)]
    assert np.sqrt(np.median(misfits) / found.typical_misfit) > 1.2


def test_a_device_that_a_fold_never_heard_is_no_trial(open_ground):
    """Blanks alone locate nobody; one such device must not hide how well the others fit."""
    folds = folds_of(open_ground, 3)
    deaf = [fold.with_columns(level_db=np.where(fold.device == 2, np.nan, fold.level_db)) for fold in folds]
    without = [fold.select(fold.device != 2) for fold in folds]
    found, expected = (calibrate_radii([overconfident(6.0)] * 4, each, AREA_M, 0) for each in (deaf, without))
    assert np.isfinite(found.typical_misfit) and found == expected
