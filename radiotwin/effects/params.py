"""Parameters of an effect: typed, with units and bounds, for the search and for the report."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, TypeVar

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationInfo

QUANTILE_90 = 1.645  # standard deviations to each side of a normal distribution's 90 % interval
CIRCLE_DEG = 360.0
# Spans of priors without bounds: 90 % of a level's, whose standard deviation is 20 dB, and of a
# positive number's, a factor of 100.
LEVELS_DB, RATIOS = 66.0, float(np.log(100.0))
MAX_SHARE = 0.5  # of a prior's span, which an interval may have: more is less than one bit learnt
NEAR_SHARE = 0.5  # of a step: grid on which folds search where each value follows paths


def _within(end: str) -> AfterValidator:
    """Check an index against the number of devices or receivers that a twin's file has."""
    def check(index: int, info: ValidationInfo) -> int:
        if info.context and index >= info.context[end]:
            raise ValueError(f"there is no {end} of index {index}")
        return index
    return AfterValidator(check)


def _different(values: list[Any]) -> list[Any]:
    if len(set(values)) < len(values):
        raise ValueError("a value is listed twice")
    return values


# Types of parameters. Their bounds are far beyond what is measured: within them, what an effect
# does is a finite number.
Decibels = Annotated[float, Field(ge=-1000, le=1000)]
Metres = Annotated[float, Field(ge=-1e8, le=1e8)]
Length = Annotated[float, Field(ge=0, le=1e6)]
Seconds = Annotated[float, Field(ge=-1e15, le=1e15)]
DeviceIndex = Annotated[int, Field(ge=0), _within("device")]
ReceiverIndex = Annotated[int, Field(ge=0), _within("receiver")]
Item = TypeVar("Item")
Unique = Annotated[list[Item], Field(min_length=1), AfterValidator(_different)]


class EffectParams(BaseModel):
    """Nonlinear parameters of an effect, beside the coefficients of its term.

    Subclass it in each effect, as `Params`, with one field a parameter (see `quantity`). Values are
    checked when they are made and when a twin's file is read.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


def quantity(default: Any, *, unit: str, low: float, high: float, step: float,
             prior_sd: float | None = None, description: str) -> Any:
    """Return a field of `EffectParams` that is searched for.

    Args:
        default: where the search begins.
        unit: such as `dB`, `m` or `s`.
        low: least value.
        high: greatest value.
        step: typical uncertainty; the size of the search's first steps.
        prior_sd: standard deviation of a normal prior around the default; None: flat.
        description: one line, for the report.
    """
    extra: dict[str, Any] = {"unit": unit, "step": step, "prior_sd": prior_sd, "low": low,
                             "high": high}
    return Field(default, ge=low, le=high, description=description, json_schema_extra=extra)


@dataclass(frozen=True)
class Allowed:
    """Values that a reported parameter may have.

    Attributes:
        low, high: bounds; infinite where there are none.
        period: of an angle, after which values repeat; inf = they do not.
        is_log: whether the parameter is positive and its ratios count, not its differences.
    """

    low: float = -np.inf
    high: float = np.inf
    period: float = np.inf
    is_log: bool = False

    @classmethod
    def of(cls, field: dict[str, Any]) -> "Allowed":
        """Return the values of a field of `quantities`; angles that may turn around repeat."""
        low, high = field["low"], field["high"]
        if field["unit"] == "deg" and high - low > CIRCLE_DEG:
            return cls(period=CIRCLE_DEG)
        return cls(low, high)

    def span(self, unit: str) -> float:
        """Return how wide a prior over these values is, of the logarithm where ratios count.

        Args:
            unit: of the values; levels without bounds have the span of `LEVELS_DB`.
        """
        if self.is_log:
            return float(np.log(self.high / self.low)) if 0 < self.low and np.isfinite(self.high) \
                else RATIOS
        levels = LEVELS_DB if unit in ("dB", "dBm") else np.inf
        return float(min(self.high - self.low, self.period, levels))


ANY_VALUE, POSITIVE = Allowed(), Allowed(low=0.0, is_log=True)


@dataclass(frozen=True)
class Parameter:
    """A fitted parameter as it is reported.

    Attributes:
        value: estimate.
        low, high: 90 % interval.
        unit: of all three.
        determined: whether the interval is clearly narrower than what is allowed; False: the data
            do not tell the value.
        allowed: values that it may have.
    """

    value: float
    low: float
    high: float
    unit: str
    determined: bool = True
    allowed: Allowed = ANY_VALUE

    @classmethod
    def normal(cls, value: float, sd: float, unit: str, allowed: Allowed = ANY_VALUE
               ) -> "Parameter":
        """Return a parameter from an estimate and its standard deviation; angles in one turn."""
        value = value % allowed.period if np.isfinite(allowed.period) else value
        reach = QUANTILE_90 * sd
        return cls(float(value), float(value - reach), float(value + reach), unit, allowed=allowed)

    @classmethod
    def log_normal(cls, value: float, log_sd: float, unit: str, allowed: Allowed = POSITIVE
                   ) -> "Parameter":
        """Return a positive parameter from an estimate and the sd of its natural logarithm."""
        low, high = value * np.exp([-QUANTILE_90 * log_sd, QUANTILE_90 * log_sd])
        return cls(float(value), float(low), float(high), unit, allowed=allowed)

    @property
    def is_narrow(self) -> bool:
        """Whether the interval is at most `MAX_SHARE` of what was to be expected before."""
        ends = np.array([self.low, self.high])
        if self.allowed.is_log:
            with np.errstate(divide="ignore"):
                ends = np.log(ends)
        return bool(np.ptp(ends) <= MAX_SHARE * self.allowed.span(self.unit))

    def record(self) -> dict[str, Any]:
        """Return what `closeloop.json` has of it.

        An angle is within one period, and its interval the arc from `low` up to `high`, which may
        pass 0; an angle that is not determined has none.
        """
        value, low, high, period = self.value, self.low, self.high, self.allowed.period
        if np.isfinite(period):
            value, low, high = value % period, low % period, high % period
            if not self.determined:
                low = high = np.nan
        return {"value": value, "low": low, "high": high, "unit": self.unit,
                "determined": self.determined}


@dataclass(frozen=True, eq=False)
class Estimate:
    """Uncertainty of a fitted effect, in view of links that err alike.

    Standard deviations are widened where few independent pieces of evidence stand behind them, so
    that `QUANTILE_90` of them to each side are a 90 % interval.

    Attributes:
        coefficients: (q,) of the columns of its term.
        covariances: (q, q) of them, by each way in which links may err alike.
        sides_sd: (2, r) standard deviations of the r numbers of its `variation`, below and above
            them, all other numbers and coefficients unknown, too.
    """

    coefficients: np.ndarray
    covariances: Sequence[np.ndarray]
    sides_sd: np.ndarray

    @property
    def coefficients_sd(self) -> np.ndarray:
        """(q,) standard deviations of the coefficients."""
        return self.sd_of(np.eye(len(self.coefficients)))

    def sd_of(self, shares: np.ndarray) -> np.ndarray:
        """Return standard deviations (m,) of weighted sums, (m, q), of coefficients: the widest."""
        variance = np.max([np.einsum("ij,jk,ik->i", shares, each, shares)
                           for each in self.covariances], axis=0)
        return np.sqrt(np.maximum(variance, 0.0))

    @property
    def params_sd(self) -> np.ndarray:
        """(r,) standard deviations of the numbers of its `variation`, the greater of both sides."""
        return self.sides_sd.max(axis=0)


@dataclass(frozen=True, eq=False)
class Variation:
    """Parameters as numbers, to be refined by a search.

    Attributes:
        values: (r,) now.
        steps: (r,) typical uncertainty of each.
        low, high: (r,) bounds.
        effect: numbers (r,) -> the effect with them.
        members: indices of numbers that belong together and act on links of their own, such as
            those of one device; each group is refined by itself. None: all act on the same links.
        follows_paths: whether each value is judged on paths that are followed anew. That is slow
            and rough, so folds search on a grid (`NEAR_SHARE`), and what lies between its points
            is uncertain.
        is_rough: whether each value is judged on levels that are nearly those it is to have: what
            lies within such a grid is uncertain, too.
        starts: further numbers (r,) that a search of all links begins at.
    """

    values: np.ndarray
    steps: np.ndarray
    low: np.ndarray
    high: np.ndarray
    effect: Callable[[np.ndarray], Any]
    members: list[np.ndarray] | None = None
    follows_paths: bool = False
    is_rough: bool = False
    starts: Sequence[np.ndarray] = ()

    @property
    def resolution_sd(self) -> np.ndarray:
        """Standard deviation (r,) of what the search leaves open: uniform within the grid."""
        rough = self.follows_paths or self.is_rough
        return self.steps * (NEAR_SHARE / np.sqrt(12) if rough else 0.0)


def quantities(params: type[EffectParams] | EffectParams) -> dict[str, dict[str, Any]]:
    """Return the fields made with `quantity`: name -> unit, low, high, step, prior_sd, default."""
    kind = params if isinstance(params, type) else type(params)
    found = {}
    for name, field in kind.model_fields.items():
        extra = field.json_schema_extra
        if isinstance(extra, dict) and "step" in extra:
            found[name] = dict(extra) | {"default": field.default}
    return found
