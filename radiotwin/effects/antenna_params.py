"""Parameters of antenna patterns, of which an effect has one for each device or receiver."""

from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
from pydantic import model_validator

from radiotwin.effects.params import (
    Allowed,
    EffectParams,
    Parameter,
    Variation,
    quantities,
)


class AntennaParams(EffectParams):
    """Pattern of one antenna.

    Subclass it with `quantity` fields; the last is the power on paths that are not followed, which
    counts only where there is a 3D map.
    """

    @model_validator(mode="before")
    @classmethod
    def _from_values(cls, given: Any) -> Any:
        """Accept the bare values in order, as version 0.1 wrote them."""
        if isinstance(given, list | tuple):
            return dict(zip(cls.model_fields, given, strict=True))
        return given


Pattern = TypeVar("Pattern", bound=EffectParams)


def vary_patterns(patterns: dict[int, Pattern],
                  params: Callable[[dict[int, Pattern]], Any]) -> Variation:
    """Return how the patterns of several antennas, or bodies, may be refined, each by itself.

    Args:
        patterns: pattern of each device or receiver.
        params: patterns -> parameters of the effect.
    """
    members, fields = len(patterns), quantities(next(iter(patterns.values())))
    values = np.array([[getattr(pattern, name) for name in fields]
                       for pattern in patterns.values()])
    steps, low, high = (np.tile([each[key] for each in fields.values()], members)
                        for key in ("step", "low", "high"))

    def changed(numbers: np.ndarray) -> Any:
        rows = np.reshape(numbers, (members, -1)).tolist()
        return params({member: pattern.model_copy(update=dict(zip(fields, row, strict=True)))
                       for (member, pattern), row in zip(patterns.items(), rows, strict=True)})

    return Variation(values.ravel(), steps, low, high, changed,
                     list(np.arange(values.size).reshape(members, -1)))


def allowed_of(name: str, field: dict[str, Any]) -> Allowed:
    """Return the allowed values of a field of `quantities`; azimuths repeat."""
    if name.endswith("azimuth_deg"):
        return Allowed(period=360.0)
    return Allowed(field["low"], field["high"])


def report_pattern(pattern: AntennaParams, sd: np.ndarray, name: str,
                   with_map: bool) -> dict[str, Parameter]:
    """Return a pattern's parameters, by name; without a map, the last is not reported.

    Args:
        pattern: fitted.
        sd: (r,) standard deviation of each parameter.
        name: of the device or receiver.
        with_map: whether paths were followed.
    """
    reported = {}
    for (field, each), field_sd in zip(quantities(pattern).items(), sd, strict=True):
        value = getattr(pattern, field)
        value = value % 360 if field.endswith("azimuth_deg") else value
        reported[f"{field}[{name}]"] = Parameter.normal(value, field_sd, each["unit"],
                                                        allowed_of(field, each))
    if not with_map:
        reported.popitem()
    return reported
