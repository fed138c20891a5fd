"""Loss in proportion to distance: gas, rain, haze, or vegetation everywhere.

Specific attenuation γ [dB/km] times path length [km] (ITU-R P.676-13, P.838-3, P.833-10). Its
density may fall with height as exp(-z / h), as that of water vapour does (ITU-R P.835-6, Sec. 1.2).
"""

import numpy as np
from pydantic import Field
from typing_extensions import override

from radiotwin.effects.base import GainEffect, Term
from radiotwin.effects.params import EffectParams, Estimate, Parameter, Variation
from radiotwin.effects.residual_view import LevelAt, ResidualView
from radiotwin.links import LinkData

PRIOR_SD_DB_KM = 30.0  # wide: heavy rain at 60 GHz is 15 dB/km
SCALE_HEIGHTS_M = (5000.0, 150.0, 50.0)  # to begin with: the atmosphere, haze, vegetation
MIN_HEIGHT_M, MAX_HEIGHT_M = 15.0, 5000.0


class ExcessAttenuation(GainEffect):
    """A specific attenuation that the channel's exponent does not cover."""

    name = "excess_attenuation"
    confused_with = ("foliage", "receiver_saturation")

    class Params(EffectParams):
        """Profile of the density over height."""

        scale_height_m: float = Field(
            ge=1e-3, le=1e9, description="Height over which the density falls to 1/e [m].")

    @override
    def propose(self, view: ResidualView) -> list[Params]:
        return [self.Params(scale_height_m=height_m) for height_m in SCALE_HEIGHTS_M]

    @override
    def term(self, links: LinkData, params: Params, level_at: LevelAt) -> Term:
        height_m = params.scale_height_m
        low = np.minimum(links.device_m[links.device, 2], links.receiver_m[:, 2])
        rise = np.maximum(np.abs(links.offset_m[:, 2]), 1e-3) / height_m
        density = np.exp(-np.maximum(low, 0.0) / height_m) * -np.expm1(-rise) / rise
        return Term.of_columns((-links.distance_m / 1000 * density)[:, None], PRIOR_SD_DB_KM)

    @override
    def variation(self, params: Params) -> Variation:
        return Variation(np.log([params.scale_height_m]), np.array([0.4]), np.log([MIN_HEIGHT_M]),
                         np.log([MAX_HEIGHT_M]),
                         lambda numbers: self.Params(scale_height_m=float(np.exp(numbers[0]))))

    @override
    def implausible(self, params: Params, coefficients: np.ndarray) -> str | None:
        if coefficients[0] < 0:
            return f"it would have to amplify, by {-coefficients[0]:.1f} dB/km"
        return None

    @override
    def parameters(self, links: LinkData, params: Params,
                   estimate: Estimate) -> dict[str, Parameter]:
        return {"specific_attenuation_db_km": Parameter.normal(
                    estimate.coefficients[0], estimate.coefficients_sd[0], "dB/km"),
                "scale_height_m": Parameter.log_normal(params.scale_height_m,
                                                       estimate.params_sd[0], "m")}
