import numpy as np

from radiotwin.twin.localize.observations import merge_repeats

HERE, THERE = [0.0, 0.0, 60.0], [20.0, 0.0, 60.0]


def test_repeats_become_one_entry():
    receiver_m = np.array([THERE, HERE, HERE, HERE, HERE, HERE])
    device = np.array([4, 4, 4, 4, 4, 9])
    level = np.array([-70.0, -80.0, -83.0, -86.0, np.nan, -50.0])
    merged = merge_repeats(receiver_m, device, level, np.array([4]), use_missed=True)
    (data,) = merged.devices
    places = merged.receiver_m[data.seen].tolist()
    here, there = places.index(HERE), places.index(THERE)
    assert data.device == 4
    assert data.level_db[[here, there]].tolist() == [-83.0, -70.0]
    assert data.count[[here, there]].tolist() == [3, 1]
    assert data.squares[[here, there]].tolist() == [18.0, 0.0]
    assert merged.receiver_m[data.missed].tolist() == [HERE] and data.missed_count.tolist() == [1]


def test_missed_links_are_unused_without_a_limit():
    merged = merge_repeats(
        np.array([HERE]), np.array([0]), np.array([np.nan]), np.array([0]), use_missed=False
    )
    (data,) = merged.devices
    assert not data.usable
