"""Trials of effects, and their log, from which `closeloop.json` and the pages are made.

A trial never changes. Where a later judgement changes what is said of it, a new trial with its
number supersedes it.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from radiotwin.effects.params import EffectParams


@dataclass(frozen=True, eq=False)
class Trial:
    """An effect that was tried beside a model, and what held-out links say of it.

    Attributes:
        name: of the effect.
        kept: whether it was added.
        reason: why not; empty where it was.
        nll_gain: held-out likelihood gained [nats]; NaN where it was not tried.
        rmse_db: held-out RMSE with it [dB].
        step: number of effects that were there before.
        gain_by_fold: (folds,) `nll_gain` of each fold, divided by the design effect;
            empty where it was not tried.
        evidence_nats: beside errors of the base that are correlated, see `Hypotheses`; NaN where
            it was not looked at.
        passed: whether held-out links support it; it may be refused for other reasons.
        features: (5,) what its probability depends on, see `radiotwin.closeloop.verdict.posterior`;
            empty where it was not tried.
        probability: that it is there.
        params: as fitted to all links; None where it was not tried.
        variant: of the effect.
        devices: names of those that `params` belong to, see `ends_of`.
        receivers: the same of receivers.
        rivals: of a kept effect, names of those that the data cannot tell from it.
        number: its place in the log; None before it is in one.
    """

    name: str
    kept: bool = False
    reason: str = ""
    nll_gain: float = np.nan
    rmse_db: float = np.nan
    step: int = 0
    gain_by_fold: np.ndarray = field(default_factory=lambda: np.zeros(0))
    evidence_nats: float = np.nan
    passed: bool = False
    features: tuple[float, ...] = ()
    probability: float = np.nan
    params: EffectParams | None = None
    variant: str = ""
    devices: tuple[str, ...] = ()
    receivers: tuple[str, ...] = ()
    rivals: tuple[str, ...] = ()
    number: int | None = None

    @property
    def held_out_nats(self) -> float:
        """Gain on held-out links, those that err alike counted as one [nats]."""
        return float(self.gain_by_fold.sum())

    @property
    def nats(self) -> float:
        """Evidence beside a correlated rest; on held-out links where residuals do not show it."""
        return self.evidence_nats if np.isfinite(self.evidence_nats) else self.held_out_nats

    @property
    def is_open(self) -> bool:
        """Whether it was neither kept nor refused."""
        return not self.kept and not self.reason

    def keep(self, **changes: Any) -> Trial:
        """Return the same trial as one whose effect was added to the model."""
        return replace(self, kept=True, reason="", **changes)

    def refuse(self, reason: str, **changes: Any) -> Trial:
        """Return the same trial as one whose effect was left out, or taken back."""
        return replace(self, kept=False, reason=reason, **changes)


@dataclass(frozen=True, eq=False)
class TrialLog:
    """The last word on each trial, in the order in which they were recorded."""

    trials: tuple[Trial, ...] = ()

    @property
    def kept(self) -> list[Trial]:
        """Trials whose effects are in the model, in the order of its effects."""
        return [each for each in self.trials if each.kept]

    def of_step(self, step: int) -> list[Trial]:
        """Return the trials beside a model with `step` effects."""
        return [each for each in self.trials if each.step == step]

    def record(self, *trials: Trial) -> TrialLog:
        """Return the log with further trials, which get their numbers here."""
        return TrialLog((*self.trials, *(replace(each, number=number) for number, each in
                                         enumerate(trials, start=len(self.trials)))))

    def supersede(self, *trials: Trial) -> TrialLog:
        """Return the log with a later word on trials that are in it.

        Raises:
            ValueError: a trial that was never recorded.
        """
        later = {each.number: each for each in (*self.trials, *trials)}
        if len(later) > len(self.trials):
            unknown = [each.name for each in trials if each.number not in range(len(self.trials))]
            raise ValueError(f"trials of {', '.join(unknown)} are not in the log: record them")
        return TrialLog(tuple(later.values()))
