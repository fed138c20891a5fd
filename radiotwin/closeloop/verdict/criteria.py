"""Every threshold that decides what the loop keeps and says, in one place."""

from __future__ import annotations

from dataclasses import dataclass, fields

from radiotwin.errors import BadInput

# Of single judgements, which no caller sets.
MIN_FIRST_SHARE = 0.5  # of `min_probability`, for another effect to be tried beside a candidate
MAX_SECONDS = 2  # effects that are tried beside it
MIN_RIVAL_SHARE = 0.5  # of what the best gains, for several of a kind to be tried in its place
SAME_DB = 1.5  # between what a receiver's limit and its readings are off, to be one fault
MIN_SHARED = 0.5  # of a fault's, on which its rival acts, or the same fault found again
MIN_HELD_OUT_DEVICES = 4  # of known position, to hold some of them out where a fault is judged
MAX_LOSS_NATS = 0.01  # a held-out link, where devices that are located anew can predict more links
# Of intervals (`radiotwin.closeloop.verdict.intervals`).
MIN_FOLDS = 0.5  # share of the folds that must have found a parameter, too
MIN_CLUSTERS = 3  # effective ones, of which a spread can be told
# Of probabilities (`radiotwin.closeloop.verdict.posterior`); the weights are in calibration.json.
MIN_SURE = 0.9  # of a group for the verdict `located`; what is less sure is said to be probable
LEAST_RATIO = 0.2  # of what belongs to places to noise; less is none
NATS = 10.0  # evidence is linear up to about this, and logarithmic beyond
LIKELY = 0.05  # a cause that is less probable is not worth a word
EXPLAINED = 0.3  # of what a pattern explains, for a search to have found it; it is refined later


@dataclass(frozen=True)
class SelectionCriteria:
    """Thresholds of selection and verdict; saved in `closeloop.json`.

    "Calibrated" means: chosen on the hidden and the null cases of `tests/undeclared`
    (`python -m studies hidden`, `null`), before others judged it.

    Attributes:
        min_training_gain_nats: on the links that it is fitted to, for a candidate to be fitted to
            the folds. Saves time: one that gains less is hardly probable.
        min_gain_nats: on held-out links, for a description of the rest, which has no probability.
        min_probability: that a cause is there, to be named; it is told with the name: more probable
            than not (`radiotwin.closeloop.verdict.posterior`).
        max_rest_db: standard deviation of what belongs to places and has no name, for
            "none" to be said.
        max_rmse_rise: held-out RMSE with the effect over that without, above which likelier links
            do not help.
        indistinguishable_nats: log(100): how much likelier the data must be with one effect than
            with another to tell them apart.
        max_effects: in all.
        max_repeats: of one repeatable effect in one step.
        max_dependence_p_value: of a residual's dependence on a variable (Holm-corrected).
        min_dependence_db: standard deviation of the residual's mean over the variable; a weaker
            dependence changes no decision.
        max_trends: variables that the rest is described by, strongest first.
        min_repeats_for_noise: measurements repeated at one position, to estimate the noise floor.
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
