"""What the scan says of made campaigns with one fault or none; the base alone is fitted, nothing else of the loop."""

from dataclasses import replace

import numpy as np
import pytest
from radiotwin.closeloop.scan import scan

from radiotwin.closeloop.crossfit import cross_validate, make_bases, make_folds, training_parts
from radiotwin.links import prepare_links
from radiotwin.links.measurements import Measurements
from radiotwin.scene.citymap import CityMap
from studies.where import compare, counts, false_groups
from tests.closeloop.made_campaigns import FAULTS, draw_campaign, solids

SURE, PLAIN_T = 0.9, 8.0  # how well the true change has to show in the residual
MIN_LINKS, TIMES = 40, 2.0


def judged(seed):
    """A row of the study `where` of a made campaign, and whether a group's RMS is twice that of its peers."""
    made = draw_campaign(seed)
    measurements = Measurements(made.table, made.devices)
    links = prepare_links(measurements, None)
    if len(made.boxes):
        links = replace(links, world=replace(links.world, city=CityMap(*solids(made.boxes))))
    folds = make_folds(links, 0)
    model = cross_validate(links, make_bases(None, 0)["twin"], folds, training_parts(links, folds))
    hidden = [{"name": made.fault, **{end: its for end, (its,) in made.ends.items()},
               **{axis: each for place in made.place_m for axis, each in zip(("x_m", "y_m"), (place[:2], place[2:]))}}]
    row = compare(model, scan(model), measurements, hidden * bool(made.fault), [made.change_db] * bool(made.fault), {})
    return row | {"seed": seed, "fault": made.fault, "loud": loud_groups(model)}


def loud_groups(model):
    """Devices, receivers, flights and pairs whose RMS, in units of its class of sight, is twice that of the median peer."""
    links = model.links
    residual = links.level_db - model.held_out_mean_db
    for los in (True, False):
        of_class = links.los == los
        if np.isfinite(residual[of_class]).sum() > 1:
            residual[of_class] /= np.sqrt(np.nanmean(residual[of_class]**2))
    ends, found = {"device": links.device, "receiver": links.receiver, "flight": links.flight}, []
    for family in (("device",), ("receiver",), ("flight",), ("device", "flight"), ("receiver", "flight"), ("device", "receiver")):
        keys, group = np.unique(np.column_stack([ends[end] for end in family]), axis=0, return_inverse=True)
        heard = np.isfinite(residual)
        count = np.bincount(group.ravel()[heard], minlength=len(keys))
        square = np.bincount(group.ravel()[heard], residual[heard]**2, len(keys))
        rms = np.sqrt(square / np.maximum(count, 1))[count >= MIN_LINKS]
        if len(rms) > 2 and rms.max() > TIMES * np.median(rms):
            found.append((family, tuple(keys[count >= MIN_LINKS][rms.argmax()])))
    return found


def check(rows):
    """Say which campaigns fail, by seed."""
    silent = [row["seed"] for row in rows if row["loud"] and not row["said"]]
    assert not silent, f"nothing is said beside a group with twice the RMS of its peers: seeds {silent}"
    plain = [(row, one) for row in rows for one in row["hidden"]
             if counts(one) and one["t"] is not None and abs(one["t"]) >= PLAIN_T]
    missed = [(row["seed"], row["fault"]) for row, one in plain if not one["right"]]
    assert len(missed) <= 0.05 * len(plain) + 1, f"{len(missed)} of {len(plain)} missed: {missed}"
    false = [(row["seed"], each["group"]) for row in rows for each in false_groups(row)]
    assert len(false) <= 0.05 * len(rows) + 1, f"not there: {false}"
    nulls = [row for row in rows if not row["fault"]]
    spoken = [row["seed"] for row in nulls if false_groups(row)]
    assert len(spoken) <= 0.05 * len(nulls) + 1, f"nulls with any: seeds {spoken}"


def test_a_few_made_campaigns():
    check([judged(seed) for seed in range(100, 108)])


@pytest.mark.slow
def test_five_hundred_made_campaigns():
    check([judged(seed) for seed in range(500)])


def test_campaigns_are_drawn_alike_and_hide_what_they_say():
    for seed in (3, 9, 16):
        made, again = draw_campaign(seed), draw_campaign(seed)
        assert made.table.equals(again.table) and made.fault == again.fault == FAULTS[seed % len(FAULTS)]
        its = np.ones(len(made.table), dtype=bool)
        for end, names in made.ends.items():
            its &= made.table[end].isin(names).to_numpy()
        assert (made.change_db[~its] == 0).all() and (made.change_db[its] != 0).any()
