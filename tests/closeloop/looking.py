"""The base over open ground, and the evidence for what it lacks."""

from radiotwin.closeloop.crossfit import LogDistanceBase, cross_validate, make_folds
from radiotwin.closeloop.search.stages import SearchInputs
from radiotwin.closeloop.verdict.hypotheses import Hypotheses
from radiotwin.links import Links, prepare_links


def based(measured, *effects, by="auto", **others):
    """Return the base log-distance of measurements (or links), and what a search for effects is given."""
    links = measured if isinstance(measured, Links) else prepare_links(measured, None)
    folds, base = make_folds(links, 0, by), LogDistanceBase(None, 0)
    return cross_validate(links, base, folds), SearchInputs(links, base, folds, effects, **others)


def looked_at(open_ground, seed, change=lambda world: None):
    """Return the model without effects, and the hypotheses about what it lacks."""
    world = open_ground.fly(seed)
    change(world)
    model, _ = based(open_ground.measured(world))
    return model, Hypotheses.of(model.whole, 0)
