"""Add declared effects and usual map errors to the base, before causes are searched for."""

from __future__ import annotations

from radiotwin.closeloop.search.scoring import fit_and_score
from radiotwin.closeloop.search.stages import SearchInputs, SearchState
from radiotwin.effects.base import Effect


def add_declared(state: SearchState, inputs: SearchInputs) -> SearchState:
    """Add effects that the tables declare, such as sector antennas, if held-out links support them.

    The held-out likelihood must increase; no probability is needed. An effect that the readings
    contradict is left out, with a note. If an effect has several variants, the best one is added.
    """
    declared = [effect for effect in inputs.effects if effect.is_declared]
    for name in dict.fromkeys(effect.name for effect in declared):
        forms = [effect for effect in declared if effect.name == name
                 and not effect.unavailable(state.model.links)]
        state = _with_best(state, forms, inputs)
    return state


def _with_best(state: SearchState, forms: list[Effect], inputs: SearchInputs) -> SearchState:
    """Try the variants (`forms`) of one declared effect; add that of most held-out gain, if any."""
    before = state.model
    tried, passed = [], []
    for effect in forms:
        inputs.on_progress(effect.variant)
        trial, extended = fit_and_score(before, effect, inputs)
        tried.append(trial)
        if extended is not None:
            passed.append((effect, trial, extended))
    if passed:
        effect, best, extended = max(passed, key=lambda each: each[1].held_out_nats)
        state = state.note(
            f"{effect.variant} are part of the base: the RMSE on held-out links is "
            f"{best.rmse_db:.2f} dB, and {before.rmse_db():.2f} dB without them")
        for sentence in extended.whole.effects[-1].contradicted_declarations(extended.links):
            state = state.note(sentence)
        return state.keep(best, extended).refuse(*(
            each.refuse(each.reason or f"{effect.variant} gain more")
            for each in tried if each is not best))
    if tried and forms[0].is_cause:
        state = state.note(f"{forms[0].variant} do not agree with the readings and are left out: "
                           f"{tried[0].reason}")
    return state.refuse(*tried)
