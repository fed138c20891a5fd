"""State and inputs of the search for effects, which stages pass on from one to the next."""

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
    """Inputs that are the same in every stage.

    Attributes:
        links: the n links to which the base was fitted.
        base: the base with which the search begins.
        folds: assignment of the links.
        effects: candidates of the catalogue, declared effects included.
        criteria: thresholds.
        seed: random seed of folds and samples.
        executor: where candidates are fitted.
        on_progress: called with a text on each step.
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
        """Effects to be searched for; declared effects are part of the base."""
        return [each for each in self.effects if not each.is_declared]


@dataclass(frozen=True, eq=False)
class SearchState:
    """Result of a search so far.

    Attributes:
        model: base and effects, in the order of `log.kept`.
        log: trials. Of faults only the refused ones of the last round are logged, of effects that
            were tried together only the kept ones.
        steps: summary of the residual before each named effect, and of the final one.
        last_hypotheses: the latest model with hypotheses, and these.
        anomalies: groups of links that stand out in the residual of the base, with their causes.
        notes: sentences about declared effects.
    """

    model: CrossFit
    log: TrialLog = field(default_factory=TrialLog)
    steps: tuple[Step, ...] = ()
    last_hypotheses: tuple[CrossFit, Hypotheses] | None = None
    anomalies: tuple[Anomaly, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def step(self) -> int:
        """Number of effects in the model."""
        return len(self.model.whole.effects)

    def is_full(self, criteria: SelectionCriteria) -> bool:
        """Return whether the model has `max_effects` effects."""
        return self.step >= criteria.max_effects

    def with_hypotheses(self, seed: int) -> tuple[SearchState, Hypotheses]:
        """Return the state with the evidence for further effects, computed once for each model."""
        if self.last_hypotheses is not None and self.last_hypotheses[0] is self.model:
            return self, self.last_hypotheses[1]
        found = Hypotheses.of(self.model.whole, seed)
        return replace(self, last_hypotheses=(self.model, found)), found

    def keep(self, trial: Trial, model: CrossFit) -> SearchState:
        """Return the state with one more effect in its model, and the trial logged as kept."""
        kept = trial.keep(rmse_db=model.rmse_db())
        return replace(self, model=model, log=self.log.record(kept))

    def refuse(self, *trials: Trial) -> SearchState:
        """Return the state with the trials of effects logged that are not added."""
        return replace(self, log=self.log.record(*trials))

    def note(self, sentence: str) -> SearchState:
        """Return the state with one more note for the user."""
        return replace(self, notes=(*self.notes, sentence))


Stage = Callable[[SearchState, SearchInputs], SearchState]


def search(state: SearchState, stages: Iterable[Stage], inputs: SearchInputs) -> SearchState:
    """Run the stages of a search one after the other, each on the state that the last one left.

    Args:
        state: initial state.
        stages: functions that add effects to the model or remove them, and log their trials.
        inputs: inputs of every stage.
    """
    for stage in stages:
        state = stage(state, inputs)
    return state
