"""`unexplained_trend`, the last resort: the residual as a piecewise linear curve over one variable.

It describes on which variable the residual still depends, without a cause. It is no candidate among
the effects, because it would fit part of any of them. Maps include a curve only if it is common to
all receivers and over a variable of position; a map has no heading and no time.
"""

from typing import Annotated

import numpy as np
from pydantic import AfterValidator, Field
from typing_extensions import override

from radiotwin.effects.arrays import curve_basis, curve_knots
from radiotwin.effects.base import Effect, GainEffect, LevelAt, ResidualView, Term
from radiotwin.effects.params import EffectParams, Estimate, Parameter, ReceiverIndex, Unique
from radiotwin.links import Links, residual_variable

KNOTS = 8
PRIOR_SD_DB = 5.0  # of the value at a knot
MAX_CURVES = 10  # largest number of receivers with separate curves
MIN_KNOWN = 0.5  # least share of links with a known value of the variable
CIRCULAR = ("azimuth_deg", "body_azimuth_deg", "heading_deg")
ON_MAPS = ("distance_m", "elevation_deg", "azimuth_deg", "altitude_m", "predicted_level_db",
           "metres_inside_m", "diffraction_parameter")
OVER = "over "
MAX_KNOT = 1e15  # bound of a knot; covers times since 1970


def _check_ascending(values: list[float]) -> list[float]:
    """Raise if the values do not ascend."""
    if any(after <= before for before, after in zip(values, values[1:], strict=False)):
        raise ValueError("knots must ascend")
    return values


class UnexplainedTrend(GainEffect):
    """A curve over one variable, the same for all receivers or one for each."""

    name = "unexplained_trend"
    parameter_labels = {"rise_and_fall_db": "peak-to-peak variation"}
    nlos_only = True  # may be: its cause is unknown
    of_receiver = True
    is_cause = False

    class Params(EffectParams):
        """Knots and receivers of the curves."""

        knots: Annotated[list[Annotated[float, Field(ge=-MAX_KNOT, le=MAX_KNOT)]],
                         AfterValidator(_check_ascending)] = Field(
            min_length=1, max_length=KNOTS, description="Values of the variable, ascending.")
        receivers: Unique[ReceiverIndex | None] = Field(
            description="Indices of the receivers with a curve each; [None] is one for all.")

    params: Params

    def __init__(self, variable: str) -> None:
        """Make the effect for a variable of `residual_variables`."""
        super().__init__()
        self.variable = variable
        self.variant = f"{OVER}{variable}"  # type: ignore[misc]  # one class for every variable
        self.uses = ("quality",) if variable == "quality" else ()  # type: ignore[misc]

    @override
    @classmethod
    def of_variant(cls, variant: str) -> Effect | None:
        over = variant.removeprefix(OVER)
        return cls(over) if over in ON_MAPS else None

    @override
    def propose(self, view: ResidualView) -> list[Params]:
        """Propose one curve over a variable, or one per receiver, whichever rates higher."""
        value = self._value(view.links, view.level_at)
        known = np.isfinite(value)
        if known.mean() < MIN_KNOWN or np.ptp(value[known]) < 1e-9:
            return []
        receivers = np.unique(view.links.receiver).tolist()
        choices = [[None], *([receivers] if 1 < len(receivers) <= MAX_CURVES else [])]
        knots = curve_knots(value[known], KNOTS, self.variable in CIRCULAR)

        def rating(params: UnexplainedTrend.Params) -> float:
            term = self.with_params(params).term(view.links, view.level_at)
            return view.score(term) - term.columns.shape[1]  # (Akaike 1974)

        return [max((self.Params(knots=knots, receivers=members) for members in choices),
                    key=rating)]

    @override
    def is_on_maps(self) -> bool:
        return self.variable in ON_MAPS and self.params.receivers == [None]

    @override
    def term(self, links: Links, level_at: LevelAt) -> Term:
        """Return the columns of a piecewise linear curve, or of one per receiver [dB]."""
        basis = curve_basis(self._value(links, level_at), np.array(self.params.knots),
                      self.variable in CIRCULAR)
        columns = [basis if member is None else basis * (links.receiver == member)[:, None]
                   for member in self.params.receivers]
        return Term.of_columns(np.hstack(columns), PRIOR_SD_DB)

    @override
    def parameters(self, links: Links, estimate: Estimate) -> dict[str, Parameter]:
        """Report the greatest minus the least value of each fitted curve [dB]."""
        curves = np.reshape(estimate.coefficients, (len(self.params.receivers), -1))
        result = {}
        for member, curve in zip(self.params.receivers, curves):
            label = self.variable
            if member is not None:
                label += f", {links.receiver_names[member]}"
            result[f"rise_and_fall_db[{label}]"] = Parameter(float(np.ptp(curve)), np.nan, np.nan,
                                                             "dB")
        return result

    def _value(self, links: Links, level_at: LevelAt) -> np.ndarray:
        """Return the variable (n,) of the links; cached."""
        return self.of_links.get(
            links, (level_at,), lambda: residual_variable(self.variable, links, level_at(links)))
