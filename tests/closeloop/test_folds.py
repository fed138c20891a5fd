"""What is held out together."""

import numpy as np

from radiotwin.closeloop.folds import make_folds
from radiotwin.links import prepare_links


def test_flights_are_held_out_where_they_are_alike_and_blocks_of_ground_where_not(open_ground):
    world = open_ground.fly(3)
    links = prepare_links(open_ground.measured(world), None)
    folds = make_folds(links, 0)
    assert folds.by == "flight"
    for flight in range(6):
        assert len(np.unique(folds.index[links.flight == flight])) == 1
    walks = [f"{device}-{receiver}" for device, receiver in zip(world.device, world.receiver)]
    one = prepare_links(open_ground.measured(world, flight=walks), None)
    folds = make_folds(one, 0)
    assert folds.by == "block" and folds.count == 6
    cell = np.floor(one.receiver_m[:, :2] / 60).astype(int)
    for square in np.unique(cell, axis=0)[:40]:
        assert len(np.unique(folds.index[(cell == square).all(axis=1)])) == 1
    sizes = np.bincount(folds.index)
    assert sizes.max() < 1.3 * sizes.min()
