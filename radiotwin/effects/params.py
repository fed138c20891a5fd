"""Parameters of an effect: typed, with units and bounds, for the search and for the report."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any, TypeVar

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationInfo

QUANTILE_90 = 1.645  # standard deviations to each side of a normal distribution's 90 % interval


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
class Parameter:
    """A fitted parameter as it is reported.

    Attributes:
        value: estimate.
        low, high: 90 % interval.
        unit: of all three.
    """

    value: float
    low: float
    high: float
    unit: str

    @classmethod
    def normal(cls, value: float, sd: float, unit: str) -> "Parameter":
        """Return a parameter from an estimate and its standard deviation."""
        reach = QUANTILE_90 * sd
        return cls(float(value), float(value - reach), float(value + reach), unit)

    @classmethod
    def log_normal(cls, value: float, log_sd: float, unit: str) -> "Parameter":
        """Return a positive parameter from an estimate and the sd of its natural logarithm."""
        low, high = value * np.exp([-QUANTILE_90 * log_sd, QUANTILE_90 * log_sd])
        return cls(float(value), float(low), float(high), unit)


@dataclass(frozen=True, eq=False)
class Estimate:
    """Uncertainty of a fitted effect, in view of how many links count as one.

    Attributes:
        coefficients: (q,) of the columns of its term.
        covariance: (q, q) of them.
        profile_widths: (2, r) of the r numbers of its `variation`: how far below and above them the
            likelihood, all coefficients fitted again, has fallen by half a nat if it falls as a
            parabola on that side; very far where it does not fall.
    """

    coefficients: np.ndarray
    covariance: np.ndarray
    profile_widths: np.ndarray

    @property
    def coefficients_sd(self) -> np.ndarray:
        """(q,) standard deviations of the coefficients."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def params_sd(self) -> np.ndarray:
        """(r,) standard deviations of the numbers of its `variation`, of both sides' fall."""
        return 1 / np.sqrt((1 / self.profile_widths**2).mean(axis=0))


@dataclass(frozen=True, eq=False)
class Variation:
    """Parameters as numbers, to be refined by a search.

    Attributes:
        values: (r,) now.
        steps: (r,) typical uncertainty of each.
        low, high: (r,) bounds.
        params: numbers (r,) -> parameters.
        members: indices of numbers that belong together and act on links of their own, such as
            those of one device; each group is refined by itself. None: all act on the same links.
    """

    values: np.ndarray
    steps: np.ndarray
    low: np.ndarray
    high: np.ndarray
    params: Callable[[np.ndarray], Any]
    members: list[np.ndarray] | None = None


def quantities(params: type[EffectParams] | EffectParams) -> dict[str, dict[str, Any]]:
    """Return the fields made with `quantity`: name -> unit, low, high, step, prior_sd, default."""
    kind = params if isinstance(params, type) else type(params)
    found = {}
    for name, field in kind.model_fields.items():
        extra = field.json_schema_extra
        if isinstance(extra, dict) and "step" in extra:
            found[name] = dict(extra) | {"default": field.default}
    return found
