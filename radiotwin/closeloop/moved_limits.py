"""The limit of detection of a receiver that reads too much or too little, moves with its readings.

A receiver hears the same signals whatever its cable or calibration adds to what it reads. Where its
blanks begin as many decibels from the usual limit as its readings are off, that is one fault.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from radiotwin.closeloop.cross_validation import CrossValidatedModel
from radiotwin.effects.detection_limit import DetectionLimit
from radiotwin.effects.gain_offsets import ReceiverGainOffset

SAME_DB = 1.5  # between what the limit and what the readings are off


def with_moved_limits(model: CrossValidatedModel) -> CrossValidatedModel:
    """Return a model in which limits are moved by the offsets of receivers that were kept last.

    Args:
        model: of n links; any other last effect leaves it as it is.
    """
    whole, fit = model.whole, model.fits[0]
    offsets = whole.effects[-1]
    if not isinstance(offsets.effect, ReceiverGainOffset):
        return model
    limits = DetectionLimit().propose(whole.view(fit))
    own_db = fit.coefficients[whole.coefficient_slices[-1]]
    off_db = dict(zip(offsets.params.members, own_db - np.median(own_db), strict=True))
    limit_db = model.links.limit_db.copy()
    for receiver, found_db in (limits[0].receivers if limits else {}).items():
        mine = model.links.receiver == receiver
        if abs(found_db - np.median(limit_db[mine]) - off_db.get(receiver, np.inf)) <= SAME_DB:
            limit_db[mine] = found_db
    if np.array_equal(limit_db, model.links.limit_db):
        return model
    models = [replace(each, links=replace(each.links, limit_db=limit_db)) for each in model.models]
    fits = [each.fit(old) for each, old in zip(models, model.fits, strict=True)]
    return model.extended(models, fits)
