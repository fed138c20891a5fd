"""Loss in proportion to distance: gas, rain, haze, or vegetation everywhere.

Specific attenuation γ [dB/km] times path length [km] (ITU-R P.676-13, P.838-3, P.833-10); its density may fall with
height as exp(-z / h), as that of water vapour does (ITU-R P.835-6, Sec. 1.2).
"""

import numpy as np

from radiotwin.effects.base import Effect, Parameter, Term, Variation, View

SPREAD_DB_KM = 30.0
SCALE_HEIGHTS_M = (5000.0, 150.0, 50.0)
LOWEST_M, HIGHEST_M = 15.0, 5000.0


class ExcessAttenuation(Effect):
    """A specific attenuation that the channel's exponent does not stand for."""

    name = "excess_attenuation"
    confused_with = ("foliage", "receiver_saturation")

    def propose(self, view: View) -> list[dict]:
        return [{"scale_height_m": height_m} for height_m in SCALE_HEIGHTS_M]

    def term(self, records, setting, at) -> Term:
        height_m = setting["scale_height_m"]
        low = np.minimum(records.device_m[records.device, 2], records.receiver_m[:, 2])
        rise = np.maximum(np.abs(records.offset_m[:, 2]), 1e-3) / height_m
        density = np.exp(-np.maximum(low, 0.0) / height_m) * -np.expm1(-rise) / rise
        return Term.of_columns((-records.distance_m / 1000 * density)[:, None], SPREAD_DB_KM, ["specific_attenuation"])

    def vary(self, setting) -> Variation:
        return Variation(np.log([setting["scale_height_m"]]), np.array([0.4]), np.log([LOWEST_M]), np.log([HIGHEST_M]),
                         lambda numbers: {"scale_height_m": float(np.exp(numbers[0]))})

    def unphysical(self, setting, coefficients) -> str | None:
        if coefficients[0] < 0:
            return f"it would have to amplify, by {-coefficients[0]:.1f} dB/km"
        return None

    def parameters(self, records, setting, found) -> dict[str, Parameter]:
        height_m, spread = setting["scale_height_m"], 1.645 * found.setting_deviations[0]
        return {"specific_attenuation_db_km": Parameter.normal(found.coefficients[0], found.deviations[0], "dB/km"),
                "scale_height_m": Parameter(height_m, height_m * float(np.exp(-spread)),
                                            height_m * float(np.exp(spread)), "m")}
