"""`excess_attenuation`: loss proportional to path length, by gas, rain, haze or vegetation.

Specific attenuation γ [dB/km] times path length [km] (ITU-R P.676-12, P.838-3, P.833-10). It may
fall with height as exp(-z / h), as the density of water vapour does (ITU-R P.835-6, Sec. 1.2).

If the frequency is known, γ is bounded by that of humid air plus rain of 150 mm/h at all heights,
plus woodland for the part of the profile below the tops of trees.
"""

import numpy as np
from pydantic import Field
from typing_extensions import override

from radiotwin.effects.base import GainEffect, LevelAt, ResidualView, Term
from radiotwin.effects.losses import max_gas_db_km, max_rain_db_km, specific_db_m
from radiotwin.effects.params import Allowed, EffectParams, Estimate, Parameter, Variation
from radiotwin.effects.patterns import Pattern
from radiotwin.links import Links

PRIOR_SD_DB_KM = 30.0  # wide: heavy rain at 60 GHz is 15 dB/km
SCALE_HEIGHTS_M = (5000.0, 150.0, 50.0)  # start values: atmosphere, haze, vegetation
MIN_HEIGHT_M, MAX_HEIGHT_M = 15.0, 5000.0
TREES_M = 30.0  # height of tall trees
HEIGHT_SD = 2.0  # weak prior, sd of log(scale height)
# ITU-R P.833-10 calls its specific attenuations typical: species, density and water differ widely.
DENSEST = 2.0  # specific attenuation of the densest woodland over the typical one


class ExcessAttenuation(GainEffect):
    """A specific attenuation, with a scale height, on all links."""

    name = "excess_attenuation"
    in_words = "attenuation along the whole way"
    acts_on = ("distance",)
    parameter_labels = {"scale_height_m": "scale height (1/e)"}
    settled_by = "measure at much longer distances with line of sight"
    confused_with = ("foliage", "receiver_saturation")

    class Params(EffectParams):
        """Profile of the density over height."""

        scale_height_m: float = Field(
            ge=1e-3, le=1e9, description="Height over which the density falls to 1/e [m].")
        frequency_hz: float | None = Field(
            None, gt=0, le=1e12, description="Of the radio [Hz]; None: unknown, no bound.")

    params: Params

    @override
    def propose(self, view: ResidualView) -> list[Params]:
        frequency_hz = view.links.frequency_hz
        known_hz = float(frequency_hz) if np.isfinite(frequency_hz) else None
        return [self.Params(scale_height_m=height_m, frequency_hz=known_hz)
                for height_m in SCALE_HEIGHTS_M]

    @override
    def term(self, links: Links, level_at: LevelAt) -> Term:
        """Return the column -(distance [km] × mean relative density); its coefficient is dB/km."""
        height_m = self.params.scale_height_m
        low_m = np.minimum(links.device_m[links.device, 2], links.receiver_m[:, 2])
        rise = np.maximum(np.abs(links.offset_m[:, 2]), 1e-3) / height_m
        density = np.exp(-np.maximum(low_m, 0.0) / height_m) * -np.expm1(-rise) / rise
        return Term.of_columns((-links.distance_m / 1000 * density)[:, None], PRIOR_SD_DB_KM)

    @override
    def variation(self) -> Variation:
        params = self.params
        return Variation(np.log([params.scale_height_m]), np.array([0.4]), np.log([MIN_HEIGHT_M]),
                         np.log([MAX_HEIGHT_M]),
                         lambda numbers: self.changed(scale_height_m=float(np.exp(numbers[0]))))

    @override
    def neg_log_prior(self) -> float:
        # Flights at one height cannot tell the scale height: of equal fits, prefer a low one.
        return 0.5 * (np.log(self.params.scale_height_m / TREES_M) / HEIGHT_SD) ** 2

    @override
    def implausible(self, coefficients: np.ndarray) -> str | None:
        """Return why the attenuation is negative or beyond air, rain and woodland; else None."""
        params = self.params
        if coefficients[0] < 0:
            return f"it would have to amplify, by {-coefficients[0]:.1f} dB/km"
        if params.frequency_hz is None:
            return None
        most_db_km = max_at_ground_db_km(params.frequency_hz, params.scale_height_m)
        if coefficients[0] > most_db_km:
            return (f"{coefficients[0]:.3g} dB/km at the ground, over a scale height of "
                    f"{params.scale_height_m:.0f} m, is more than air, rain and woodland take at "
                    f"{params.frequency_hz / 1e9:g} GHz: {most_db_km:.3g} dB/km (ITU-R P.676, "
                    "P.838, P.833)")
        return None

    @override
    def typical_patterns(self, view: ResidualView) -> list[Pattern]:
        """Return a loss of 1 dB/km on all links, at all heights alike."""
        links = view.links
        most_db_km = max_at_ground_db_km(links.frequency_hz, MAX_HEIGHT_M) \
            if np.isfinite(links.frequency_hz) else np.inf
        return [Pattern("distance", "dB/km", "on all links, at all heights alike",
                        -links.distance_m / 1000, high=most_db_km)]

    @override
    def parameters(self, links: Links, estimate: Estimate) -> dict[str, Parameter]:
        """Report attenuation at the ground [dB/km], and its fall with height (scale height) [m]."""
        return {"specific_attenuation_db_km": Parameter.normal(
                    estimate.coefficients[0], estimate.coefficients_sd[0], "dB/km",
                    Allowed(low=0.0)),
                "scale_height_m": Parameter.log_normal(
                    self.params.scale_height_m, estimate.params_sd[0], "m",
                    Allowed(MIN_HEIGHT_M, MAX_HEIGHT_M, is_log=True))}


def max_at_ground_db_km(frequency_hz: float, scale_height_m: float) -> float:
    """Compute the largest plausible attenuation at the ground: gas, rain and woodland [dB/km].

    Woodland is spread over the height profile: a vertical path loses as much below `TREES_M` as
    through trees of that height.

    Args:
        frequency_hz: carrier frequency [Hz].
        scale_height_m: height over which the density falls to 1/e [m].
    """
    relative = TREES_M / scale_height_m
    woodland_db_km = 1000 * DENSEST * specific_db_m(frequency_hz) * relative * -np.expm1(-relative)
    return float(max_gas_db_km(frequency_hz) + max_rain_db_km(frequency_hz) + woodland_db_km)
