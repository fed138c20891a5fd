"""Types of effect parameters: values with units, bounds, intervals, and their search space."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, TypeVar

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationInfo

QUANTILE_90 = 1.645  # half-width of a normal distribution's 90 % interval [standard deviations]
CIRCLE_DEG = 360.0
# Prior spans of parameters without bounds: the 90 % interval of a level with a standard deviation
# of 20 dB [dB]; of positive numbers a factor of 100 [log].
LEVELS_DB, RATIOS = 66.0, float(np.log(100.0))
MAX_SHARE = 0.5  # interval over prior span up to which a parameter counts as determined: one bit
NEAR_SHARE = 0.5  # grid of folds over the step of the search, where each value follows paths


def _within(end: str) -> AfterValidator:
    """Make a validator: an index must be below a model's number of devices or receivers (`end`)."""
    def check(index: int, info: ValidationInfo) -> int:
        if info.context and index >= info.context[end]:
            raise ValueError(f"there is no {end} of index {index}")
        return index
    return AfterValidator(check)


def _check_unique(values: list[Any]) -> list[Any]:
    """Raise if a value is listed twice."""
    if len(set(values)) < len(values):
        raise ValueError("a value is listed twice")
    return values


# Types of parameters. Their bounds are far beyond real values and keep every level finite.
Decibels = Annotated[float, Field(ge=-1000, le=1000)]
Metres = Annotated[float, Field(ge=-1e8, le=1e8)]
Length = Annotated[float, Field(ge=0, le=1e6)]
Seconds = Annotated[float, Field(ge=-1e15, le=1e15)]
DeviceIndex = Annotated[int, Field(ge=0), _within("device")]
ReceiverIndex = Annotated[int, Field(ge=0), _within("receiver")]
Item = TypeVar("Item")
Unique = Annotated[list[Item], Field(min_length=1), AfterValidator(_check_unique)]


class EffectParams(BaseModel):
    """Nonlinear parameters of an effect, in addition to the coefficients of its term.

    Subclass it in each effect as `Params`, one field per parameter (see `quantity`). Values are
    validated when an instance is made and when a twin's file is read.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


def quantity(default: Any, *, unit: str, low: float, high: float, step: float,
             prior_sd: float | None = None, description: str) -> Any:
    """Declare a field of `EffectParams` that the search refines.

    Args:
        default: initial value of the search.
        unit: e.g. `dB`, `m` or `s`.
        low: lower bound.
        high: upper bound.
        step: typical uncertainty, the first step of the search.
        prior_sd: standard deviation of a normal prior around the default; None: flat prior.
        description: one line, for the report.
    """
    return Field(default, ge=low, le=high, description=description, json_schema_extra={
        "unit": unit, "step": step, "prior_sd": prior_sd, "low": low, "high": high})


@dataclass(frozen=True)
class Allowed:
    """Allowed values of a reported parameter.

    Attributes:
        low, high: bounds; infinite if there are none.
        period: period of an angle; inf = not periodic.
        is_log: whether the parameter is positive and its prior uniform in the logarithm.
    """

    low: float = -np.inf
    high: float = np.inf
    period: float = np.inf
    is_log: bool = False

    @classmethod
    def of(cls, field: dict[str, Any]) -> "Allowed":
        """Take bounds from a field of `quantities`; angles spanning more than 360° are periodic."""
        low, high = field["low"], field["high"]
        if field["unit"] == "deg" and high - low > CIRCLE_DEG:
            return cls(period=CIRCLE_DEG)
        return cls(low, high)

    def span(self, unit: str) -> float:
        """Compute the width of the allowed range, of its logarithm if `is_log` (open: `RATIOS`).

        Args:
            unit: unit of the values; dB and dBm span `LEVELS_DB` at most.
        """
        if self.is_log:
            return float(np.log(self.high / self.low)) if 0 < self.low and np.isfinite(self.high) \
                else RATIOS
        levels = LEVELS_DB if unit in ("dB", "dBm") else np.inf
        return float(min(self.high - self.low, self.period, levels))


ANY_VALUE, POSITIVE = Allowed(), Allowed(low=0.0, is_log=True)


@dataclass(frozen=True)
class Parameter:
    """A fitted parameter with its 90 % interval, for the report.

    Attributes:
        value: estimate.
        low, high: 90 % interval.
        unit: unit of all three.
        determined: whether the interval is clearly narrower than the prior; False: the data do
            not determine the value.
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
        """Build a parameter from value and sd, with 90 % interval; periodic angles are wrapped."""
        value = value % allowed.period if np.isfinite(allowed.period) else value
        reach = QUANTILE_90 * sd
        return cls(float(value), float(value - reach), float(value + reach), unit, allowed=allowed)

    @classmethod
    def log_normal(cls, value: float, log_sd: float, unit: str, allowed: Allowed = POSITIVE
                   ) -> "Parameter":
        """Build a positive parameter from an estimate and the sd of its natural logarithm."""
        low, high = value * np.exp([-QUANTILE_90 * log_sd, QUANTILE_90 * log_sd])
        return cls(float(value), float(low), float(high), unit, allowed=allowed)

    @property
    def is_narrow(self) -> bool:
        """Whether the interval is at most `MAX_SHARE` of the prior's span."""
        ends = np.array([self.low, self.high])
        if self.allowed.is_log:
            with np.errstate(divide="ignore"):
                ends = np.log(ends)
        return bool(np.ptp(ends) <= MAX_SHARE * self.allowed.span(self.unit))

    def record(self) -> dict[str, Any]:
        """Return the parameter as a dictionary for `closeloop.json`.

        An angle is within one period. Its interval is the arc from `low` up to `high`, which may
        pass 0; it is NaN if the angle is not determined.
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
    """Fitted coefficients of an effect with cluster-robust uncertainties.

    Standard deviations are widened if there are few independent clusters, so that ±`QUANTILE_90`
    of them is a 90 % interval.

    Attributes:
        coefficients: (q,) coefficients of the columns of its term.
        covariances: (q, q) covariance of the coefficients for each clustering of the links.
        sides_sd: (2, r) standard deviations of the r numbers of its `variation`, downwards and
            upwards, marginal over all other numbers and coefficients.
    """

    coefficients: np.ndarray
    covariances: Sequence[np.ndarray]
    sides_sd: np.ndarray

    @property
    def coefficients_sd(self) -> np.ndarray:
        """(q,) standard deviations of the coefficients."""
        return self.sd_of(np.eye(len(self.coefficients)))

    def sd_of(self, shares: np.ndarray) -> np.ndarray:
        """Compute the sd (m,) of linear combinations (m, q), the largest over the clusterings."""
        variance = np.max([np.einsum("ij,jk,ik->i", shares, covariance, shares)
                           for covariance in self.covariances], axis=0)
        return np.sqrt(np.maximum(variance, 0.0))

    @property
    def params_sd(self) -> np.ndarray:
        """(r,) standard deviations of the numbers of its `variation`, the larger of both sides."""
        return self.sides_sd.max(axis=0)


@dataclass(frozen=True, eq=False)
class Variation:
    """Search space of an effect: its parameters as r numbers.

    Attributes:
        values: (r,) present values.
        steps: (r,) typical uncertainties.
        low, high: (r,) bounds.
        effect: numbers (r,) -> effect with these parameters.
        members: index arrays of numbers that act on separate links, e.g. those of one device, and
            are refined separately; None: all act on the same links.
        follows_paths: whether each trial value follows paths again. This is slow and not smooth,
            so folds search on a grid (`NEAR_SHARE`), whose spacing adds to the uncertainty.
        is_rough: whether trial values are rated on approximate levels; the same spacing is added.
        starts: further start values (r,) of the search over all links.
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

    def parameters(self, units: Mapping[str, str], params_sd: np.ndarray) -> dict[str, Parameter]:
        """Return name -> value with 90 % interval, from units by name, in order, and sds (r,)."""
        return {name: Parameter.normal(value, sd, unit, Allowed(low, high))
                for (name, unit), value, sd, low, high in zip(
                    units.items(), self.values.tolist(), params_sd, self.low.tolist(),
                    self.high.tolist(), strict=True)}

    @property
    def resolution_sd(self) -> np.ndarray:
        """(r,) standard deviation due to the spacing of the search grid (uniform within it)."""
        rough = self.follows_paths or self.is_rough
        return self.steps * (NEAR_SHARE / np.sqrt(12) if rough else 0.0)


def quantities(params: type[EffectParams] | EffectParams) -> dict[str, dict[str, Any]]:
    """List the fields made with `quantity`: name -> unit, low, high, step, prior_sd, default."""
    kind = params if isinstance(params, type) else type(params)
    found = {}
    for name, field in kind.model_fields.items():
        extra = field.json_schema_extra
        if isinstance(extra, dict) and "step" in extra:
            found[name] = dict(extra) | {"default": field.default}
    return found
