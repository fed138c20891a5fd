"""A receiver that reads too much has a limit of detection that is as much higher."""

import numpy as np
import pytest

from radiotwin.closeloop.search.causes import add_causes
from radiotwin.closeloop.search.stages import SearchState, search
from radiotwin.effects.catalogue.detection_limit import DetectionLimit
from radiotwin.effects.catalogue.gain_offsets import ReceiverGainOffset
from radiotwin.links import prepare_links
from radiotwin.links.limits import with_usual_limits
from tests.closeloop.looking import based

LIMIT_DB = -97.0


@pytest.mark.parametrize("off_db, limit_moves, named", [
    (6.0, True, ["receiver_gain_offset"]), (6.0, False, ["receiver_gain_offset"]),
    (0.0, True, ["noise_floor_censoring"])])
def test_one_fault_has_one_name(open_ground, off_db, limit_moves, named):
    world = open_ground.fly(3)
    mine = world.receiver == 1
    limit_db = np.where(mine & limit_moves, LIMIT_DB + 6.0, LIMIT_DB)
    world.gain_db += np.where(mine, off_db, 0.0)
    world.gain_db[world.gain_db < limit_db] = np.nan
    world.limit_db = -np.inf
    links = with_usual_limits(prepare_links(open_ground.measured(world), None))
    model, inputs = based(links, ReceiverGainOffset(), DetectionLimit())
    result = search(SearchState(model), [add_causes], inputs)
    assert [each.name for each in result.model.whole.effects] == named
    used_db = [float(np.median(result.model.whole.model.limit_db[links.receiver == receiver])) for receiver in (0, 1)]
    assert used_db == pytest.approx([LIMIT_DB, LIMIT_DB + 6.0 * limit_moves], abs=1.0)
