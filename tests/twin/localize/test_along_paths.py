"""Unknown devices where paths put them, in a city traced by Sionna RT, whose code the paths do not share."""

import cloudpickle
import numpy as np
import pandas as pd
import pytest

from radiotwin.links import prepare_links
from radiotwin.links.measurements import Measurements
from radiotwin.propagation.laws.log_distance import SegmentedLogDistance
from radiotwin.runtime.pieces import keep_pieces
from radiotwin.scene import Scene
from radiotwin.twin.fit_links import fit_links
from radiotwin.twin.fit_paths import fit_paths, relocation_from
from radiotwin.twin.localize import along_paths
from tests.runtime.execution.jobs import two_workers
from tests.worlds import RBM


def found(twin, name):
    device = next(each for each in twin.devices if each.device == name)
    return np.array([device.x_m, device.y_m]), device.credible_radius_m


@pytest.mark.slow
def test_paths_find_a_device_in_a_narrow_street_that_a_law_puts_where_it_would_see_more(narrow_street, monkeypatch):
    true_m, scene, name = narrow_street.position_m, narrow_street.scene, narrow_street.name
    links = prepare_links(narrow_street.measured, scene)
    law = fit_links(links, scene, SegmentedLogDistance, 0)
    relocation = relocation_from(scene, np.inf)
    assert np.linalg.norm(found(law, name)[0] - true_m) > 15
    position_m, radius_m = found(fit_paths(links, scene, law, relocation), name)
    assert np.linalg.norm(position_m - true_m) < min(4.0, max(radius_m, 2.0))
    # A part of the links asks for the same paths and a few more positions.
    powers = relocation.powers[scene.city]
    followed = {position: len(ends) for position, ends in powers.items()}
    part = links.select(links.flight != 0)
    law = fit_links(part, scene, SegmentedLogDistance, 0)
    position_m, _ = found(fit_paths(part, scene, law, relocation), name)
    assert np.linalg.norm(position_m - true_m) < 4.0
    assert all(len(powers[position]) == count for position, count in followed.items())
    assert max(followed.values()) <= along_paths.LINKS < (links.device == links.device_names.index(name)).sum()
    # Where its errors are too large beside those of others, or devices are too many, it stays.
    for limit in ("MAX_MISFIT", "MAX_DEVICES"):
        with monkeypatch.context() as changed:
            changed.setattr(along_paths, limit, 0)
            assert fit_paths(part, scene, law, relocation).devices == law.devices


def test_a_device_stays_where_the_law_is_too_uncertain_or_no_position_explains_its_levels(narrow_street):
    """Some levels are those of open ground, which the law cannot place in a city; others are mixed up."""
    scene, measured, name = narrow_street.scene, narrow_street.measured, narrow_street.name
    table, rng = measured.table.copy(), np.random.default_rng(2)
    own = table["device"] == name
    distance_m = np.hypot(table["receiver_x_m"] - 300.0, table["receiver_y_m"] - 300.0)
    level_db = -60 - 22 * np.log10(np.hypot(distance_m, 50.0)) + rng.normal(0, 1, len(table))
    for changed_db, max_radius_m in ((level_db[own], 100.0), (rng.permutation(table.loc[own, "gain_db"]), np.inf)):
        changed = table.assign(gain_db=table["gain_db"].mask(own, pd.Series(changed_db, table.index[own])))
        links = prepare_links(Measurements(changed, measured.devices), scene)
        law = fit_links(links, scene, SegmentedLogDistance, 0)
        assert found(law, name)[1] > 100 or np.isinf(max_radius_m)
        assert fit_paths(links, scene, law, relocation_from(scene, max_radius_m)).devices == law.devices


@pytest.mark.slow
def test_as_many_threads_as_there_are_find_the_same_to_the_bit(narrow_street, monkeypatch):
    scene = narrow_street.scene
    links = prepare_links(narrow_street.measured, scene)
    links = links.select(links.flight == 0)
    law, twins = fit_links(links, scene, SegmentedLogDistance, 0), []
    for count in (1, 3):
        monkeypatch.setattr("radiotwin.runtime.processes.thread_count", lambda count=count: count)
        twins.append(fit_paths(links, Scene.load(RBM), law, relocation_from(scene, np.inf)))
    assert twins[0].devices == twins[1].devices
    assert found(twins[0], narrow_street.name)[0].tolist() != found(law, narrow_street.name)[0].tolist()


def test_what_was_followed_and_the_executor_stay_in_this_process(small_scene):
    relocation = relocation_from(small_scene, 100.0)
    relocation.powers[small_scene.city] = {}
    sent = cloudpickle.loads(cloudpickle.dumps(relocation))
    assert sent.bounds == relocation.bounds and not sent.powers and not sent.executor.is_worth_it
    assert small_scene.city in relocation.powers


@pytest.mark.slow
def test_devices_that_are_searched_for_side_by_side_are_at_the_same_place_to_the_bit(narrow_street, monkeypatch, tmp_path):
    scene = narrow_street.scene
    devices = narrow_street.measured.devices.copy()
    more = devices["role"].ne("unknown") & (devices.index == devices.index[devices["role"].ne("unknown")][0])
    devices.loc[more, ["x_m", "y_m"]], devices.loc[more, "role"] = np.nan, "unknown"  # a second one
    links = prepare_links(Measurements(narrow_street.measured.table, devices), scene)
    links = links.select(links.flight == 0)
    law = fit_links(links, scene, SegmentedLogDistance, 0)
    whole = fit_paths(links, Scene.load(RBM), law, relocation_from(scene, np.inf)).devices
    assert sum(device.role == "unknown" for device in whole) >= 2
    with keep_pieces(tmp_path), two_workers("local", one_is_killed=False) as (executor, _):
        # What the workers have found is all that there is: this process searches for none.
        monkeypatch.setattr(along_paths._Search, "from_law", lambda *_: pytest.fail("searched for here"))
        found = fit_paths(links, Scene.load(RBM), law, relocation_from(scene, np.inf, executor=executor)).devices
    assert found == whole
