"""Unknown devices where paths put them, in a city traced by Sionna RT, whose code the paths do not share."""

import numpy as np
import pandas as pd

from radiotwin.closeloop import relocation
from radiotwin.closeloop.bases import TwinBase
from radiotwin.channel.image_paths import RaytraceBase
from radiotwin.links.link_data import prepare_links
from radiotwin.measurements import Measurements


def found(base, name):
    """Where a fitted base has the device, and its circle's radius."""
    device = next(each for each in base.found if each.device == name)
    return np.array([device.x_m, device.y_m]), device.credible_radius_m


def test_paths_find_a_device_in_a_narrow_street_that_a_law_puts_where_it_would_see_more(narrow_street, monkeypatch):
    place_m, measured, name = narrow_street.place_m, narrow_street.measured, narrow_street.name
    scene = narrow_street.scene
    links = prepare_links(measured, scene)
    law = TwinBase(scene, 0)
    base = RaytraceBase(law)
    assert np.linalg.norm(found(law.fit(links), name)[0] - place_m) > 15
    there_m, radius_m = found(base.fit(links), name)
    assert np.linalg.norm(there_m - place_m) < min(4.0, max(radius_m, 2.0))
    # A part of the links asks for the same paths and a few more places.
    followed = {place: len(ends) for place, ends in base._relocation.powers.items()}
    part = links.select(links.flight != 0)
    there_m, _ = found(base.fit(part), name)
    assert np.linalg.norm(there_m - place_m) < 4.0
    assert all(len(base._relocation.powers[place]) == count for place, count in followed.items())
    assert max(followed.values()) <= relocation.LINKS < (links.device == links.device_names.index(name)).sum()
    # Where its errors are too large beside those of others, or devices are too many, it stays.
    for limit in ("MAX_MISFIT", "MAX_DEVICES"):
        with monkeypatch.context() as changed:
            changed.setattr(relocation, limit, 0)
            assert base.fit(part).found == law.fit(part).found


def test_a_device_stays_where_the_law_is_too_unsure_or_no_place_explains_its_levels(narrow_street):
    """Some are those of open ground, which the law cannot place in a city; others are mixed up."""
    scene, measured, name = narrow_street.scene, narrow_street.measured, narrow_street.name
    table, rng = measured.table.copy(), np.random.default_rng(2)
    mine = table["device"] == name
    distance_m = np.hypot(table["receiver_x_m"] - 300.0, table["receiver_y_m"] - 300.0)
    level_db = -60 - 22 * np.log10(np.hypot(distance_m, 50.0)) + rng.normal(0, 1, len(table))
    for changed_db, most_radius_m in ((level_db[mine], 100.0), (rng.permutation(table.loc[mine, "gain_db"]), np.inf)):
        changed = table.assign(gain_db=table["gain_db"].mask(mine, pd.Series(changed_db, table.index[mine])))
        links = prepare_links(Measurements(changed, measured.devices), scene)
        law = TwinBase(scene, 0)
        assert found(law.fit(links), name)[1] > 100 or np.isinf(most_radius_m)
        assert RaytraceBase(law, most_radius_m=most_radius_m).fit(links).found == law.fit(links).found
