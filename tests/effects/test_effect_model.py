"""A fitted model of channel and effects, apart from its links."""

import numpy as np

from radiotwin.channel.log_distance import LogDistance
from radiotwin.effects.effect_model import EffectModel
from radiotwin.effects.fold_model import FittedEffect
from radiotwin.effects.lock_loss import LockLoss
from radiotwin.effects.path_strength import WallReflection
from radiotwin.effects.roof_heights import RoofHeights
from radiotwin.inference.censored_line import LogDistanceLine


def test_positions_are_sought_without_what_follows_paths_or_many_maps():
    """Each of thousands of places would need its own paths."""
    effects = tuple(FittedEffect(effect(), None, np.zeros(0)) for effect in (LockLoss, WallReflection, RoofHeights))
    model = EffectModel(LogDistance(LogDistanceLine(-40.0, 2.2, 3.0)), effects, np.zeros(2), np.array([2.0]), 5.0,
                        np.zeros((1, 3)), ("u0",), np.nan, 0.0)
    assert [each.effect.name for each in model.for_positions().effects] == ["lock_loss"]
    assert len(model.effects) == 3
