"""Ends with wrong positions: the level changes as the law says of the true ones, for the links of that end only."""

from dataclasses import replace

import numpy as np
import pytest

from radiotwin.effects.catalogue.position_errors import DevicePositionError, ReceiverPositionError

DEVICES_M = np.array([[0.0, 0, 1.5], [150, 40, 1.5]])


def law_db(links, exact=False):
    return -40 - 22 * np.log10(links.distance_m)


@pytest.fixture
def links(make_links):
    rng = np.random.default_rng(0)
    receiver_m = np.column_stack([rng.uniform(-150, 250, (300, 2)), np.full(300, 40.0)])
    return make_links(DEVICES_M, receiver_m, receiver=np.repeat(np.arange(300) % 2, 2))


def moved_db(links, device_m, receiver_m):
    """Level by the law with ends elsewhere, relative to the declared positions."""
    return -22 * np.log10(np.linalg.norm(receiver_m - device_m, axis=1)
                          / np.linalg.norm(links.receiver_m - DEVICES_M[links.device], axis=1))


def test_an_end_elsewhere_changes_its_own_links(links):
    term = DevicePositionError().with_params(DevicePositionError.Params(device=1, move_m=(30.0, -20.0))).term(links, law_db)
    expected_db = moved_db(links, (DEVICES_M + [(0, 0, 0), (30, -20, 0)])[links.device], links.receiver_m)
    np.testing.assert_allclose(term.offset_db, expected_db, atol=1e-9)
    assert np.abs(term.offset_db[links.device == 0]).max() == 0 and np.abs(expected_db).max() > 3
    params = ReceiverPositionError.Params(receiver=0, move_m=(0.0, 5.0, -25.0))
    term = ReceiverPositionError().with_params(params).term(links, law_db)
    position_m = links.receiver_m + np.where(links.receiver == 0, 1.0, 0.0)[:, None] * (0, 5, -25)
    np.testing.assert_allclose(term.offset_db, moved_db(links, DEVICES_M[links.device], position_m), atol=1e-9)


def test_the_one_that_is_wrong_is_proposed_with_its_direction(links, view):
    rng = np.random.default_rng(1)
    noise_db = rng.normal(0, 0.5, len(links))
    moved_m = (DEVICES_M + [(0, 0, 0), (36, -22, 0)])[links.device]
    links.level_db[:] = law_db(links) + moved_db(links, moved_m, links.receiver_m) + noise_db
    (params,) = DevicePositionError().propose(view(links, law_db(links), 0.5, law_db))
    assert params.device == 1 and np.hypot(params.move_m[0] - 36, params.move_m[1] + 22) < 15
    position_m = links.receiver_m + np.where(links.receiver == 1, 1.0, 0.0)[:, None] * (0, 0, 21)
    links.level_db[:] = law_db(links) + moved_db(links, DEVICES_M[links.device], position_m) + noise_db
    (params,) = ReceiverPositionError().propose(view(links, law_db(links), 0.5, law_db))
    assert params == ReceiverPositionError.Params(receiver=1, move_m=(0.0, 0.0, 20.0))


def test_an_end_at_its_declared_position_is_left_there(links, view):
    links.level_db[:] = law_db(links) + np.random.default_rng(2).normal(0, 0.5, len(links))
    given = view(links, law_db(links), 0.5, law_db)
    assert DevicePositionError().propose(given) == [] and ReceiverPositionError().propose(given) == []


def test_sectors_on_one_mast_move_together_and_count_as_one(make_links, view):
    rng = np.random.default_rng(3)
    sectors_m = np.vstack([DEVICES_M, DEVICES_M[1:]])  # the third shares the mast of the second
    receiver_m = np.column_stack([rng.uniform(-150, 250, (300, 2)), np.full(300, 40.0)])
    links = make_links(sectors_m, receiver_m)
    assert DevicePositionError().unavailable(links) is None
    moved_m = (sectors_m + [(0, 0, 0), (36, -22, 0), (36, -22, 0)])[links.device]
    expected_db = -22 * np.log10(np.linalg.norm(receiver_m.repeat(3, axis=0) - moved_m, axis=1)
                                 / np.linalg.norm(links.receiver_m - sectors_m[links.device], axis=1))
    term = DevicePositionError().with_params(DevicePositionError.Params(device=1, move_m=(36.0, -22.0))).term(links, law_db)
    np.testing.assert_allclose(term.offset_db, expected_db, atol=1e-9)
    links.level_db[:] = law_db(links) + expected_db + rng.normal(0, 0.5, len(links))
    (params,) = DevicePositionError().propose(view(links, law_db(links), 0.5, law_db))
    assert params.device == 1 and np.hypot(params.move_m[0] - 36, params.move_m[1] + 22) < 15
    given = replace(view(links, law_db(links), 0.5, law_db), found=(DevicePositionError().with_params(params),))
    assert all(other.device == 0 for other in DevicePositionError().propose(given))


@pytest.mark.parametrize(("effect", "params", "size"), [
    (DevicePositionError(), {"device": 0, "move_m": (3.0, 3.0)}, "4.2 m"),
    (DevicePositionError(), {"device": 0, "move_m": (3.0, 4.2)}, ""),
    (ReceiverPositionError(), {"receiver": 0, "move_m": (0.0, 0.0, 4.9)}, "4.9 m"),
    (ReceiverPositionError(), {"receiver": 0, "move_m": (3.0, 0.0, 4.9)}, "")])
def test_a_move_within_the_accuracy_of_surveys_is_no_effect(effect, params, size):
    why = effect.with_params(effect.Params(**params)).implausible(np.zeros(0))
    assert size in why if size else why is None
