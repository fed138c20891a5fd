"""Evidence in a world over open ground."""

from radiotwin.closeloop.crossfit import LogDistanceBase, cross_validate, make_folds
from radiotwin.closeloop.verdict.hypotheses import Hypotheses
from radiotwin.links import prepare_links


def looked_at(open_ground, seed, change=lambda world: None):
    """Return the model without effects, and the hypotheses about what it lacks."""
    world = open_ground.fly(seed)
    change(world)
    links = prepare_links(open_ground.measured(world), None)
    folds = make_folds(links, 0)
    model = cross_validate(links, LogDistanceBase(None, 0), folds)
    return model, Hypotheses.of(model.whole, 0)
