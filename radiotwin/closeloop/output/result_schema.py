"""Schema of `closeloop.json`, with which files of unknown origin are checked."""

from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from radiotwin.effects.base import Levels
from radiotwin.io.forms import Metres, Origin, Real, Record, Whole


class ScoresRecord(Record):
    """Errors of a model on a group of links; further fields are numbers."""

    model_config = {"extra": "allow"}
    __pydantic_extra__: dict[str, Real | None]

    n: Whole
    rmse_db: Real | None


class BaselineRecord(ScoresRecord):
    """Errors of a baseline on all links."""

    n: Whole = 0


class BothRecord(Record):
    """Errors without and with the effects."""

    before: ScoresRecord
    after: ScoresRecord


class ErrorRecord(BothRecord):
    """Errors on all links, and on groups of links by the group's name."""

    combined: ScoresRecord | None = None
    map: ScoresRecord | None = None
    after_same_links: ScoresRecord | None = None  # on the links of `before` only
    after_with_quality: ScoresRecord | None = None
    learnable: BothRecord | None = None  # without links that others cannot predict
    noise_floor_db: Real | None
    by_los: dict[Literal["los", "nlos"], BothRecord] = Field(default_factory=dict)
    by_device: dict[str, BothRecord] = Field(default_factory=dict)
    by_receiver: dict[str, BothRecord] = Field(default_factory=dict)
    by_flight: dict[str, BothRecord] = Field(default_factory=dict)


class ParameterRecord(Record):
    """Estimate with its 90 % interval; `determined`: whether the data determine it."""

    value: Real | None
    low: Real | None
    high: Real | None
    unit: str
    determined: bool = True


class KnownParameterRecord(ParameterRecord):
    """Estimate with a known 90 % interval."""

    value: Real
    low: Real
    high: Real


class EvidenceRecord(Record):
    """Held-out gain and evidence for an effect [nats]."""

    heldout_nll_gain: Real | None
    evidence_nats: Real | None = None


Corner = Annotated[list[Metres], Field(min_length=2, max_length=2)]


class PlaceRecord(Record):
    """Place of an effect: a building, an emitter, or a device that it acts on."""

    device: str = ""
    x_m: Metres
    y_m: Metres
    outline_m: Annotated[list[Corner], Field(max_length=100)] | None = None


class EffectRecord(Record):
    """An effect that was found."""

    name: str
    variant: str = ""
    uses: list[str] = Field(default_factory=list)
    is_declared: bool = False
    rank: Whole
    params: dict[str, Any] = Field(default_factory=dict)
    levels: Levels | None = None
    parameters: dict[str, ParameterRecord]
    size_db: ParameterRecord | None = None
    places: list[PlaceRecord] = Field(default_factory=list)
    confused_with: list[str] = Field(default_factory=list)
    indistinguishable_from: list[str] = Field(default_factory=list)
    probability: Real | None = None
    anomalies: list[Whole] = Field(default_factory=list)
    evidence: EvidenceRecord


class CandidateRecord(Record):
    """A trial of an effect, or the reason why it could not be tried."""

    name: str
    variant: str = ""
    step: Whole
    heldout_rmse_db: Real | None
    heldout_nll_gain: Real | None
    kept: bool
    reason: str
    evidence_nats: Real | None = None
    passed: bool = False
    features: list[Real | None] = Field(default_factory=list)
    probability: Real | None = None
    devices: list[str] = Field(default_factory=list)
    receivers: list[str] = Field(default_factory=list)


class WeightRecord(Record):
    """Weights of a member of the combination, near measurements and far from them."""

    name: str
    weight_near: Real
    weight_far: Real


class PredictionRecord(Record):
    """Comparison of the combination with the best baseline."""

    best_baseline: str
    best_baseline_rmse_db: Real
    combined_rmse_db: Real
    advice: str


class DependenceRecord(Record):
    """Test of the residual's dependence on a variable."""

    variable: str
    p_value: Real | None
    effect_db: Real | None = None


class RemainingRecord(Record):
    """Variables on which the final residual depends."""

    structured: bool
    drivers: list[DependenceRecord]


class ProbabilityRecord(Record):
    """Probability of an effect, `none` or `not in the catalogue`; in a step they sum to 1."""

    name: str
    probability: Real | None


class StepRecord(Record):
    """Probabilities and evidence at one step of the search."""

    step: Whole
    probabilities: list[ProbabilityRecord]
    unnamed_nats: dict[str, Real | None]
    rest_db: Real | None
    noise_db: Real | None


class CauseRecord(Record):
    """Probability of a possible cause of an anomaly; `another` = not in the catalogue."""

    name: str
    probability: Real


class AnomalyRecord(Record):
    """A group of links that reads otherwise than its peers."""

    family: str
    members: dict[Literal["device", "receiver", "flight"], list[str]]
    ranges: dict[str, Annotated[list[Real], Field(min_length=2, max_length=2)]] = Field(
        default_factory=dict)
    sight: Literal["los", "nlos", "all"] = "all"
    same_over: list[Literal["flight", "direction"]] = Field(default_factory=list)
    statistic: Literal["level", "scatter", "blanks", "curve"]
    along: Literal["", "time_s", "flight", "body_azimuth_deg", "predicted_db"] = ""
    size: KnownParameterRecord
    probability: Real
    links: Whole
    causes: list[CauseRecord] = Field(default_factory=list)


class DetectableRecord(Record):
    """Least size from which an effect would have been named; None if no size suffices."""

    name: str
    size: Real | None
    unit: str
    pattern: str


class SeenRecord(Record):
    """Least deviation from its peers from which a typical group would have been found."""

    family: str
    statistic: Literal["level", "scatter", "blanks"]
    size: Real
    unit: str


class ReceiverDifferenceRecord(Record):
    """Difference of two receivers' readings at common places."""

    first: str
    second: str
    difference_db: KnownParameterRecord
    pairs: Whole
    places: Whole


class FoldsRecord(Record):
    """Folds, and the number n of scored links."""

    by: str
    folds: Whole
    n: Whole


class InputsRecord(Record):
    """Input files of the loop, and the origin of the local frame."""

    measurements: str | None = None
    scene: str | None = None
    origin: Origin | None = None


class ReportRecord(Record):
    """Content of `closeloop.json`."""

    schema_: Literal["radiotwin.closeloop/3"] = Field(alias="schema")
    radiotwin_version: str = ""
    base: str
    verdict: Literal["effect", "located", "none", "undecided"]
    effects: list[EffectRecord]
    candidates: list[CandidateRecord]
    anomalies: list[AnomalyRecord] = Field(default_factory=list)
    posterior: list[StepRecord] = Field(default_factory=list)
    detectable: list[DetectableRecord] = Field(default_factory=list)
    seen_from: list[SeenRecord] = Field(default_factory=list)
    receivers_compared: list[ReceiverDifferenceRecord] = Field(default_factory=list)
    heldout: FoldsRecord
    error: ErrorRecord
    baselines: dict[str, BaselineRecord]
    combination: list[WeightRecord] = Field(default_factory=list)
    prediction: PredictionRecord | None = None
    dependences_before: list[DependenceRecord] = Field(default_factory=list)
    remaining: RemainingRecord
    criteria: dict[str, Real] = Field(default_factory=dict)
    notes: list[str]
    inputs: InputsRecord = Field(default_factory=InputsRecord)

    @model_validator(mode="after")
    def _effects_change_errors(self) -> Self:
        rmse_db = self.error.before.rmse_db, self.error.after.rmse_db
        if self.verdict == "effect" and None in rmse_db:
            raise ValueError("the verdict is effect, and error has no rmse_db before or after it")
        return self

    @model_validator(mode="after")
    def _none_beside_no_group(self) -> Self:
        """Refuse a verdict that contradicts whether the report has anomalies."""
        if self.verdict == "none" and self.anomalies:
            raise ValueError("the verdict is none, and groups of links stand out")
        if self.verdict == "located" and not self.anomalies:
            raise ValueError("the verdict is located, and no group of links stands out")
        return self
