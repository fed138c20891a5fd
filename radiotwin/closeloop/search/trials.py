"""Trials of effects and their log, from which `closeloop.json` and the pages are made.

A trial is immutable. A later judgement is a new trial with the same number, which supersedes it.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from radiotwin.effects.params import EffectParams


@dataclass(frozen=True, eq=False)
class Trial:
    """Result of trying one effect in addition to those found before.

    Attributes:
        name: name of the effect.
        kept: whether it was added to the model.
        reason: why it was refused; empty if it was kept.
        nll_gain: gain of held-out log likelihood [nats]; NaN if it was not scored.
        rmse_db: held-out RMSE with the effect [dB].
        step: number of effects in the model before.
        gain_by_fold: (folds,) `nll_gain` of each fold, divided by the design effect;
            empty if it was not scored.
        evidence_nats: evidence given correlated residuals, see `Hypotheses`; NaN if not computed.
        passed: whether held-out links support it; it may be refused for other reasons.
        features: (5,) features of its probability, see `radiotwin.closeloop.verdict.posterior`;
            empty if it was not scored.
        probability: posterior probability of the effect.
        params: parameters fitted to all links; None if it was not scored.
        variant: variant of the effect.
        devices: names of the devices that it acts on, see `ends_of`.
        receivers: names of the receivers that it acts on.
        rivals: if it was kept, names of effects that the data cannot tell from it.
        number: index in the log; None before it is logged.
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
        """Held-out gain over the design effect, so that correlated links count once [nats]."""
        return float(self.gain_by_fold.sum())

    @property
    def nats(self) -> float:
        """`evidence_nats`, or `held_out_nats` if the effect changes no levels."""
        return self.evidence_nats if np.isfinite(self.evidence_nats) else self.held_out_nats

    @property
    def is_open(self) -> bool:
        """Whether it is neither kept nor refused yet."""
        return not self.kept and not self.reason

    def keep(self, **changes: Any) -> Trial:
        """Return the trial marked as kept, with further changes."""
        return replace(self, kept=True, reason="", **changes)

    def refuse(self, reason: str, **changes: Any) -> Trial:
        """Return the trial marked as refused for a reason, with further changes."""
        return replace(self, kept=False, reason=reason, **changes)


@dataclass(frozen=True, eq=False)
class TrialLog:
    """The latest version of each trial, in the order of recording."""

    trials: tuple[Trial, ...] = ()

    @property
    def kept(self) -> list[Trial]:
        """Trials whose effects are in the model, in the order of its effects."""
        return [each for each in self.trials if each.kept]

    def of_step(self, step: int) -> list[Trial]:
        """Return the trials made when the model had `step` effects."""
        return [each for each in self.trials if each.step == step]

    def record(self, *trials: Trial) -> TrialLog:
        """Return the log with further trials, and number them."""
        return TrialLog((*self.trials, *(replace(each, number=number) for number, each in
                                         enumerate(trials, start=len(self.trials)))))

    def supersede(self, *trials: Trial) -> TrialLog:
        """Return the log with some of its trials replaced by newer versions (of equal number)."""
        return TrialLog(tuple({each.number: each for each in (*self.trials, *trials)}.values()))
