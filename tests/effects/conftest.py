"""Worlds of the close-loop's tests, and links made by hand."""

from types import SimpleNamespace

import numpy as np
import pytest

import radiotwin as rt
from radiotwin.closeloop.output.result_file import scores
from radiotwin.effects.base import ResidualView
from tests.worlds import make_links, open_ground, shortened

__all__ = ["make_links", "open_ground"]


def with_params(effect, levels=None, **params):
    """Return an effect of a class with these parameters."""
    return effect().with_params(effect.Params(**params), levels)


def law_db(links, exact=False):
    return -40 - 22 * np.log10(links.distance_m)


@pytest.fixture
def view():
    """Make the view of links whose predicted levels (n,) and whose scale of the errors [dB] are known."""
    def make(links, mean_db=0.0, scale_db=1.0, level_at=None):
        mean_db = np.broadcast_to(mean_db, len(links))
        excess_db = np.where(np.isfinite(links.limit_db), links.limit_db - mean_db, 0.0)
        residual_db = np.where(np.isnan(links.level_db), np.minimum(excess_db, 0.0),
                               links.level_db - mean_db)
        return ResidualView(links, residual_db, np.full(len(links), float(scale_db)), mean_db, level_at)
    return make


@pytest.fixture
def loop():
    """Close the loop over measurements without a map: names of the effects found, and the first one's parameters."""
    def run(measurements):
        with shortened():
            closed = rt.close_loop(measurements, base="log-distance")
        return SimpleNamespace(error={"before": scores(closed.before), "after": scores(closed.after)},
                               names=[each.name for each in closed.after.whole.effects],
                               first=(closed.parameters or [{}])[0])
    return run
