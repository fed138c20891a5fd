"""Thresholds that decide which effects the loop keeps and names."""

from __future__ import annotations

from dataclasses import dataclass, fields

from radiotwin.errors import BadInput

# Search (`radiotwin.closeloop.search`).
MIN_FIRST_SHARE = 0.5  # a candidate this share of `min_probability` probable is tried with a second
MAX_SECONDS = 2  # second effects that are tried with such a candidate
MIN_RIVAL_SHARE = 0.5  # share of the best candidate's gain from which repeats of another are tried
SAME_DB = 1.5  # offset of a receiver's limit and of its readings this close are one fault [dB]
MIN_SHARED = 0.5  # share of links in common from which two faults or groups are the same
MIN_HELD_OUT_DEVICES = 4  # anchors from which devices, not blocks, are held out to judge a fault
MAX_LOSS_NATS = 0.01  # accepted loss per held-out link if relocated devices make more predictable
# Intervals (`radiotwin.closeloop.verdict.intervals`).
MIN_FOLDS = 0.5  # share of the folds that must have found a parameter for it to be determined
MIN_CLUSTERS = 3  # effective number of clusters from which a standard deviation is estimated
# Probabilities (`radiotwin.closeloop.verdict.posterior`); the weights are in calibration.json.
MIN_SURE = 0.9  # probability of a group from which the verdict is `located`
LEAST_RATIO = 0.2  # smaller ratios of place-bound residual to noise count as this
NATS = 10.0  # the evidence feature is linear below about this, logarithmic above
LIKELY = 0.05  # less probable causes are not reported
EXPLAINED = 0.3  # share of a simulated pattern that a search must explain to have found it


@dataclass(frozen=True)
class SelectionCriteria:
    """Thresholds of selection and verdict; saved in `closeloop.json`.

    Attributes:
        min_training_gain_nats: least gain on all links for a candidate to be fitted to the folds.
            It saves time: with less, a cause is hardly probable.
        min_gain_nats: least held-out gain of a trend or of interpolated shadowing, which have no
            probability.
        min_probability: least probability of a cause that is named
            (`radiotwin.closeloop.verdict.posterior`).
        max_rest_db: largest standard deviation of unexplained place-bound residual for the verdict
            `none`.
        max_rmse_rise: largest ratio of held-out RMSE with an effect to that without.
        indistinguishable_nats: log(100): difference of evidence from which two effects can be told
            apart.
        max_effects: largest number of effects in all.
        max_repeats: largest number of repeats of one effect in one step.
        max_dependence_p_value: significance of a residual's dependence on a variable, corrected
            after Holm.
        min_dependence_db: least standard deviation of the residual's mean over that variable.
        max_trends: largest number of trends that describe the residual.
        min_repeats_for_noise: least number of repeats at one position for a noise floor.
    """

    min_training_gain_nats: float = 10.0
    min_probability: float = 0.5
    max_rest_db: float = 3.0
    min_gain_nats: float = 25.0
    max_rmse_rise: float = 1.01
    indistinguishable_nats: float = 4.605170185988092
    max_effects: int = 12
    max_repeats: int = 4
    max_dependence_p_value: float = 0.01
    min_dependence_db: float = 0.5
    max_trends: int = 4
    min_repeats_for_noise: int = 30

    def __post_init__(self) -> None:
        for each in fields(self):
            if not getattr(self, each.name) >= 0:
                raise BadInput(f"SelectionCriteria.{each.name} is {getattr(self, each.name)}; "
                               "allowed are numbers from 0")
