"""Candidates are judged by held-out links, and refused where those cannot tell."""

import numpy as np

from radiotwin.closeloop.bases import LogDistanceBase
from radiotwin.closeloop.folds import make_folds
from radiotwin.links.link_data import prepare_links
from radiotwin.closeloop.run import close_loop
from radiotwin.closeloop.selection import CandidateScore, Model, _weigh, cross_validate


def test_an_offset_that_no_fold_has_links_enough_for_is_not_kept(open_ground):
    """Two devices, one of them 10 dB too strong, with 30 links each: as many as are needed, and fewer in each fold."""
    world = open_ground.fly(0)
    world.gain_db[world.device == 1] += 10.0
    few = (world.receiver == 0) & (world.device < 2) & (world.slot % 11 == 5)
    assert np.bincount(world.device[few]).tolist() == [30, 30]
    loop = close_loop(open_ground.measured(world).select(few), None, "log-distance", 0, lambda text: None)
    (offset,) = [judged for judged in loop.search.log if judged.name == "device_gain_offset"]
    assert not offset.kept and "gains 0 nats on held-out links" in offset.reason


def test_what_no_held_out_link_tells_is_refused(open_ground):
    links = prepare_links(open_ground.measured(open_ground.fly(0)), None)
    model = cross_validate(links, LogDistanceBase(None, 0), make_folds(links, 0))
    extended = Model(model.whole, model.folds, model.fits, model.index)
    extended.held_out_nll = np.full(len(links), np.nan)
    judged = _weigh(model, extended, CandidateScore("device_gain_offset", False, "", np.nan, np.nan, np.nan, 0), None, 1, 0)
    assert "no held-out link" in judged.reason
