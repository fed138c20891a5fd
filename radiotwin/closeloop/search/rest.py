"""Describe the residual that no cause explains: trends over variables, and shadowing by place."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from radiotwin.closeloop.search.causes import forward_selection
from radiotwin.closeloop.search.scoring import score_model
from radiotwin.closeloop.search.stages import SearchInputs, SearchState
from radiotwin.closeloop.search.trials import Trial
from radiotwin.effects.registry import trend_over
from radiotwin.links import residual_variables
from radiotwin.twin.model.correlated_shadowing import NAME as SHADOWING


def add_trends(state: SearchState, inputs: SearchInputs, variables: Sequence[str]) -> SearchState:
    """Fit the remaining residual by curves over variables; keep those that improve held-out links.

    Such a trend only describes the residual. At most `max_trends` variables are tried.

    Args:
        state: state of the search, with all causes that were found.
        inputs: inputs of the search.
        variables: variables on which the residual depends, the most significant first.
    """
    values = residual_variables(state.model.links, state.model.held_out_mean_db)
    trends = [trend_over(name) for name in variables
              if values[name].dtype.kind == "f"]  # labels have no order, so no curve
    return forward_selection(state, trends[:inputs.criteria.max_trends], inputs)


def add_shadowing(state: SearchState, inputs: SearchInputs) -> SearchState:
    """Interpolate the residual over positions (kriging), if that makes held-out links likelier."""
    inputs.on_progress(SHADOWING)
    model = state.model
    fields = [each.fit_shadowing(inputs.seed) for each in model.fits]
    # The second try corrects the mean only and leaves the error scale as wide as before, which may
    # help if the field does not repeat on held-out flights.
    for tried in (fields, [replace(each, certain=False) for each in fields]):
        extended = model.map(lambda fit, field: replace(fit, shadowing=field), tried)
        trial = score_model(model, extended, Trial(SHADOWING, step=state.step), inputs.criteria,
                            inputs.criteria.min_gain_nats)
        if not trial.reason:
            return replace(state, model=extended, log=state.log.record(trial.keep()))
    return state.refuse(trial)
