"""Candidates are scored on held-out links, and refused where those do not support them."""

import numpy as np

from radiotwin.closeloop.bases import LogDistanceBase
from radiotwin.closeloop.criteria import SelectionCriteria
from radiotwin.closeloop.cross_validation import CrossValidatedModel, cross_validate, training_parts
from radiotwin.closeloop.folds import make_folds
from radiotwin.closeloop.run import close_loop
from radiotwin.closeloop.scoring import CandidateScore, score_model
from radiotwin.links import prepare_links


def test_an_offset_that_no_fold_has_links_enough_for_is_not_kept(open_ground):
    """Two devices, one of them 10 dB too strong, with 30 links each: as many as are needed, and fewer in each fold."""
    world = open_ground.fly(0)
    world.gain_db[world.device == 1] += 10.0
    few = (world.receiver == 0) & (world.device < 2) & (world.slot % 11 == 5)
    assert np.bincount(world.device[few]).tolist() == [30, 30]
    loop = close_loop(open_ground.measured(world).select(few), base="log-distance")
    (offset,) = [score for score in loop.selection.scores if score.name == "device_gain_offset"]
    assert not offset.kept and "gains 0 nats on held-out links" in offset.reason


def test_a_candidate_that_no_held_out_link_can_judge_is_refused(open_ground):
    links = prepare_links(open_ground.measured(open_ground.fly(0)), None)
    folds = make_folds(links, 0)
    model = cross_validate(links, LogDistanceBase(None, 0), folds, training_parts(links, folds))
    extended = CrossValidatedModel(model.whole, model.folds, model.fits, model.index, model.twin)
    extended.held_out_nll = np.full(len(links), np.nan)
    score = score_model(model, extended, CandidateScore("device_gain_offset"), None, 1, 0, SelectionCriteria())
    assert "no held-out link" in score.reason
