"""The search for effects: stages, each of which takes a state and returns the next one."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace

from radiotwin.closeloop.crossfit import Base, CrossFit, Folds
from radiotwin.closeloop.scan import Anomaly
from radiotwin.closeloop.search.trials import Trial, TrialLog
from radiotwin.closeloop.verdict.criteria import SelectionCriteria
from radiotwin.closeloop.verdict.hypotheses import Hypotheses
from radiotwin.closeloop.verdict.posterior import Step
from radiotwin.effects.base import Effect
from radiotwin.links import Links
from radiotwin.runtime.execution import Executor


@dataclass(frozen=True, eq=False)
class SearchInputs:
    """What is the same in every stage.

    Attributes:
        links: n links as the base was given them.
        base: kind of model that the search begins with.
        folds: of the links.
        effects: candidates.
        criteria: thresholds that decide.
        seed: of folds and permutations.
        executor: where candidates are fitted.
        on_progress: called with what is being done.
    """

    links: Links
    base: Base
    folds: Folds
    effects: tuple[Effect, ...]
    criteria: SelectionCriteria = field(default_factory=SelectionCriteria)
    seed: int = 0
    executor: Executor = field(default_factory=Executor)
    on_progress: Callable[[str], None] = lambda _: None

    @property
    def undeclared(self) -> list[Effect]:
        """Candidates that are searched for; the others are part of the base."""
        return [each for each in self.effects if not each.is_declared]


@dataclass(frozen=True, eq=False)
class SearchState:
    """What a search has found so far.

    Attributes:
        model: base and effects; these are in the order of `log.kept`.
        log: trials. Not every refused one is logged: of faults only those of the last round are,
            of effects beside another (pairs, more of a kind) only those kept.
        steps: what the residual says before each named effect; the last is of what is left.
        looked_at: the model that was looked at last, and the hypotheses about what it lacks.
        anomalies: groups of links that stand out in the residual of the base, with their causes.
        notes: what was found about effects that are declared, a sentence each.
    """

    model: CrossFit
    log: TrialLog = field(default_factory=TrialLog)
    steps: tuple[Step, ...] = ()
    looked_at: tuple[CrossFit, Hypotheses] | None = None
    anomalies: tuple[Anomaly, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def step(self) -> int:
        """Number of effects in the model."""
        return len(self.model.whole.effects)

    def is_full(self, criteria: SelectionCriteria) -> bool:
        """Return whether no more effects may be added."""
        return self.step >= criteria.max_effects

    def look(self, seed: int) -> tuple[SearchState, Hypotheses]:
        """Return the state with hypotheses about what its model lacks, made once for each model."""
        if self.looked_at is not None and self.looked_at[0] is self.model:
            return self, self.looked_at[1]
        found = Hypotheses.of(self.model.whole, seed)
        return replace(self, looked_at=(self.model, found)), found

    def keep(self, trial: Trial, model: CrossFit) -> SearchState:
        """Return the state with one more effect, which may have been scored in other folds."""
        kept = trial.keep(rmse_db=model.rmse_db())
        return replace(self, model=model, log=self.log.record(kept))

    def refuse(self, *trials: Trial) -> SearchState:
        """Return the state with trials whose effects are not added."""
        return replace(self, log=self.log.record(*trials))

    def note(self, sentence: str) -> SearchState:
        """Return the state with one more note."""
        return replace(self, notes=(*self.notes, sentence))


Stage = Callable[[SearchState, SearchInputs], SearchState]


def search(state: SearchState, stages: Iterable[Stage], inputs: SearchInputs) -> SearchState:
    """Return what stages find, one after the other.

    Args:
        state: to begin with.
        stages: that add effects to the model, or take them back, and log their trials.
        inputs: of every stage.
    """
    for stage in stages:
        state = stage(state, inputs)
    return state
